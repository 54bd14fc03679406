"""Signs on a map of tracks: the camera, labels without overlap, a scale bar and the colour scale."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from skope.camera.model import Camera
from skope.confidence_level import INTERVAL_SIGMAS
from skope.tracks.track import KMH_PER_MPS, Track
from skope.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.transforms import Bbox

INK_COLOR: Final = "#1b2733"
FAINT_COLOR: Final = "#6b7783"
CAMERA_COLOR: Final = "#c2185b"


@dataclass(frozen=True)
class MapSymbols:
    """Symbols on the map from above."""

    outline: tuple[tuple[float, float], ...] = ((1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0))
    """Corners of a vehicle, in halves of its length and width."""
    driving_mps: float = 0.5
    """Minimum speed at which a vehicle is labelled with its speed, m/s."""
    bars_m: tuple[int, ...] = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
    """Lengths of the scale bar, metres."""


MAP_SYMBOLS: Final = MapSymbols()

ROAD_USERS: Final = {"bicycle": "#00796b", "motorcycle": "#e65100", "pedestrian": "#5e35b1"}
"""Colours of the categories that have no outline."""


def unit_m(axes: "Axes") -> float:
    """Return a hundredth of the map's width, metres: the unit of length for signs."""
    return float(np.diff(axes.get_xlim())[0]) / 100


def vehicle_points(track: Track, i: int, shape: Sequence[tuple[float, float]]) -> list[Array]:
    """Return the positions of points on a vehicle.

    Args:
        track: The vehicle's track.
        i: Row of the track.
        shape: Points ahead and to the left of the middle, in half lengths and half widths: (1, 1) is the front left
            corner, (-1, -1) the rear right one.

    Returns:
        World x, y (2,) of each, metres.
    """
    ahead = np.array([np.cos(track.heading[i]), np.sin(track.heading[i])])
    across = np.array([-ahead[1], ahead[0]])
    length, width = np.array(track.size) / 2
    return [track.position[i, :2] + a * length * ahead + b * width * across for a, b in shape]


def draw_camera(axes: "Axes", camera: Camera) -> "Bbox":
    """Draw the camera and its field of view; return their bounding box, pixels of the figure."""
    from matplotlib.patches import Polygon, Wedge
    from matplotlib.patheffects import withStroke

    position, yaw, unit = camera.position[:2], camera.angles[0], unit_m(axes)
    half = math.atan(camera.width / 2 / camera.K[0, 0])
    edges = np.degrees([yaw - half, yaw + half])
    axes.add_patch(Wedge(position.tolist(), 6 * unit, *edges, facecolor=CAMERA_COLOR, alpha=0.3, zorder=4))
    ahead = np.array([math.cos(yaw), math.sin(yaw)])
    across = np.array([-ahead[1], ahead[0]])
    # A box with the widening lens in front of it.
    side = [(-1.6, 0.8), (0.2, 0.8), (0.2, 0.35), (1.1, 0.8)]
    shape = side + [(a, -b) for a, b in reversed(side)]
    body = [position + unit * (a * ahead + b * across) for a, b in shape]
    axes.add_patch(Polygon(body, facecolor=CAMERA_COLOR, edgecolor="white", linewidth=0.8, zorder=8))
    name = position - 3 * unit * ahead
    text = axes.text(
        float(name[0]),
        float(name[1]),
        "camera",
        fontsize=9,
        weight="bold",
        color=CAMERA_COLOR,
        ha="center",
        va="center",
        zorder=9,
    )
    text.set_path_effects([withStroke(linewidth=3, foreground="white")])
    box = text.get_window_extent()
    return _box_around([*axes.transData.transform(body), box.min, box.max])


def draw_labels(
    axes: "Axes",
    tracks: Sequence[Track],
    labelled: Sequence[Track],
    present: Mapping[int, int],
    taken: Sequence["Bbox"],
) -> None:
    """Write the numbers of tracks, with the speed of vehicles that are drawn and move.

    A label overlaps no other label, no vehicle and no taken box. It is placed where it hides least of the paths. A
    label without a free place near its vehicle is left out; tracks.csv has all numbers.

    Args:
        axes: The map.
        tracks: All tracks that are drawn; labels avoid their paths.
        labelled: The tracks that get a label.
        present: Number of a track -> its row at the moment of the map, for vehicles that are drawn.
        taken: Boxes that are not free, pixels of the figure.
    """
    # Window coordinates of matplotlib: pixels from the bottom left.
    drawn = [
        vehicle_points(track, present[track.number], MAP_SYMBOLS.outline) for track in tracks if track.number in present
    ]
    taken = [*taken, *(_box_around(axes.transData.transform(outline)) for outline in drawn)]
    ways = axes.transData.transform(np.concatenate([track.xy for track in tracks] or [np.zeros((0, 2))]))
    inside = axes.get_window_extent()
    for track in sorted(labelled, key=lambda t: t.number not in present):
        i = present.get(track.number, len(track.frames) - 1)
        name = label(track, i) if track.number in present else f"#{track.number}"
        text = axes.text(
            0, 0, name, fontsize=8, color=INK_COLOR, ha="center", va="center", zorder=10,
            bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": FAINT_COLOR, "linewidth": 0.5},
        )  # fmt: skip
        label_box = text.get_window_extent()
        half = np.array([label_box.width, label_box.height]) / 2 + 5
        anchor = axes.transData.transform(track.position[i, :2])
        free = [
            middle
            for middle in _around(anchor, half)
            if inside.count_contains((box := _box_around([middle - half, middle + half])).corners()) == 4
            and not any(box.overlaps(taken_box) for taken_box in taken)
        ]
        if not free:
            text.remove()
            continue
        middle = min(free, key=lambda m: _box_around([m - half, m + half]).count_contains(ways))
        taken.append(_box_around([middle - half, middle + half]))
        start, end = axes.transData.inverted().transform(np.array([anchor, middle])).tolist()
        text.set_position((end[0], end[1]))
        axes.plot(*zip(start, end, strict=True), color=FAINT_COLOR, linewidth=0.7, zorder=5)


