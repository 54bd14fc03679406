"""Tracks and gates for OTAnalytics: `.ottrk` (bzip2 of JSON) and `.otflow` (JSON).

OTAnalytics counts a point of a box, at a share of its width and height that each section sets. The boxes are written
with zero size, at the position that skope counts. The counted point is then that position for any share, and no unknown
box size is invented. The formats are OTVision tracks 1.1 and OTAnalytics 0.7.
"""

import bz2
import hashlib
import itertools
import json
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.camera.model import Camera
from skope.files.atomic import replacing, write_text
from skope.files.json_files import json_bytes
from skope.tracks.track import Track
from skope.traffic.exports.otanalytics_view import OtView, image_view, pixel_view, plan_view
from skope.traffic.gates import may_count
from skope.traffic.otc_classes import OTC_CLASSES
from skope.traffic.traffic_report import TrafficReport
from skope.version import __version__


@dataclass(frozen=True)
class OtanalyticsFormat:
    """Limits of OTAnalytics' files."""

    most_detections: int = 12_000
    """Maximum number of detections per track. OTAnalytics omits longer tracks, so they are thinned."""
    default_fps: float = 10.0
    """Frame rate of footage with a single frame, frames per second."""
    coordinate_digits: int = 4


OTANALYTICS_FORMAT: Final = OtanalyticsFormat()

HOST_NAME: Final = re.compile(r"[A-Za-z0-9]+_.*")
"""Pattern of footage names from which OTAnalytics takes the name of the camera."""


def write_otanalytics(folder: Path, report: TrafficReport, camera: Camera | None = None) -> list[Path]:
    """Write the tracks and gates of a report for OTAnalytics.

    A report in metres gives `plan.ottrk` and `plan.otflow`: the road from above with its georeference, in which
    OTAnalytics counts in metres. With a camera it also gives `image.ottrk` and `image.otflow`, in the camera's image. A
    report without metres gives only the `image` files. Only tracks that may count are written: confirmed, moving, and
    of the site's classes.

    Args:
        folder: The folder.
        report: The report.
        camera: The camera of the footage, over a road at z = 0; None: not known.

    Returns:
        The files.
    """
    chosen = [track for track in report.trajectories if may_count(track, report.site.traffic)]
    if report.metres:
        views = [plan_view(report.site, report.gates, chosen)]
        views += [] if camera is None else [image_view(report.gates, camera)]
    else:
        views = [pixel_view(report.gates)]
    written = []
    for view in views:
        written += [folder / f"{view.name}.ottrk", folder / f"{view.name}.otflow"]
        _write_tracks(written[-2], report, chosen, view)
        write_text(written[-1], json.dumps(flow_document(report, view), indent=4, ensure_ascii=False) + "\n")
    return written


def _write_tracks(path: Path, report: TrafficReport, tracks: Sequence[Track], view: OtView) -> None:
    """Write the detections one by one, because a few hours have millions."""
    head = json_bytes(_metadata(report, view))
    with replacing(path) as temporary, bz2.open(temporary, "wb") as file:
        file.write(b'{"metadata":' + head + b',"data":{"detections":[')
        separator = b"\n"
        for track in tracks:
            for detection in _detections(track, report, view):
                file.write(separator + json_bytes(detection))
                separator = b",\n"
        file.write(b"\n]}}\n")


def _metadata(report: TrafficReport, view: OtView) -> dict[str, Any]:
    observation = report.observation
    times = observation.times_s
    fps = 1 / float(np.median(np.diff(times))) if len(times) > 1 else OTANALYTICS_FORMAT.default_fps
    start = _epoch(report) + (float(times[0]) if len(times) else 0.0)
    seconds = float(times[-1] - times[0]) + 1 / fps if len(times) else 0.0
    name = Path(observation.source or "footage.mp4")
    size = {} if view.size is None else dict(zip(("width", "height"), view.size, strict=True))
    run = hashlib.sha256(
        json_bytes([str(name), start, np.round(times, OTANALYTICS_FORMAT.coordinate_digits).tolist()])
    ).hexdigest()
    return {
        "otdet_version": "1.4",
        "ottrk_version": "1.1",
        "video": {
            "filename": name.stem if HOST_NAME.fullmatch(name.stem) else f"skope_{name.stem}",
            "filetype": name.suffix or ".mp4",
            **size,
            "recorded_fps": fps,
            "actual_fps": fps,
            "number_of_frames": len(times),
            "recorded_start_date": start,
            "length": _duration(seconds),
            "expected_duration": math.ceil(seconds),
        },
        "detection": {
            "otvision_version": f"skope {__version__}",
            "model": {"name": "skope", "classes": {str(k): name for k, name in enumerate(OTC_CLASSES.values())}},
        },
        # This id distinguishes tracks of several files.
        "tracking": {"otvision_version": f"skope {__version__}", "tracking_run_id": run[:12], "frame_group": "0"},
        **({} if view.georeference is None else {"georeference": view.georeference}),
    }


