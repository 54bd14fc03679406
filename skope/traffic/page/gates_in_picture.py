"""Drawing of the gates of a report, with directions and counts, over the camera's image of the empty road."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from skope.camera.model import Camera
from skope.page.svg import tag
from skope.page.templates import piece
from skope.traffic.count_uncertainty import in_words
from skope.traffic.gate_counts import ALL_CLASSES, Count
from skope.traffic.page.count_tables import count_text, side_name
from skope.traffic.page.manual_count import view_of_gates
from skope.traffic.road_picture import EmptyRoadPicture
from skope.traffic.traffic_report import TrafficReport
from skope.types import Array


@dataclass(frozen=True)
class GateDrawing:
    """Sizes of gates drawn on the image."""

    width: float = 1100.0
    """Width of the drawing. Pixels of the footage are scaled to it."""
    arrow: float = 42.0
    """Length of an arrow, in units of the drawing."""
    head: float = 9.0
    """Half the width of an arrow's head."""
    edge: float = 30.0
    """Distance of texts from the edges."""
    arrow_starts: tuple[float, float] = (0.35, 0.65)
    """Positions along the gate of the arrows of its two directions, as shares."""


GATE_DRAWING: Final = GateDrawing()


def gates_in_picture(report: TrafficReport, picture: EmptyRoadPicture | None, camera: Camera | None) -> Markup:
    """A figure with the gates in the camera's image.

    Args:
        report: The report.
        picture: The empty road; None: there is none.
        camera: The camera of a report in metres; None: not known.

    Returns:
        Markup. Empty without a picture, without a gate in the image, or if the picture is of another camera's size.
    """
    view = None if picture is None else view_of_gates(report, camera)
    if picture is None or not view or not view["gates"] or view["size"] not in (None, picture.size):
        return Markup()
    scale = GATE_DRAWING.width / picture.size[0]
    height = picture.size[1] * scale
    totals = [row for row in report.counts_total if row.class_name == ALL_CLASSES]
    letters = {(row.gate, row.direction): _letter(k) for k, row in enumerate(totals)}
    parts = [
        tag(
            "image",
            href=f"data:image/jpeg;base64,{base64.b64encode(picture.jpeg).decode()}",
            width=f"{GATE_DRAWING.width:.0f}",
            height=f"{height:.1f}",
            preserveAspectRatio="none",
        )
    ]
    size = np.array([GATE_DRAWING.width, height])
    for gate in view["gates"]:
        rows = [row for row in totals if row.gate == gate["gate"]]
        parts += _gate(gate, rows, letters, scale, size)
    parts += [_name(gate, scale, size) for gate in view["gates"]]
    drawing = tag(
        "svg",
        *parts,
        viewBox=f"0 0 {GATE_DRAWING.width:.0f} {height:.0f}",
        role="img",
        tabindex=0,
        aria_label="The gates in the camera's image. The counts are in the list below.",
        class_="chart road view",
    )
    drawn = {gate["gate"] for gate in view["gates"]}
    listed = [
        tag("b", letters[row.gate, row.direction])
        + f" {side_name((row.gate, row.direction))}: {count_text(row)} ({in_words(row.confidence_interval)})"
        for row in totals
        if row.gate in drawn
    ]
    caption = "Gates in the camera's image, with the numbers counted by direction (90% intervals below)"
    return piece("figure", caption, drawing, listed, wide=True)


def _letter(number: int) -> str:
    """a to z, then a2 to z2 and so on."""
    turn, letter = divmod(number, 26)
    return chr(ord("a") + letter) + (str(turn + 1) if turn else "")


def _gate(
    gate: dict[str, Any], rows: list[Count], letters: dict[tuple[str, str], str], scale: float, size: Array
) -> Iterator[Markup]:
    """Line of a gate, and an arrow with letter and count for each direction."""
    line = np.array(gate["line"]) * scale
    path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in line)
    tip = f"{gate['gate']}: " + "; ".join(
        f"{row.direction} {count_text(row)} ({in_words(row.confidence_interval)})" for row in rows
    )
    yield tag("path", d=path, class_="gate under")
    yield tag("path", d=path, class_="gate", data_tip=tip)
    if gate["arrow"] is not None:
        forward = _forward(line, np.array(gate["arrow"]))
        for row, share, sign in zip(rows, GATE_DRAWING.arrow_starts, (1.0, -1.0), strict=False):
            yield from _arrow(line[0] + share * (line[-1] - line[0]), sign * forward, row, letters, size)


def _forward(line: Array, arrow: Array) -> Array:
    """Return the (2,) unit vector across a gate's line in the image, in the gate's first direction.

    The projection of the road's own normal is not used: with a low camera it may be parallel to the line in the image.
    """
    along = line[-1] - line[0]
    across = np.array([-along[1], along[0]]) / max(1e-9, float(np.linalg.norm(along)))
    return np.asarray(across if across @ (arrow[1] - arrow[0]) > 0 else -across)


def _name(gate: dict[str, Any], scale: float, size: Array) -> Markup:
    """Name of a gate above its left end."""
    line = np.array(gate["line"]) * scale
    x, y = np.clip(line[np.argmin(line[:, 0])] + [0.0, -12.0], GATE_DRAWING.edge, size - GATE_DRAWING.edge)
    return tag("text", gate["gate"], x=f"{x:.1f}", y=f"{y:.1f}", class_="gate name")


def _arrow(
    start: Array, along: Array, row: Count, letters: dict[tuple[str, str], str], size: Array
) -> Iterator[Markup]:
    tip = start + GATE_DRAWING.arrow * along
    across = np.array([-along[1], along[0]])
    corners = [tip + GATE_DRAWING.head * (across - along), tip, tip - GATE_DRAWING.head * (across + along)]
    head = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in corners)
    path = f"M{start[0]:.1f} {start[1]:.1f}L{tip[0]:.1f} {tip[1]:.1f}{head}"
    yield tag("path", d=path, class_="way under")
    yield tag("path", d=path, class_="way")
    x, y = np.clip(tip + 18 * along + [0.0, 5.0], GATE_DRAWING.edge, size - GATE_DRAWING.edge)
    text = f"{letters[row.gate, row.direction]} {count_text(row)}"
    yield tag("text", text, x=f"{x:.1f}", y=f"{y:.1f}", text_anchor="middle", class_="gate")
