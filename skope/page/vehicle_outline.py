"""The vehicle's outline as SVG with a share at each keypoint, and the numbers as a table below."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np

from skope import keypoints
from skope.page.html_pieces import details, table, tag

# A vehicle seen from above with its sides folded out, the lower a point the farther: forward, and from the middle.
_PLAN: Final = {
    "roof_front": (1.0, 0.9),
    "roof_rear": (-1.6, 0.9),
    "windscreen_base": (2.2, 1.15),
    "rear_window_base": (-2.7, 1.15),
    "headlight_outer": (4.35, 1.45),
    "headlight_inner": (4.55, 0.75),
    "taillight_outer": (-4.35, 1.45),
    "taillight_inner": (-4.55, 0.75),
    "wheel_front": (2.9, 2.35),
    "wheel_rear": (-2.9, 2.35),
    "bumper_front": (5.3, 1.75),
    "bumper_rear": (-5.3, 1.75),
    "hood_front": (3.65, 0.95),
    "trunk_rear": (-3.65, 0.95),
    "mirror": (1.55, 1.95),
    "beltline": (-0.3, 1.6),
}
_LOGO: Final = (5.0, 0.0)
assert {"front_logo", *(f"{part}_{side}" for part in _PLAN for side in ("right", "left"))} == {*keypoints.NAMES}


def plan(name: str) -> tuple[float, float]:
    """Place of a keypoint in the outline: x to the right is forward, y down is the vehicle's right."""
    if name == "front_logo":
        return _LOGO
    stem, side = name.rsplit("_", 1)
    forward, out = _PLAN[stem]
    return forward, out if side == "right" else -out


@dataclass(frozen=True, kw_only=True)
class Point:
    """A keypoint of the outline."""

    share: float | None
    """Share from 0 to 1, drawn in percent; None where there was nothing to divide by."""
    tip: str
    """Tooltip, which follows the keypoint's name."""
    cells: Sequence[str]
    """Cells of the keypoint's row of the table, after its name."""


def outline(title: str, points: Mapping[str, Point], head: Sequence[str]) -> str:
    """Draw shares of keypoints in their places on the vehicle.

    Of keypoints whose place is not known, those of another scheme, there are only the numbers.

    Args:
        title: Caption, plain text.
        points: Name of each keypoint -> its share and cells.
        head: Headings of the columns of the points' cells, plain text.

    Returns:
        The figure as markup: drawing, legend and the numbers as a table.
    """
    places = {name: plan(name) for name in keypoints.NAMES}
    edges = "".join(
        "M{:g} {:g}L{:g} {:g}".format(*places[keypoints.NAMES[a]], *places[keypoints.NAMES[b]])
        for a, b in keypoints.SKELETON
    )
    dots = [f'<path class="skeleton" d="{edges}"/>']
    for name, point in points.items():
        if name not in places:
            continue
        x, y = places[name]
        step = "none" if point.share is None else f"p{int(np.clip(point.share * 5, 0, 4))}"
        text = "–" if point.share is None else f"{100 * point.share:.0f}"
        dots.append(
            f'<g class="dot {step}" data-tip="{escape(f"{name}: {point.tip}", quote=True)}">'
            f'<circle cx="{x:g}" cy="{y:g}" r=".34"/>'
            f'<text x="{x:g}" y="{y:g}" dy=".11" text-anchor="middle">{text}</text></g>'
        )
    rows = [[escape(name), *point.cells] for name, point in points.items()]
    words = '<text x="6.1" y=".1" class="end">front</text><text x="-6.9" y=".1" class="end">rear</text>'
    drawing = tag(
        "svg",
        *dots,
        words,
        viewBox="-7.1 -2.9 14.2 5.8",
        role="img",
        tabindex=0,
        class_="outline chart",
        aria_label=f"{title}. The numbers are in the table below.",
    )
    steps = ("under 20 %", "20 to 40 %", "40 to 60 %", "60 to 80 %", "80 % and more")
    legend = tag(
        "ul", *(f'<li><span class="swatch p{i}"></span>{s}</li>' for i, s in enumerate(steps)), class_="legend"
    )
    numbers = details("Numbers", table(["keypoint", *head], rows, caption=title, sortable=True))
    if not points.keys() & places.keys():
        return tag("figure", tag("figcaption", escape(title)), numbers, class_="wide")
    return tag("figure", tag("figcaption", escape(title)), drawing, legend, numbers, class_="wide")
