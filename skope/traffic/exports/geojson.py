"""Traffic report as GeoJSON (RFC 7946): gates with their counts, lanes, zones, tracks and conflicts.

Longitude and latitude are in WGS84, so the site must be georeferenced.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.files.atomic import replacing
from skope.files.json_files import json_bytes
from skope.site.gates_zones_lanes import Outline
from skope.site.world import on_earth
from skope.tracks.track import KMH_PER_MPS, Track
from skope.traffic.count_uncertainty import in_json
from skope.traffic.gates import direction_names, may_count
from skope.traffic.length_bins import has_length, length_bin, length_sigma_m
from skope.traffic.otc_classes import OTC_CLASSES
from skope.traffic.report_tables import clock, thinned
from skope.traffic.traffic_report import TrafficReport
from skope.types import Array

GEOJSON_FILE: Final = "traffic.geojson"


@dataclass(frozen=True)
class GeojsonFormat:
    """Digits and least length of a line."""

    degree_digits: int = 7
    """Digits of degrees. The last digit is about 1 cm."""
    least_points: int = 2
    """Smallest number of points of a line."""


GEOJSON_FORMAT: Final = GeojsonFormat()


def write_geojson(folder: Path, report: TrafficReport) -> list[Path]:
    """Write a report as `traffic.geojson`; return the file.

    Raises:
        UserError: The site is not georeferenced (`skope.site.world`).
    """
    path = folder / GEOJSON_FILE
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(b'{"type":"FeatureCollection","features":[')
        separator = b"\n"
        for feature in _features(report):
            file.write(separator + json_bytes(feature).strip())
            separator = b",\n"
        file.write(b"\n]}\n")
    return [path]


def _features(report: TrafficReport) -> Iterator[dict[str, Any]]:
    site = report.site
    for gate in report.gates:
        yield _feature(
            report, "LineString", gate.line, {"kind": "gate", "name": gate.name, **_totals(report, gate.name)}
        )
    for lane in site.lanes:
        yield _feature(report, "LineString", lane.line, {"kind": "lane", "name": lane.name, "width_m": lane.width})
    for zone in site.zones:
        yield _feature(report, "Polygon", zone.polygon, {"kind": "zone", "name": zone.name})
    for track in report.trajectories:
        rows = thinned(track, site.traffic.trajectory_interval_s)
        if may_count(track, site.traffic) and len(rows) >= GEOJSON_FORMAT.least_points:
            yield _feature(report, "LineString", track.xy[rows], _of_track(report, track, rows))
    for conflict in report.conflicts.conflicts:
        yield _feature(
            report,
            "Point",
            conflict.position,
            {
                "kind": "conflict",
                "time": _moment(report, conflict.time_s),
                "time_s": round(conflict.time_s, 3),
                "of": conflict.kind,
                "tracks": [conflict.first.number, conflict.second.number],
                **{
                    name: None if np.isnan(value) else round(float(value), 3)
                    for name, value in (
                        ("ttc_s", conflict.ttc_s),
                        ("ttc_probability", conflict.probability),
                        ("pet_ssam_s", conflict.pet_ssam_s),
                        ("pet_sigma_s", conflict.pet_sigma_s),
                    )
                },
            },
        )


def _totals(report: TrafficReport, gate: str) -> dict[str, Any]:
    """Return the counts of a gate over the whole footage by direction, of all and of vehicles, with intervals."""
    (mark,) = (known_gate for known_gate in report.gates if known_gate.name == gate)
    totals: dict[str, dict[str, Any]] = {}
    for total in report.counts_total:
        if total.gate == gate:
            totals.setdefault(total.direction, {})[total.class_name] = {
                "count": total.count,
                **in_json(total.confidence_interval),
            }
    return {"counts": totals, "from_left_to_right": direction_names(mark)[0]}


def _of_track(report: TrafficReport, track: Track, rows: Sequence[int]) -> dict[str, Any]:
    return {
        "kind": "track",
        "track": track.number,
        "class": track.class_name,
        "class_confidence": round(track.class_confidence, 3),
        "otc_class": OTC_CLASSES[track.class_name],
        **_length(report, track),
        "begin": _moment(report, float(track.times_s[0])),
        "times_s": np.round(track.times_s[rows], 3).tolist(),
        "speed_kmh": np.round(track.speed[rows] * KMH_PER_MPS, 2).tolist(),
        "speed_sigma_kmh": np.round(
            report.observation.with_camera_error(track.during(np.array(rows))).speed_sigma * KMH_PER_MPS, 2
        ).tolist(),
    }


def _length(report: TrafficReport, track: Track) -> dict[str, Any]:
    """Return length, its standard deviation, bin and its probability of a vehicle; empty without a length."""
    if not has_length(track):
        return {}
    common = report.observation.common_scale_sigma
    name, probability = length_bin(track, report.site.traffic.length_bins_m, common)
    return {
        "length_m": track.length,
        "length_sigma_m": round(length_sigma_m(track, common), 3),
        "length_bin": name,
        "length_bin_probability": round(probability, 3),
    }


def _moment(report: TrafficReport, time_s: float) -> str | None:
    moment = clock(report, time_s)
    return None if moment is None else moment.isoformat(timespec="milliseconds")


def _feature(report: TrafficReport, kind: str, places: Outline | Array, properties: dict[str, Any]) -> dict[str, Any]:
    """Return a feature from positions in metres. Polygons are closed and counter-clockwise."""
    points = np.asarray(places, dtype=np.float64)
    if kind == "Polygon":
        x, y = points.T
        if (x * np.roll(y, -1) - np.roll(x, -1) * y).sum() < 0:
            points = points[::-1]
        points = np.concatenate([points, points[:1]])
    degrees = np.round(on_earth(report.site.world, points), GEOJSON_FORMAT.degree_digits).tolist()
    return {
        "type": "Feature",
        "geometry": {"type": kind, "coordinates": [degrees] if kind == "Polygon" else degrees},
        "properties": properties,
    }
