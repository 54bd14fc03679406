"""A traffic report in a few lines of text, as the terminal shows it."""

from collections.abc import Iterator

from skope.terminal.text_table import text_table
from skope.tracks.track import KMH
from skope.traffic.count_uncertainty import count_interval, in_words
from skope.traffic.gate_counts import ALL
from skope.traffic.speed_percentiles import Percentile
from skope.traffic.speeds import MOTOR
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.turning_movements import NOWHERE


def report_lines(report: TrafficReport) -> Iterator[str]:
    """Counts and speeds by gate and direction, the turning matrix, and what else was found."""
    seconds = report.observation.observed_s
    yield f"{len(report.trajectories)} road users over {seconds:.1f} s that were observed; intervals hold 90%"
    if report.counts:
        yield from text_table(
            ["gate", "direction", "class", "count", "there were", "v50 km/h", "v85 km/h"], _gates(report), "lll"
        )
    if report.hand_checks:
        head = ["gate", "direction", "class", "by hand", "count", "there were, by what is seen alone", "GEH"]
        yield from text_table(head, _by_hand(report), "lll")
    if movements := list(_movements(report)):
        yield from text_table(["from", "to", "class", "count", "there were"], movements, "lll")
    if not report.metres:
        return
    likely = [one for one in report.conflicts.conflicts if one.ttc_s <= report.site.traffic.ttc_s]
    others = len(report.conflicts.conflicts) - len(likely)
    told = count_interval([one.probability for one in likely], (0.0, 1.0))
    sure = f" ({told.low} to {told.high} of them real)" if likely else ""
    yield (
        f"{len(report.headways)} headways; {len(likely)} conflicts by time to collision{sure}, {others} more by "
        f"encroachment; {len(report.brakings)} vehicles braked hard"
    )


def _gates(report: TrafficReport) -> Iterator[list[str]]:
    speeds = {
        one.where: one.percentiles
        for one in report.speeds
        if one.kind == "spot" and one.interval is None and one.class_name == MOTOR
    }
    for one in report.counts_total:
        told = in_words(one.expected)
        found = speeds.get(f"{one.gate} ({one.direction})", {}) if one.class_name == ALL else {}
        yield [
            *(one.gate, one.direction, one.class_name, str(one.count or 0), told),
            *(_speed(found.get(name)) for name in ("v50", "v85")),
        ]


def _by_hand(report: TrafficReport) -> Iterator[list[str]]:
    for one in report.hand_checks:
        told = in_words(one.expected)
        hand = one.hand
        counted = (str(hand.number), str(one.count), told, f"{one.geh:.1f}")
        yield [hand.gate, hand.direction_name, hand.class_name, *counted]


def _speed(one: Percentile | None) -> str:
    if one is None or one.value is None or one.low is None or one.high is None:
        return "-"
    return f"{one.value * KMH:.1f} ({one.low * KMH:.1f} to {one.high * KMH:.1f})"


def _movements(report: TrafficReport) -> Iterator[list[str]]:
    """The pairs of gates that somebody was seen at both of, over the whole footage."""
    for one in report.turning_total:
        if NOWHERE not in (one.origin, one.destination):
            sides = [f"{gate} ({direction})" for gate, direction in (one.origin, one.destination)]
            told = in_words(one.expected)
            yield [*sides, one.class_name, str(one.count or 0), told]
