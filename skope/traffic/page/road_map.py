"""Map of the road from above as SVG: tracks, gates with their counts, zones, lanes and conflicts."""

import base64
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from markupsafe import Markup

from skope.page.svg import tag
from skope.page.templates import piece
from skope.schema import PEDESTRIAN_CATEGORY, VEHICLE_CATEGORY
from skope.site.gates_zones_lanes import Outline
from skope.tracks.track import Track
from skope.traffic.count_uncertainty import in_words
from skope.traffic.gate_counts import ALL_CLASSES
from skope.traffic.gates import may_count
from skope.traffic.report_tables import thinned
from skope.traffic.road_picture import RoadPicture
from skope.traffic.traffic_report import TrafficReport
from skope.types import Array


@dataclass(frozen=True)
class RoadMapStyle:
    """Sizes of the map of the road."""

    width: float = 1100.0
    """Width of the map."""
    tallest: float = 0.75
    """Largest height over width."""
    margin: float = 40.0
    """Margin of the map."""
    most_tracks: int = 600
    """Maximum number of tracks, evenly chosen."""
    step_s: float = 0.5
    """Time between points of a track, seconds."""
    outermost_percent: float = 0.5
    """Percentage of positions on each side that the map may leave out. The farthest ones are the least certain."""
    around: float = 0.6
    """Margin around the gates, in their extents."""
    most_conflicts: int = 200
    """Maximum number of conflicts."""
    bars_m: tuple[int, ...] = (1, 2, 5, 10, 20, 50, 100, 200, 500)
    """Lengths of the scale bar, metres."""


ROAD_MAP_STYLE: Final = RoadMapStyle()


class _Frame:
    """Conversion of positions to points of the drawing."""

    def __init__(self, places: Array) -> None:
        low, high = places.min(axis=0), places.max(axis=0)
        across, up = np.maximum(high - low, 1e-6)
        inner = ROAD_MAP_STYLE.width - 2 * ROAD_MAP_STYLE.margin
        self.scale = float(
            min(inner / across, (ROAD_MAP_STYLE.width * ROAD_MAP_STYLE.tallest - 2 * ROAD_MAP_STYLE.margin) / up)
        )
        self.height = float(up) * self.scale + 2 * ROAD_MAP_STYLE.margin
        self._corner = np.array([(low[0] + high[0] - inner / self.scale) / 2, high[1]])

    def points(self, places: Sequence[Sequence[float]] | Array) -> Array:
        """Return the (M, 2) points of positions (M, 2)."""
        return np.asarray((np.asarray(places) - self._corner) * [self.scale, -self.scale] + ROAD_MAP_STYLE.margin)

    def path(self, places: Sequence[Sequence[float]] | Array, *, closed: bool = False) -> str:
        """Return the `d` attribute of an SVG path."""
        return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in self.points(places)) + ("Z" if closed else "")


def road_map(report: TrafficReport, road: RoadPicture | None) -> Markup:
    """Return the map as a figure, with an image of the empty road if available; empty without gates and tracks."""
    tracks = [track for track in report.trajectories if may_count(track, report.site.traffic)]
    chosen = tracks[:: max(1, math.ceil(len(tracks) / ROAD_MAP_STYLE.most_tracks))]
    places = _outline(chosen, [gate.line for gate in report.gates])
    if not len(places):
        return Markup()
    frame = _Frame(places)
    under = [] if road is None or not report.metres else [_picture(road, frame)]
    parts = [*under, *_marks(report, frame), *_tracks(chosen, frame), *_conflicts(report, frame)]
    for gate in report.gates:
        parts += _gate(report, frame, gate.name, gate.line)
    if report.metres:
        parts.append(_bar(frame))
    drawing = tag(
        "svg",
        *parts,
        viewBox=f"0 0 {ROAD_MAP_STYLE.width:.0f} {frame.height:.0f}",
        role="img",
        tabindex=0,
        aria_label="The road from above with tracks and gates. The counts are in the tables below.",
        class_="chart road",
    )
    drawn = f"{len(chosen)} of {len(tracks)}" if len(chosen) < len(tracks) else f"{len(tracks)}"
    title = f"{drawn} tracks {'from above' if report.metres else 'in the image'}; gates with their counts"
    names = ("vehicles", "two-wheelers", "people", "conflicts")
    keys = [tag("span", class_=f"key road-{k}") + name for k, name in enumerate(names)]
    return piece("figure", title, drawing, keys, wide=True)


