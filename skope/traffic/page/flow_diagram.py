"""Flows from gate to gate as bands between them, as wide as their numbers are large."""

import math
from collections import Counter
from collections.abc import Iterator
from html import escape
from typing import Final

import numpy as np

from skope.page.html_pieces import tag
from skope.schema import VEHICLE
from skope.traffic.count_uncertainty import in_words
from skope.traffic.gate_counts import ALL
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.turning_movements import NOWHERE, GateDirection, TurningCount
from skope.types import Array

_SIZE: Final = 560.0
_RADIUS: Final = 200.0
_WIDEST: Final = 26.0
_THINNEST: Final = 1.5
_APART_DEG: Final = 14.0
"""Between where bands come out of a gate and where they go into it."""
_INWARD: Final = 0.25
"""Nearness of a turn's band, at its middle, to the diagram's middle, as a share."""
_TURNED: Final = 0.6
"""And that of somebody who turns around."""


def flow_diagram(report: TrafficReport) -> str:
    """A figure; nothing where nobody was seen at two gates."""
    vehicles = any(one.class_name == VEHICLE for one in report.turning_total)
    whole = [
        one
        for one in report.turning_total
        if one.class_name == (VEHICLE if vehicles else ALL)
        and one.count
        and NOWHERE not in (one.origin, one.destination)
    ]
    if not whole:
        return ""
    middles = {gate.name: np.mean(gate.line, axis=0) for gate in report.gates}
    used = {name for one in whole for name, _ in (one.origin, one.destination)}
    angles = _angles({name: place for name, place in middles.items() if name in used})
    most = max(one.count or 0 for one in whole)
    order = sorted({one.origin for one in whole})
    parts = [tag("circle", cx=_SIZE / 2, cy=_SIZE / 2, r=_RADIUS, class_="ring")]
    largest_first = sorted(whole, key=lambda one: -(one.count or 0))
    ranks: Counter[GateDirection] = Counter()
    numbers = []
    for one in largest_first:
        band, number = _band(one, angles, most, order.index(one.origin) % 4, ranks[one.origin])
        ranks[one.origin] += 1
        parts.append(band)
        numbers.append(number)
    parts += numbers
    parts += _names(angles)
    drawing = tag(
        "svg",
        *parts,
        viewBox=f"0 0 {_SIZE:.0f} {_SIZE:.0f}",
        role="img",
        tabindex=0,
        aria_label="Movements between gates. The numbers are in the table of movements.",
        class_="chart flows",
    )
    return tag(
        "figure",
        tag(
            "figcaption",
            f"Movements{' of vehicles' if vehicles else ''}; the number of a band is at its origin",
        ),
        drawing,
    )


def _angles(middles: dict[str, Array]) -> dict[str, float]:
    """Angle of each gate around the middle of all, radians, moved apart where two are near each other."""
    centre = np.mean(list(middles.values()), axis=0)
    found = {name: math.atan2(*(place - centre)[::-1]) for name, place in middles.items()}
    names = sorted(found, key=lambda name: found[name])
    least = min(math.radians(3 * _APART_DEG), 2 * math.pi / len(names))
    for _ in range(50):
        for before, after in zip(names, names[1:] + names[:1], strict=True):
            gap = (found[after] - found[before]) % (2 * math.pi)
            if len(names) > 1 and gap < least:
                found[before] -= (least - gap) / 2
                found[after] += (least - gap) / 2
    return found


def _at(angle: float, radius: float) -> tuple[float, float]:
    return _SIZE / 2 + radius * math.cos(angle), _SIZE / 2 - radius * math.sin(angle)


def _band(one: TurningCount, angles: dict[str, float], most: int, style: int, rank: int) -> tuple[str, str]:
    """The band of a movement, and its number: farther along for each larger one from the same gate and direction.

    Who comes in keeps to the right of who goes out.
    """
    half = math.radians(_APART_DEG) / 2
    begin, end = angles[one.origin[0]] + half, angles[one.destination[0]] - half
    (ax, ay), (bx, by) = _at(begin, _RADIUS), _at(end, _RADIUS)
    inward = (_TURNED if one.origin[0] == one.destination[0] else _INWARD) * _RADIUS
    (cx, cy), (dx, dy) = _at(begin, inward), _at(end, inward)
    number = one.count or 0
    width = max(_THINNEST, _WIDEST * number / most)
    tip = f"{_side(one.origin)} to {_side(one.destination)}: {number} ({in_words(one.expected)})"
    path = f"M{ax:.1f} {ay:.1f}C{cx:.1f} {cy:.1f} {dx:.1f} {dy:.1f} {bx:.1f} {by:.1f}"
    t = min(0.16 + 0.14 * rank, 0.8)
    weights = ((1 - t) ** 3, 3 * (1 - t) ** 2 * t, 3 * (1 - t) * t**2, t**3)
    x = sum(w * v for w, v in zip(weights, (ax, cx, dx, bx), strict=True))
    y = sum(w * v for w, v in zip(weights, (ay, cy, dy, by), strict=True))
    band = tag("path", d=path, class_=f"flow s{style}", stroke_width=f"{width:.1f}", data_tip=tip)
    return band, tag("text", str(number), x=f"{x:.1f}", y=f"{y:.1f}", text_anchor="middle")


def _side(side: tuple[str, str]) -> str:
    return f"{side[0]} ({side[1]})"


def _names(angles: dict[str, float]) -> Iterator[str]:
    for name, angle in angles.items():
        x, y = _at(angle, _RADIUS + 26)
        side = "middle" if abs(math.cos(angle)) < 0.4 else "start" if math.cos(angle) > 0 else "end"
        x += {"start": -14, "end": 14, "middle": 0}[side]
        yield tag("text", escape(name), x=f"{x:.1f}", y=f"{y:.1f}", text_anchor=side, class_="gate")
