"""Tracks in the files of others: CSV for tables, MOTChallenge for trackers' metrics, SUMO's floating-car data for
traffic."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Final
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from skope.eval.track import Track
from skope.files import write_text

_COLUMNS: Final = (
    *("track", "type", "frame", "time_s", "seen", "x", "y", "z", "heading_deg", "speed", "vx", "vy", "acceleration"),
    *("length", "width", "height"),
)
_SUMO_CLASS: Final = {"bus": "bus", "truck": "truck", "box_truck": "delivery", "van": "delivery"}


def write_csv(path: Path, tracks: Sequence[Track], frame_index: Sequence[int]) -> None:
    """One row a frame and vehicle: metres, seconds, m/s, m/s^2, degrees counter-clockwise from world x."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for track in tracks:
        for i, frame in enumerate(track.frames):
            sight = track.sights[i]
            writer.writerow(
                [
                    track.number,
                    track.kind,
                    frame_index[frame],
                    f"{track.times_s[i]:.4f}",
                    int(sight is not None),
                    *(f"{v:.3f}" for v in track.position[i]),
                    f"{math.degrees(track.heading[i]):.2f}",
                    f"{track.speed[i]:.3f}",
                    *(f"{v:.3f}" for v in track.velocity[i]),
                    f"{track.along[i]:.3f}",
                    *(f"{v:.2f}" for v in track.size_lwh),
                ]
            )
    write_text(path, text.getvalue())


def mot_row(frame: int, number: int, bbox: ArrayLike, rest: str) -> str:
    """A line of MOTChallenge: frame from 1, id, left, top, width, height, and what follows."""
    x, y, w, h = np.asarray(bbox, dtype=np.float64)
    return f"{frame},{number},{x:.2f},{y:.2f},{w:.2f},{h:.2f},{rest}\n"


def write_mot(path: Path, tracks: Sequence[Track]) -> None:
    """The boxes of what was seen, as MOTChallenge and TrackEval read them: with confidence and no place in the world.

    TrackEval takes the column of the place's x for a class.
    """
    rows = []
    for track in tracks:
        for i, sight in enumerate(track.sights):
            if sight is not None:
                row = mot_row(int(track.frames[i]) + 1, track.number, sight.bbox, f"{sight.score:.4f},-1,-1,-1")
                rows.append((int(track.frames[i]), row))
    write_text(path, "".join(row for _, row in sorted(rows, key=lambda pair: pair[0])))


def write_fcd(path: Path, tracks: Sequence[Track], times_s: Sequence[float]) -> None:
    """SUMO's floating-car data (`fcd-export`), in the network's coordinates.

    There a vehicle's position is the middle of its front bumper and its angle compass degrees: 0 north, clockwise.
    """
    steps: list[list[str]] = [[] for _ in times_s]
    for track in tracks:
        kind = _SUMO_CLASS.get(track.kind, "passenger")
        for i, frame in enumerate(track.frames):
            heading = track.heading[i]
            x, y = track.position[i, :2] + track.size_lwh[0] / 2 * np.array([math.cos(heading), math.sin(heading)])
            values = {
                "id": str(track.number),
                "x": f"{x:.3f}",
                "y": f"{y:.3f}",
                "z": f"{track.position[i, 2]:.3f}",
                "angle": f"{(90 - math.degrees(heading)) % 360:.2f}",
                "type": kind,
                "speed": f"{track.speed[i]:.3f}",
                "acceleration": f"{track.along[i]:.3f}",
            }
            cells = " ".join(f"{name}={quoteattr(value)}" for name, value in values.items())
            steps[frame].append(f"        <vehicle {cells}/>\n")
    body = "".join(
        f'    <timestep time="{time:.3f}">\n{"".join(rows)}    </timestep>\n'
        for time, rows in zip(times_s, steps, strict=True)
    )
    write_text(path, f'<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n{body}</fcd-export>\n')
