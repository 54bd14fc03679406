"""Tables of what traffic_clips.py has found, from its results.json.

python scripts/research/traffic_tables.py clips/results.json
"""

import argparse
import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.files.json_files import read_json

Row = Mapping[str, Any]
VISIBLE: Final = ("seen", "hardly")
BINS: Final = (0, 20, 40, 60, 1000)
"""Distances from the camera, metres."""
NOT_VEHICLES: Final = ("bicycle", "motorcycle", "pedestrian")


def print_tables(clips: Sequence[Row]) -> None:
    """All tables."""
    by_gate(clips)
    by_clip(clips)
    crossings = [row for clip in clips for row in clip["crossings"]]
    besides = [row for clip in clips for row in clip["besides"]]
    print("\n                      crossings  missed (90%)        double  nobody's  who did not cross  time within 90%")
    for title, key in (("distance", distance_of), ("class", class_of), ("light", light_of), ("label", state_of)):
        by_kind(crossings, besides, title, key)
    hidden = Counter(row["state"] for row in crossings if row["state"] not in VISIBLE)
    counted = sum(row["counted"] for row in crossings if row["state"] not in VISIBLE)
    print(
        f"\nhidden at the gate: {hidden['hidden']}, in the whole clip: {hidden['never']}; of these counted: {counted}"
    )
    causes = Counter(row["cause"] for row in visible(crossings) if not row["counted"])
    print("why missed:", ", ".join(f"{number} {cause}" for cause, number in causes.most_common()) or "-")
    by_class(crossings)
    likeness(clips)


def visible(crossings: Iterable[Row]) -> list[Row]:
    """Those that count: who is visible at the gate."""
    return [row for row in crossings if row["state"] in VISIBLE]


def distance_of(row: Row) -> str:
    """The bin of its distance."""
    k = int(np.searchsorted(BINS, row["distance"], side="right")) - 1
    return f"{BINS[k]}-{BINS[k + 1]} m" if k < len(BINS) - 2 else f"over {BINS[-2]} m"


def class_of(row: Row) -> str:
    """Its class."""
    return str(row["class"])


def light_of(row: Row) -> str:
    """Its clip's light."""
    return str(row["light"])


def state_of(row: Row) -> str:
    """Whether its labels at the gate are not ignored; of who is besides, nothing."""
    return str(row.get("state", "-"))


def by_gate(clips: Sequence[Row]) -> None:
    """A line for each gate and direction."""
    print("clip                        gate   dir   who      truth hidden  all plain counted  off      %  GEH 90%")
    for clip in clips:
        for row in clip["counts"]:
            if row["who"] == "all" or not (row["who"] == "vehicles" or row["truth_all"] or row["count"]):
                continue
            percent = "-" if row["percent"] is None else f"{row['percent']:+.0f}"
            hidden = row["hidden_at_gate"] + row["hidden_always"]
            interval = (
                f"{row['low']}-{row['high']} {'holds' if row['holds'] else 'FAILS'}"
                if row["high"] is not None
                else "not known"
            )
            name = f"{clip['clip']['name']:27.27} {row['gate']:6.6} {row['direction']:5.5} {row['who']:8}"
            true = f"{row['truth']:5d} {hidden:6d} {row['truth_all']:4d} {row['plain_all']:5d}"
            print(f"{name} {true} {row['count']:7d} {row['difference']:+4d} {percent:>6} {row['geh']:4.1f} {interval}")


def by_clip(clips: Sequence[Row]) -> None:
    """A line for each clip."""
    print(
        "\nclip                        movements: truth counted wrong   v50 off, km/h  v85 off   headways: median (90%)"
    )
    for clip in clips:
        turning = clip["turning"]
        true, said = (sum(row[key] for row in turning) for key in ("truth", "count"))
        wrong = sum(abs(row["truth"] - row["count"]) for row in turning)
        headways, conflicts = clip["headways"], clip["conflicts"]
        told = f"{headways['matched']} of {headways['truth']}: {pair_of(headways)} s"
        print(
            f"{clip['clip']['name']:27.27} {true:16d} {said:7d} {wrong:5d}  {speeds_off(clip, 'v50'):>14}  "
            f"{speeds_off(clip, 'v85'):>8}   {told}"
        )
        pet = f"PET off {pair_of(conflicts['pet_places_s'])} s, of the area {pair_of(conflicts['pet_area_s'])} s"
        pairs = f"{conflicts['matched']} of {conflicts['truth']} conflicts, {conflicts['told']} told"
        print(f"{'':27} {pairs}; {pet}")


def middle_of(values: Sequence[float]) -> dict[str, Any]:
    """Median and 90% of values; None where there are none."""
    known = [value for value in values if not math.isnan(value)]
    names = {"median": 50, "p90": 90}
    return {name: float(np.percentile(known, share)) if known else None for name, share in names.items()}


def pair_of(values: Row) -> str:
    """Median and 90%."""
    return "-" if values["median"] is None else f"{values['median']:.2f} ({values['p90']:.2f})"