def _outline(tracks: Sequence[Track], lines: Sequence[Outline]) -> Array:
    """Return (M, 2) positions that the map must include: all gates, and nearly all tracks near the gates."""
    ends = np.array([end for line in lines for end in line], dtype=np.float64).reshape(-1, 2)
    if not tracks:
        return ends
    every = np.concatenate([track.xy for track in tracks])
    corners = np.percentile(every, [ROAD_MAP_STYLE.outermost_percent, 100 - ROAD_MAP_STYLE.outermost_percent], axis=0)
    if not len(ends):
        return np.asarray(corners)
    low, high = ends.min(axis=0), ends.max(axis=0)
    around = ROAD_MAP_STYLE.around * float((high - low).max())
    return np.concatenate([ends, corners.clip(low - around, high + around)])


def _picture(road: RoadPicture, frame: _Frame) -> Markup:
    (west, north), (east, south) = frame.points([(road.low[0], road.high[1]), (road.high[0], road.low[1])])
    return tag(
        "image",
        href=f"data:image/jpeg;base64,{base64.b64encode(road.jpeg).decode()}",
        x=f"{west:.1f}",
        y=f"{north:.1f}",
        width=f"{east - west:.1f}",
        height=f"{south - north:.1f}",
        preserveAspectRatio="none",
    )


def _marks(report: TrafficReport, frame: _Frame) -> Iterator[Markup]:
    for zone in report.site.zones if report.metres else ():
        yield tag("path", d=frame.path(zone.polygon, closed=True), class_="zone", data_tip=f"zone {zone.name}")
    for lane in report.site.lanes if report.metres else ():
        yield tag("path", d=frame.path(lane.line), class_="lane", data_tip=f"lane {lane.name}")


def _tracks(tracks: Sequence[Track], frame: _Frame) -> Iterator[Markup]:
    faint = max(0.15, min(0.8, 40 / max(1, len(tracks))))
    for track in tracks:
        kind = 0 if track.category == VEHICLE_CATEGORY else 2 if track.category == PEDESTRIAN_CATEGORY else 1
        path = frame.path(track.xy[thinned(track, ROAD_MAP_STYLE.step_s)])
        tip = f"{track.class_name} {track.number}"
        yield tag("path", d=path, class_=f"track road-{kind}", stroke_opacity=f"{faint:.2f}", data_tip=tip)


def _conflicts(report: TrafficReport, frame: _Frame) -> Iterator[Markup]:
    for conflict in report.conflicts.conflicts[: ROAD_MAP_STYLE.most_conflicts]:
        ((x, y),) = frame.points(conflict.position[None])
        measures = [
            f"{name} {value:.1f} s"
            for name, value in (("TTC", conflict.ttc_s), ("PET", conflict.pet_ssam_s))
            if not math.isnan(value)
        ]
        tip = f"conflict at {conflict.time_s:.1f} s: {conflict.first.class_name} {conflict.first.number} and "
        tip += f"{conflict.second.class_name} {conflict.second.number}, {conflict.kind}; {', '.join(measures)}"
        yield tag("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=4, class_="road-3", data_tip=tip)


def _gate(report: TrafficReport, frame: _Frame, name: str, line: Outline) -> Iterator[Markup]:
    """Yield a gate, its name and its counts."""
    (ax, ay), (bx, by) = frame.points(line)
    totals = [
        (row.direction, row.count or 0, in_words(row.confidence_interval))
        for row in report.counts_total
        if row.gate == name and row.class_name == ALL_CLASSES
    ]
    tip = f"{name}: " + "; ".join(f"{direction} {count} ({bounds})" for direction, count, bounds in totals)
    yield tag("path", d=f"M{ax:.1f} {ay:.1f}L{bx:.1f} {by:.1f}", class_="gate", data_tip=tip)
    x, y = (ax + bx) / 2, (ay + by) / 2
    label = f"{name}: {' / '.join(str(count) for _, count, _ in totals)}"
    yield tag("text", label, x=f"{x:.1f}", y=f"{y - 8:.1f}", text_anchor="middle", class_="gate")


def _bar(frame: _Frame) -> Markup:
    """Return the scale bar."""
    length = max(
        bar_m
        for bar_m in ROAD_MAP_STYLE.bars_m
        if bar_m * frame.scale < ROAD_MAP_STYLE.width / 4 or bar_m == ROAD_MAP_STYLE.bars_m[0]
    )
    x, y = ROAD_MAP_STYLE.margin / 2, frame.height - 10
    return tag("path", d=f"M{x} {y - 5}v5h{length * frame.scale:.1f}v-5", class_="scale") + tag(
        "text", f"{length} m", x=x + 4, y=y - 6
    )