def _detections(track: Track, report: TrafficReport, view: OtView) -> Iterator[dict[str, Any]]:
    """Yield the detections of a track inside the image of the view."""
    places = view.pixels(track.xy)
    rows = np.flatnonzero(view.inside(places))
    rows = rows[:: math.ceil(len(rows) / OTANALYTICS_FORMAT.most_detections) or 1].tolist()
    frames = 1 + _nearest(report.observation.times_s, track.times_s)
    geo = None if view.geo is None else np.round(view.geo(track.xy), OTANALYTICS_FORMAT.coordinate_digits).tolist()
    pixels = np.round(places, OTANALYTICS_FORMAT.coordinate_digits).tolist()
    start = _epoch(report)
    for row in rows:
        yield {
            "class": OTC_CLASSES[track.class_name],
            "confidence": track.class_confidence,
            "x": pixels[row][0],
            "y": pixels[row][1],
            "w": 0,
            "h": 0,
            "frame": int(frames[row]),
            "occurrence": start + float(track.times_s[row]),
            "interpolated-detection": not track.located[row],
            "first": row == rows[0],
            "finished": row == rows[-1],
            "track-id": track.number,
            **({} if geo is None else {"geo_x": geo[row][0], "geo_y": geo[row][1]}),
        }


def flow_document(report: TrafficReport, view: OtView) -> dict[str, Any]:
    """Return the content of an `.otflow`: gates of a view as lines, and their ordered pairs as flows.

    A gate has a flow to itself if a road user turned around there.
    """
    settings = report.site.traffic
    sections = []
    numbers: dict[str, str] = {}
    for number, (gate, line) in enumerate(view.gates, start=1):
        if settings.turning is None or gate.name in settings.turning:
            numbers[gate.name] = str(number)
        sections.append(
            {
                "id": str(number),
                "name": gate.name,
                "type": "line",
                "relative_offset_coordinates": {"section-enter": {"x": 0.5, "y": 0.5}},
                "coordinates": [
                    {
                        "x": round(x, OTANALYTICS_FORMAT.coordinate_digits),
                        "y": round(y, OTANALYTICS_FORMAT.coordinate_digits),
                    }
                    for x, y in line
                ],
                "plugin_data": {},
            }
        )
    turned = {(movement.origin[0], movement.destination[0]) for movement in report.turning_total}
    flows = [
        {"id": str(number), "name": f"{a} -> {b}", "start": numbers[a], "end": numbers[b], "distance": None}
        for number, (a, b) in enumerate(
            ((a, b) for a, b in itertools.product(numbers, repeat=2) if a != b or (a, b) in turned), start=1
        )
    ]
    return {"sections": sections, "flows": flows}


def _epoch(report: TrafficReport) -> float:
    """Return the time of second 0 of the footage, seconds since 1970 (UTC); 0 if it is not known."""
    return 0.0 if report.start is None else report.start.timestamp()


def _nearest(times_s: Any, wanted_s: Any) -> Any:
    """Return (M,) indices of the nearest of increasing times (F,); 0 without times."""
    if not len(times_s):
        return np.zeros(len(wanted_s), dtype=np.int64)
    after = np.searchsorted(times_s, wanted_s).clip(1, max(1, len(times_s) - 1))
    before = after - 1
    after = after.clip(max=len(times_s) - 1)
    return np.where(wanted_s - times_s[before] < times_s[after] - wanted_s, before, after)


def _duration(seconds: float) -> str:
    whole = math.ceil(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
