"""Draw tracks from above in one image: paths, speeds, and the vehicles at one moment."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np

from skope.camera.ground_plane import Ground
from skope.camera.model import Camera
from skope.files.atomic import replacing
from skope.terminal.console import counted
from skope.tracking import map_signs
from skope.tracking.ground_view import GroundView
from skope.tracks.track import Track
from skope.traffic.road_picture import RoadPicture
from skope.types import Array, Pixels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class MapStyle:
    """Appearance of the map from above."""

    dpi: int = 150
    """Dots per inch."""
    width_inches: float = 10.0
    """Width, inches."""
    margin_m: float = 10.0
    """Margin around what is drawn, metres."""
    extent_sigma_m: float = 1.5
    """Positions with a larger standard deviation do not extend the map, metres. Distant ones would make it small."""
    many_tracks: int = 20
    """Number of tracks above which lines are thinner, with one arrowhead, and only drawn vehicles are labelled."""
    tallest: float = 0.85
    """Maximum ratio of height to width."""
    flattest: float = 0.45
    """Minimum ratio of height to width."""
    road_cells: int = 1500
    """Number of cells of the road's image along its longer side."""
    kept_cells: int = 1200
    """Number of cells along the longer side of the road's image that is kept for other maps."""
    kept_quality: int = 70
    """JPEG quality of that image."""
    driving_kmh: float = 5.0
    """Minimum speed at which a vehicle counts for the upper end of the colour scale, km/h."""
    standing_m: float = 4.0
    """Track length below which a track has no direction of travel, metres."""
    wedge: tuple[tuple[float, float], ...] = ((0.85, 0.0), (0.1, 0.7), (0.1, -0.7))
    """Corners of the wedge that points to a vehicle's front, in halves of its length and width."""


MAP_STYLE: Final = MapStyle()

_MAP_EDGES: Final = {"left": 0.055, "right": 0.895, "top": 0.85, "bottom": 0.5}
"""Position of the map: left and right as shares of the image width, top and bottom margins in inches."""


