"""Data for counting manually in the page while the footage plays.

The data are gates, observed times and crossings. Each crossing is the time since the previous crossing in whole
milliseconds, followed by the letter of its class: about five bytes.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from skope.camera.model import Camera
from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TRAFFIC_CLASSES, UNKNOWN_CLASS
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.exports.otanalytics_view import OtView, image_view, pixel_view
from skope.traffic.gate_counts import ALL_CLASSES
from skope.traffic.gates import direction_names, normal_of
from skope.traffic.speeds import MOTOR_CLASSES, MOTOR_TRAFFIC
from skope.traffic.traffic_report import TrafficReport
from skope.types import Array

CLASS_LETTERS: Final[Mapping[str, str]] = {name: chr(ord("a") + k) for k, name in enumerate(TRAFFIC_CLASSES)}
"""Letter of each class."""


@dataclass(frozen=True)
class ManualCountPage:
    """Limits and sizes of the page of manual counts."""

    most_crossings: int = 100_000
    """Maximum number of crossings on the page (about 0.6 MB). With more, the page has none."""
    arrow_m: float = 3.0
    """Length of the arrow of a direction on the road, metres."""
    arrow_px: float = 20.0
    """Length of the arrow of a direction in the image, pixels."""
    pixel_digits: int = 1
    """Digits of pixels."""


MANUAL_COUNT_PAGE: Final = ManualCountPage()


def manual_count_data(report: TrafficReport, camera: Camera | None) -> dict[str, Any]:
    """Return the data for the page's script as JSON values.

    Args:
        report: The report.
        camera: The camera of the footage; None if it is not known. Gates of a report in metres are then not drawn over
            the video.
    """
    sides = [(gate.name, name) for gate in report.gates for name in direction_names(gate)]
    turning = report.site.traffic.turning
    start = None if report.start is None else report.start.isoformat()
    recordings = _recordings(report)
    identity = json.dumps([recordings[0]["source"], start, sides])
    return {
        "key": hashlib.sha256(identity.encode()).hexdigest()[:16],
        "sides": [
            {"gate": gate, "direction": name, "moves": turning is None or gate in turning} for gate, name in sides
        ],
        "kinds": _kinds(report),
        "recordings": recordings,
        "spans": np.round(report.observation.spans, 3).tolist(),
        "clocks": list(_clocks(report.intervals)),
        "step_s": _step(report.observation.times_s),
        "view": view_of_gates(report, camera),
        **_machine(report, sides),
    }


def _kinds(report: TrafficReport) -> list[list[str]]:
    """Return the names of the groups that can be counted, and the letters of the classes in each group."""
    classes = report.site.traffic.classes
    whole = {
        ALL_CLASSES: frozenset(TRAFFIC_CLASSES),
        MOTOR_TRAFFIC: MOTOR_CLASSES,
        **{name: frozenset({name}) for name in classes},
    }
    return [
        [name, "".join(CLASS_LETTERS[class_name] for class_name in TRAFFIC_CLASSES if class_name in members)]
        for name, members in whole.items()
        if name != UNKNOWN_CLASS and members & set(classes)
    ]


def _recordings(report: TrafficReport) -> list[dict[str, Any]]:
    """Return the name, begin and end of each recording; times are seconds of the report."""
    parts = report.observation.parts or (report.observation,)
    begins = [recording.begin_s for recording in report.recordings] or [0.0]
    names = [recording.source for recording in report.recordings] or [report.observation.source]
    return [
        {"source": name, "begin_s": round(begin, 3), "end_s": round(part.extent[1], 3)}
        for name, begin, part in zip(names, begins, parts, strict=True)
    ]


def _clocks(intervals: Sequence[ClockInterval]) -> Iterable[list[float]]:
    """Yield pairs of a second of the footage and the second of the day: at the start and at each clock change."""
    offset: object = None
    for interval in intervals:
        if interval.begin is not None and interval.begin.utcoffset() != offset:
            offset = interval.begin.utcoffset()
            yield [round(interval.begin_s, 3), _second_of_day(interval.begin)]


def _second_of_day(time: datetime) -> float:
    return round(time.hour * 3600 + time.minute * 60 + time.second + time.microsecond / 1e6, 3)


def _step(times_s: Array) -> float:
    """Return the usual time between frames, seconds."""
    return round(float(np.median(np.diff(times_s))), 4) if len(times_s) > 1 else 0.1


def view_of_gates(report: TrafficReport, camera: Camera | None) -> dict[str, Any] | None:
    """Return the gates in the camera's image as JSON values, pixels.

    Args:
        report: The report.
        camera: The camera of a report in metres; None: not known.

    Returns:
        `size` (width and height, None if not known), and `gates` with name, line and arrow of the first direction of
        each visible gate. None for a report in metres without a camera.
    """
    if report.metres and camera is None:
        return None
    view = pixel_view(report.gates) if camera is None or not report.metres else image_view(report.gates, camera)
    lines = {gate.name: line for gate, line in view.gates}
    gates = [
        {
            "gate": gate.name,
            "line": np.round(np.array(lines[gate.name]), MANUAL_COUNT_PAGE.pixel_digits).tolist(),
            "arrow": _arrow(gate, view, MANUAL_COUNT_PAGE.arrow_m if report.metres else MANUAL_COUNT_PAGE.arrow_px),
        }
        for gate in report.gates
        if gate.name in lines
    ]
    return {"size": view.size, "gates": gates}


def _arrow(gate: Gate, view: OtView, length: float) -> list[list[float]] | None:
    """Return the arrow from the left of a gate to its right, pixels; None if it is not visible."""
    middle = np.mean(np.array(gate.line), axis=0)
    ends = view.pixels(np.stack([middle + length * normal_of(gate), middle - length * normal_of(gate)]))
    return np.round(ends, MANUAL_COUNT_PAGE.pixel_digits).tolist() if np.isfinite(ends).all() else None


def _machine(report: TrafficReport, sides: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Return crossings of each gate and direction, and movements between them; None for too many crossings."""
    if len(report.crossings) > MANUAL_COUNT_PAGE.most_crossings:
        return {"crossings": None, "movements": None}
    numbers = {side: k for k, side in enumerate(sides)}
    crossed: list[list[tuple[float, str]]] = [[] for _ in sides]
    for crossing in report.crossings:
        crossed[numbers[crossing.gate, crossing.direction_name]].append(
            (crossing.time_s, crossing.trajectory.class_name)
        )
    moved: dict[tuple[int, int], list[tuple[float, str]]] = {}
    for way in report.movements:
        if way.origin is not None and way.destination is not None:
            origin, destination = way.sides
            pair = numbers[origin], numbers[destination]
            moved.setdefault(pair, []).append((way.time_s, way.trajectory.class_name))
    return {
        "crossings": [packed_times(events) for events in crossed],
        "movements": [[*pair, packed_times(events)] for pair, events in sorted(moved.items())],
    }


def packed_times(events: Iterable[tuple[float, str]]) -> str:
    """Return times (seconds) and classes as text: milliseconds since the previous event, and the letter of the class.

    Milliseconds are rounded down so that an event before a whole second stays before it.
    """
    out, last = [], 0
    for time_s, class_name in sorted(events):
        now = math.floor(time_s * 1000 + 1e-6)
        out.append(f"{now - last}{CLASS_LETTERS[class_name]}")
        last = now
    return "".join(out)


def manual_count_json(report: TrafficReport, camera: Camera | None = None) -> Markup | None:
    """Return `manual_count_data` as JSON text; None if the report has no gates or the footage no frames."""
    if not report.gates or not len(report.observation.spans):
        return None
    # Escape "<", so that no name can close the script element.
    return Markup(json.dumps(manual_count_data(report, camera), separators=(",", ":")).replace("<", "\\u003c"))