def label(track: Track, i: int) -> str:
    """Return a track's number and, if it moves, its speed in its i-th frame with the 90% interval."""
    if track.speed[i] <= MAP_SYMBOLS.driving_mps:
        return f"#{track.number}"
    speed, error = track.speed[i] * KMH_PER_MPS, INTERVAL_SIGMAS * track.speed_sigma[i] * KMH_PER_MPS
    return f"#{track.number}  {speed:.0f} ± {error:.0f} km/h"


def _around(anchor: Array, half: Array) -> Iterator[Array]:
    """Yield candidate centres of a label of half size (2,) around a point, nearest first; pixels."""
    for distance in (14, 26, 40, 56, 75):
        for angle in np.radians((45, 135, -45, -135, 90, -90, 0, 180)):
            towards = np.array([np.cos(angle), np.sin(angle)])
            yield anchor + towards * (distance + half)


def draw_frame(axes: "Axes") -> None:
    """Draw world coordinates along the edge, as in tracks.csv."""
    axes.tick_params(colors=FAINT_COLOR, labelsize=7, length=3, width=0.6)
    for spine in axes.spines.values():
        spine.set(edgecolor=FAINT_COLOR, linewidth=0.6)
    axes.set_xlabel("x, m", fontsize=7, color=FAINT_COLOR, loc="right", labelpad=1)
    axes.set_ylabel("y, m", fontsize=7, color=FAINT_COLOR, loc="top", labelpad=1)


def draw_key(axes: "Axes", tracks: Sequence[Track], camera: Camera) -> "Bbox":
    """Draw a scale bar in the emptiest corner.

    Args:
        axes: The map, in metres.
        tracks: Drawn tracks; the bar avoids their positions.
        camera: The camera; the bar avoids its position.

    Returns:
        The box that the bar occupies, pixels of the figure.
    """
    from matplotlib.patches import FancyBboxPatch

    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    unit = unit_m(axes)
    length = max(bar for bar in MAP_SYMBOLS.bars_m if bar <= max(1, (x1 - x0) / 5))
    size = np.array([length + 4 * unit, 7 * unit])
    places = np.concatenate([camera.position[None, :2], *(t.xy for t in tracks)])
    inset = 1.5 * unit
    free = [(x, y) for y in (y0 + inset, y1 - inset - size[1]) for x in (x1 - inset - size[0], x0 + inset)]
    low = np.array(free)[:, None] - 2 * unit
    crowds = ((places > low) & (places < low + size + 4 * unit)).all(axis=-1).sum(axis=1)
    x, y = free[int(np.argmin(crowds))]
    axes.add_patch(
        FancyBboxPatch(
            (x, y),
            size[0],
            size[1],
            boxstyle="round,pad=0,rounding_size=0.6",
            facecolor="white",
            edgecolor="none",
            alpha=0.85,
            zorder=9,
        )
    )
    axes.plot(
        [x + 2 * unit, x + 2 * unit + length],
        [y + 2.5 * unit] * 2,
        color=INK_COLOR,
        linewidth=3.5,
        solid_capstyle="butt",
        zorder=11,
    )
    label: dict[str, Any] = {"fontsize": 9, "color": INK_COLOR, "ha": "center", "zorder": 11}
    axes.text(x + 2 * unit + length / 2, y + 3.6 * unit, f"{length} m", va="bottom", **label)
    return _box_around(axes.transData.transform([(x, y), (x, y) + size]))


def _box_around(points: ArrayLike) -> "Bbox":
    """Return the upright bounding box of points (N, 2)."""
    from matplotlib.transforms import Bbox

    return Bbox.from_extents(*np.min(points, axis=0), *np.max(points, axis=0))


def draw_scale(axes: "Axes", colors: "Colormap", norm: "Normalize") -> None:
    """Draw the scale of colours for speeds in km/h.

    Args:
        axes: The axes to fill.
        colors: Colours of speeds.
        norm: Range of speeds of the colours, km/h.
    """
    from matplotlib.cm import ScalarMappable

    axes.figure.colorbar(ScalarMappable(norm, colors), cax=axes, extend="max")  # speeds above the range may occur
    axes.set_title("km/h", fontsize=9, color=INK_COLOR, pad=6)
    axes.tick_params(colors=INK_COLOR, labelsize=9, length=3, width=0.6)
    for spine in axes.spines.values():
        spine.set_visible(False)