def draw(
    path: Path,
    tracks: Sequence[Track],
    camera: Camera,
    ground: Ground | None,
    road: Pixels | None,
    road_users: Sequence[Track] = (),
) -> None:
    """Write an image of the tracks from above; in metres, with the world's y upwards.

    Args:
        path: The .png file.
        tracks: The tracks of vehicles.
        camera: The camera of the tracks.
        ground: The road; None: unknown, then the camera's field of view is left out.
        road: (H, W, 3) the empty road as the camera shows it, drawn below the tracks. None: no background.
        road_users: The tracks of pedestrians and two-wheelers.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    low, high = extent([*tracks, *road_users], camera.position[:2])
    map_width = MAP_STYLE.width_inches * (_MAP_EDGES["right"] - _MAP_EDGES["left"])
    map_height = map_width * float(high[1] - low[1]) / float(high[0] - low[0])
    height = map_height + _MAP_EDGES["top"] + _MAP_EDGES["bottom"]
    figure = Figure(figsize=(MAP_STYLE.width_inches, height), dpi=MAP_STYLE.dpi)
    FigureCanvasAgg(figure)  # labels are measured before anything is written
    axes = figure.add_axes(
        (_MAP_EDGES["left"], _MAP_EDGES["bottom"] / height, map_width / MAP_STYLE.width_inches, map_height / height),
        xlim=(low[0], high[0]),
        ylim=(low[1], high[1]),
    )
    if ground is not None:
        cell = float((high - low).max()) / MAP_STYLE.road_cells
        _draw_view(axes, GroundView(camera=camera, ground=ground, low=low, high=high, cell_m=cell), road)
    colors, norm = _speed_colors(tracks)
    for track in tracks:
        _draw_path(axes, track, colors, norm, many=len(tracks) > MAP_STYLE.many_tracks)
    frame = _fullest_frame(tracks)
    for road_user in road_users:
        _draw_road_user(axes, road_user, frame)
    present = [(track, frame - int(track.frames[0])) for track in tracks if frame in track.frames]
    for track, i in present:
        _draw_vehicle(axes, track, i, colors(norm(track.speed[i] * 3.6)))
    taken = [map_signs.draw_camera(axes, camera), map_signs.draw_key(axes, tracks, camera)]
    labelled = tracks if len(tracks) <= MAP_STYLE.many_tracks else [track for track, _ in present]
    map_signs.draw_labels(axes, tracks, labelled, {track.number: i for track, i in present}, taken)
    map_signs.draw_frame(axes)
    _write_heading(figure, tracks, road_users, None if not present else float(present[0][0].times_s[present[0][1]]))
    bar = figure.add_axes((0.915, _MAP_EDGES["bottom"] / height, 0.016, map_height / height))
    map_signs.draw_scale(bar, colors, norm)
    with replacing(path) as temporary:
        figure.savefig(temporary)


def road_picture(tracks: Sequence[Track], camera: Camera, ground: Ground, road: Pixels) -> RoadPicture:
    """Return the empty road from above, in the rectangle that `draw` shows.

    Args:
        tracks: Tracks that the rectangle must contain.
        camera: The camera, with its pose.
        ground: The road.
        road: (H, W, 3) the empty road as the camera shows it.
    """
    low, high = extent(tracks, camera.position[:2])
    cell = float((high - low).max()) / MAP_STYLE.kept_cells
    view = GroundView(camera=camera, ground=ground, low=low, high=high, cell_m=cell)
    _, jpeg = cv2.imencode(".jpg", view.pale(road)[..., 0], [cv2.IMWRITE_JPEG_QUALITY, MAP_STYLE.kept_quality])
    (west, south), (east, north) = low.tolist(), high.tolist()
    return RoadPicture(jpeg.tobytes(), (west, south), (east, north))


def _write_heading(
    figure: "Figure", tracks: Sequence[Track], road_users: Sequence[Track], moment_s: float | None
) -> None:
    """Write the number and duration of the tracks above the map, and explain lines and outlines."""
    left, height = _MAP_EDGES["left"], figure.get_figheight()
    heading, note = "No vehicle was tracked", ""
    if tracks:
        seconds = max(t.times_s[-1] for t in tracks) - min(t.times_s[0] for t in tracks)
        heading = f"{counted(len(tracks), 'track')} of vehicles in {seconds:.1f} s"
        note = (
            "Lines: paths driven, numbered as in tracks.csv (a vehicle that was hidden may have two). "
            f"Outlines: the vehicles at {moment_s:.1f} s."
        )
    if road_users:
        kinds = [name for name in map_signs.ROAD_USERS if any(track.category == name for track in road_users)]
        words = f"dotted: {', '.join(kinds)}, as in tracks.csv"
        figure.text(_MAP_EDGES["right"], 1 - 0.36 / height, words, fontsize=9, color=map_signs.FAINT_COLOR, ha="right")
    figure.text(left, 1 - 0.36 / height, heading, fontsize=14, weight="bold", color=map_signs.INK_COLOR)
    figure.text(left, 1 - 0.63 / height, note, fontsize=9, color=map_signs.FAINT_COLOR)


def extent(tracks: Sequence[Track], camera_xy: Array) -> tuple[Array, Array]:
    """Return the corners (2,) of the map: accurate positions and the camera, with a margin and a limited shape."""
    sure = [t.xy[t.position_sigma <= MAP_STYLE.extent_sigma_m] for t in tracks]
    places = np.concatenate([camera_xy[None], *(sure if sum(map(len, sure)) else (t.xy for t in tracks))])
    low, high = places.min(axis=0) - MAP_STYLE.margin_m, places.max(axis=0) + MAP_STYLE.margin_m
    width, height = high - low
    wanted = np.array([max(width, height / MAP_STYLE.tallest), max(height, width * MAP_STYLE.flattest)])
    middle = (low + high) / 2
    return middle - wanted / 2, middle + wanted / 2


def _fullest_frame(tracks: Sequence[Track]) -> int:
    """Return the last of the frames with the most vehicles."""
    if not tracks:
        return 0
    counts = np.bincount(np.concatenate([track.frames for track in tracks]))
    return int(np.flatnonzero(counts == counts.max())[-1])


def _speed_colors(tracks: Sequence[Track]) -> "tuple[Colormap, Normalize]":
    """Return a colour map dark enough for a pale road, and a scale in km/h up to the 98th percentile, rounded up."""
    import matplotlib as mpl

    whole = mpl.colormaps["plasma"]
    colors = mpl.colors.LinearSegmentedColormap.from_list("speed", whole(np.linspace(0.02, 0.86, 64)))
    speeds = np.concatenate([np.zeros(1), *(track.speed for track in tracks)]) * 3.6
    driving = speeds[speeds >= min(MAP_STYLE.driving_kmh, speeds.max())]
    top = 10.0 * np.ceil(max(10.0, float(np.percentile(driving, 98))) / 10)
    return colors, mpl.colors.Normalize(0, top)


def _draw_view(axes: "Axes", view: GroundView, road: Pixels | None) -> None:
    """Draw the image of the road, and the edge of the camera's field of view."""
    extent = (view.low[0], view.high[0], view.low[1], view.high[1])
    if road is not None:
        axes.imshow(view.pale(road), extent=extent, interpolation="bilinear", zorder=0)
    if view.seen.any() and not view.seen.all():
        rows, columns = view.seen.shape
        x = np.linspace(extent[0], extent[1], columns)
        y = np.linspace(extent[3], extent[2], rows)
        axes.contour(
            x,
            y,
            view.seen.astype(float),
            levels=[0.5],
            colors=map_signs.CAMERA_COLOR,
            linewidths=1.0,
            linestyles="dashed",
            zorder=1,
        )