def speeds_off(clip: Row, name: str) -> str:
    """Median of the absolute differences of a percentile, over the gates that tell it."""
    off = [abs(row["told"] - row["truth"]) for row in clip["speeds"] if row["name"] == name and row["told"] is not None]
    return f"{np.median(off):.1f} [{len(off)}]" if off else "-"


def by_kind(crossings: Sequence[Row], besides: Sequence[Row], title: str, key: Callable[[Row], str]) -> None:
    """Misses and doubles of each kind, of those who are visible at the gate."""
    own = visible(crossings)
    for kind in sorted({key(row) for row in (*own, *besides)}):
        rows = [row for row in own if key(row) == kind]
        missed = sum(not row["counted"] for row in rows)
        low, high = share_between(missed, len(rows))
        more = Counter(row["what"] for row in besides if key(row) == kind)
        within = [row["time_holds"] for row in rows if row["counted"]]
        share = f"{100 * missed / len(rows):.0f}%" if rows else "-"
        told = f"{missed:4d} {share:>4} ({100 * low:.0f}-{100 * high:.0f}%)"
        print(
            f"{title:9} {kind:12} {len(rows):8d}  {told:19} {more['double']:6d} {more['nobody']:9d} "
            f"{more['who did not cross']:18d}  {f'{100 * np.mean(within):.0f}%' if within else '-':>15}"
        )


def share_between(number: int, of: int) -> tuple[float, float]:
    """The share's interval that holds it with 90%: Clopper and Pearson's."""
    from scipy.special import betaincinv

    low = float(betaincinv(number, of - number + 1, 0.05)) if number else 0.0
    return low, float(betaincinv(number + 1, of - number, 0.95)) if number < of else 1.0


def by_class(crossings: Sequence[Row]) -> None:
    """Of what class those were that were counted, by distance."""
    rows = [row for row in visible(crossings) if row["counted"]]
    for kind in sorted({distance_of(row) for row in rows}):
        own = [row for row in rows if distance_of(row) == kind]
        right = sum(row["class"] == row["counted_class"] for row in own)
        wrong = Counter((row["class"], row["counted_class"]) for row in own if row["class"] != row["counted_class"])
        told = ", ".join(f"{number} {true} as {said}" for (true, said), number in wrong.most_common())
        print(f"class, {kind}: {right} of {len(own)} right; {told or 'none wrong'}")


Half = tuple[str, str, str, str, bool]
"""Site, clip, gate, direction, and whether it is the second half of the clip."""
ALIKE: Final[Mapping[str, Callable[[Half, Half], bool]]] = {
    "same direction": lambda a, b: a[:4] == b[:4],
    "same direction, other light": lambda a, b: (a[0], *a[2:4]) == (b[0], *b[2:4]) and a[1] != b[1],
    "other direction": lambda a, b: a[:3] == b[:3] and a[3] != b[3] and a[4] != b[4],
    "other gate": lambda a, b: a[:2] == b[:2] and a[2] != b[2] and a[4] != b[4],
}


def likeness(clips: Sequence[Row]) -> None:
    """How alike the shares are that gates miss: halves of clips against each other, of the share's arcsine."""
    for who, wanted, least in (("vehicles", False, 5), ("others", True, 3)):
        counts: dict[Half, list[bool]] = {}
        for clip in clips:
            middle_s = max((row["time_s"] for row in clip["crossings"]), default=0.0) / 2
            for row in clip["crossings"]:
                if row["state"] == "seen" and (row["class"] in NOT_VEHICLES) == wanted:
                    late = row["time_s"] > middle_s
                    name = clip["clip"]["name"]
                    half = name.partition(f"_{row['light']}")[0], name, row["gate"], row["direction"], late
                    counts.setdefault(half, []).append(not row["counted"])
        told = {half: one for half, one in counts.items() if len(one) >= least}
        weights = {half: len(one) for half, one in told.items()}
        shares = {half: math.asin(math.sqrt((sum(one) + 0.375) / (len(one) + 0.75))) for half, one in told.items()}
        mean = sum(shares[half] * n for half, n in weights.items()) / max(sum(weights.values()), 1)
        print(f"\nhow alike gates miss {who}, {len(told)} halves")
        for name, alike in ALIKE.items():
            pairs = [(a, b) for a, b in itertools.combinations(told, 2) if alike(a, b)]
            by = np.array([min(weights[a], weights[b]) for a, b in pairs])
            off = np.array([(shares[a] - mean, shares[b] - mean) for a, b in pairs]).reshape(-1, 2)
            spread = float((by * (off**2).mean(axis=1)).sum())
            told_of = f"{float((by * off.prod(axis=1)).sum()) / spread:5.2f}" if spread > 0 else "    -"
            print(f"  {name:28s} {told_of}, {len(pairs)} pairs")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path, help="results.json")
    print_tables(read_json(parser.parse_args().results)["clips"])


if __name__ == "__main__":
    main()
