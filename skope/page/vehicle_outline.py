"""Outline of the vehicle as SVG with a share at each keypoint, and the numbers as a table below."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from markupsafe import Markup

from skope import keypoints
from skope.page.svg import path_svg, tag
from skope.page.templates import Table, piece

# Vehicle seen from above with its sides folded out, so that lower points are farther out. Forward, and outwards from
# the middle.
POINT_POSITIONS: Final = {
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
LOGO_POSITION: Final = (5.0, 0.0)
assert {"front_logo", *(f"{part}_{side}" for part in POINT_POSITIONS for side in ("right", "left"))} == {
    *keypoints.NAMES
}


def plan(name: str) -> tuple[float, float]:
    """Return the position of a keypoint in the outline: x to the right is forward, y down is the vehicle's right."""
    if name == "front_logo":
        return LOGO_POSITION
    stem, side = name.rsplit("_", 1)
    forward, out = POINT_POSITIONS[stem]
    return forward, out if side == "right" else -out


@dataclass(frozen=True, kw_only=True)
class Point:
    """Keypoint of the outline."""

    share: float | None
    """Value of the keypoint from 0 to 1, for example its share of correct detections; drawn in per cent. None: not
    available."""
    tip: str
    """Tooltip text after the keypoint's name."""
    cells: Sequence[str]
    """Cells of the keypoint's table row after its name."""


def outline(title: str, points: Mapping[str, Point], head: Sequence[str]) -> Markup:
    """Draw shares of keypoints at their positions on the vehicle.

    Keypoints of other schemes have no known position; only their numbers are shown.

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
    dots = [path_svg(edges, "skeleton")]
    for name, point in points.items():
        if name not in places:
            continue
        x, y = (f"{value:g}" for value in places[name])
        step = "none" if point.share is None else f"p{int(np.clip(point.share * 5, 0, 4))}"
        text = "–" if point.share is None else f"{100 * point.share:.0f}"
        dot = tag("circle", cx=x, cy=y, r=".34") + tag("text", text, x=x, y=y, dy=".11", text_anchor="middle")
        dots.append(tag("g", dot, class_=f"dot {step}", data_tip=f"{name}: {point.tip}"))
    rows = [[name, *point.cells] for name, point in points.items()]
    numbers = Table(caption=title, head=["keypoint", *head], rows=rows, sortable=True)
    if not points.keys() & places.keys():
        return piece("figure", title, "", numbers=numbers, wide=True)
    drawing = tag(
        "svg",
        *dots,
        tag("text", "front", x="6.1", y=".1", class_="end"),
        tag("text", "rear", x="-6.9", y=".1", class_="end"),
        viewBox="-7.1 -2.9 14.2 5.8",
        role="img",
        tabindex=0,
        class_="outline chart",
        aria_label=f"{title}. The numbers are in the table below.",
    )
    steps = ("under 20 %", "20 to 40 %", "40 to 60 %", "60 to 80 %", "80 % and more")
    legend = [tag("span", class_=f"swatch p{i}") + step for i, step in enumerate(steps)]
    return piece("figure", title, drawing, legend, numbers, wide=True)