def _draw_path(axes: "Axes", track: Track, colors: "Colormap", norm: "Normalize", *, many: bool) -> None:
    """Draw a track's line with a pale edge, coloured by speed, and arrowheads in the direction of travel.

    The line is thin if there are `many` tracks.
    """
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Polygon

    xy = track.xy
    steps = np.stack([xy[:-1], xy[1:]], axis=1)
    axes.plot(*xy.T, color="white", linewidth=2.8 if many else 4.5, solid_capstyle="round", alpha=0.9, zorder=2)
    lines = LineCollection(
        list(steps), cmap=colors, norm=norm, linewidths=1.5 if many else 2.6, capstyle="round", zorder=3
    )
    lines.set_array(track.speed[1:] * 3.6)
    axes.add_collection(lines)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    if way[-1] < MAP_STYLE.standing_m:
        return
    size = (0.6 if many else 0.95) * map_signs.unit_m(axes)
    for share in (1.0,) if many else (0.5, 1.0):
        i = int(np.clip(np.searchsorted(way, share * way[-1]), 1, len(xy) - 1))
        ahead = track.velocity[i] / max(1e-9, float(track.speed[i]))
        across = np.array([-ahead[1], ahead[0]])
        corners = [xy[i] + size * (a * ahead + b * across) for a, b in ((1.4, 0), (-0.8, 0.9), (-0.3, 0), (-0.8, -0.9))]
        color = colors(norm(track.speed[i] * 3.6))
        axes.add_patch(Polygon(corners, facecolor=color, edgecolor="white", linewidth=0.8, zorder=4))


def _draw_road_user(axes: "Axes", track: Track, frame: int) -> None:
    """Draw the path of a pedestrian or two-wheeler, and a dot at its position in a frame."""
    color = map_signs.ROAD_USERS[track.category]
    axes.plot(*track.xy.T, color=color, linewidth=1.4, linestyle=(0, (1, 1.2)), zorder=3)
    if frame in track.frames:
        x, y = track.position[frame - int(track.frames[0]), :2]
        axes.plot([x], [y], color=color, marker="o", markersize=5, markeredgecolor="white", zorder=6)


def _draw_vehicle(axes: "Axes", track: Track, i: int, color: Any) -> None:
    """Draw a vehicle's outline in its i-th frame, with a wedge towards its front."""
    from matplotlib.patches import Polygon

    outline, wedge = (
        map_signs.vehicle_points(track, i, map_signs.MAP_SYMBOLS.outline),
        map_signs.vehicle_points(track, i, MAP_STYLE.wedge),
    )
    axes.add_patch(
        Polygon(outline, facecolor=color, edgecolor=map_signs.INK_COLOR, linewidth=1.2, joinstyle="round", zorder=6)
    )
    axes.add_patch(Polygon(wedge, facecolor="white", edgecolor="none", zorder=7))
