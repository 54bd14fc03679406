"""Layout of the published dataset: one zip per scene, with its video and two CSV files per vehicle and frame.

    scene_K/original.avi
    scene_K/<frame>/keypoint_<v>.csv    row 0: the crop's origin x, y; rows 1-2: the box's corners; then 33 rows x, y,
                                        visible, relative to the crop's origin; rows 0 to 2 may have a third value, 0
                                        or -1, as in an array that is written at once
    scene_K/<frame>/metadata_<v>.csv    row 0: track id, model id; rows 1-8: the 3D box's corners x, y

All values are in pixels of the image. Error messages name the archive, the file and the line.
"""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from skope.errors import UserError
from skope.files.atomic import decoded
from skope.files.safe_names import counting_order
from skope.files.safe_names import name as check_name
from skope.gen.formats.source_files import Archive
from skope.keypoints import K
from skope.types import Array

VIDEO_MEMBER: Final = "original.avi"

_CSV_BYTES: Final = 1 << 16
MEMBER_NAME: Final = re.compile(r"([^/]+)/(\d+)/(keypoint|metadata)_([^/]+)\.csv")
FILLING_VALUE: Final = re.compile(r"(0|-1)(\.0*)?")
_FRAME_NAME: Final = re.compile(r"[^/]+/(\d+)")


@dataclass(frozen=True, eq=False)
class ArchiveVehicle:
    """Vehicle in one frame, as in its files, in pixels of the image."""

    box_xyxy: Array
    points: Array
    """(33, 3) x, y and visibility of the keypoints."""
    track_id: int
    model: str
    corners: Array
    """(8, 2) corners of the 3D box."""


@dataclass(frozen=True)
class ArchiveScene:
    """Content of an archive; its vehicles are not read yet."""

    archive: Archive
    name: str
    frames: Mapping[int, tuple[tuple[str, str], ...]]
    """Frame to the names of each vehicle's keypoint and metadata file."""

    def vehicles(self, frame: int) -> list[ArchiveVehicle]:
        return [_vehicle(self.archive, *names) for names in self.frames[frame]]


def archives(sources: Sequence[Path]) -> list[Path]:
    """Return the archives among files and in folders, scene_2 before scene_10."""
    found = [path for source in sources for path in (source.glob("*.zip") if source.is_dir() else [source])]
    if not found:
        raise UserError(f"{', '.join(map(str, sources))}: no scene_K.zip there")
    return sorted(dict.fromkeys(found), key=counting_order)


def scene_of(archive: Archive) -> ArchiveScene:
    """Read the scene of an archive.

    Raises:
        UserError: The video, the folder of the scene, or a file of a vehicle is missing. The module's docstring shows
            the layout.
    """
    found: dict[int, dict[str, dict[str, str]]] = {}
    names = set()
    for member in archive.names:
        match = MEMBER_NAME.fullmatch(member)
        if match:
            scene, frame, kind, vehicle = match.groups()
            names.add(scene)
            found.setdefault(int(frame), {}).setdefault(vehicle, {})[kind] = member
        elif member.endswith(f"/{VIDEO_MEMBER}") and member.count("/") == 1:
            names.add(member.split("/")[0])
    for folder in archive.folders:  # frames without a vehicle
        match = _FRAME_NAME.fullmatch(folder)
        if match:
            found.setdefault(int(match[1]), {})
    if len(names) != 1:
        raise UserError(f"{archive.path}: expected one folder with {VIDEO_MEMBER} and frames, got {len(names)}")
    (name,) = names
    check_name(f"{archive.path}: folder", name)
    if f"{name}/{VIDEO_MEMBER}" not in archive:
        raise UserError(f"{archive.path}: has no member {name}/{VIDEO_MEMBER}")
    if not found:
        raise UserError(f"{archive.path}: {name} has no frames")
    frames = {}
    for frame, vehicles in sorted(found.items()):
        for vehicle, kinds in vehicles.items():
            for kind in ("keypoint", "metadata"):
                if kind not in kinds:
                    raise UserError(f"{archive.path}: {name}/{frame}: vehicle {vehicle} has no {kind} file")
        ordered = sorted(vehicles, key=lambda v: (len(v), v))
        frames[frame] = tuple((vehicles[v]["keypoint"], vehicles[v]["metadata"]) for v in ordered)
    return ArchiveScene(archive, name, frames)


def _vehicle(archive: Archive, keypoint: str, metadata: str) -> ArchiveVehicle:
    rows = _rows(archive, keypoint, 3 + K)
    rows[:3] = map(_unfilled, rows[:3])
    origin = _numbers(archive, keypoint, rows, slice(0, 1), 2)[0]
    corners = _numbers(archive, keypoint, rows, slice(1, 3), 2)
    points = _numbers(archive, keypoint, rows, slice(3, None), 3)
    if not np.isin(points[:, 2], (0, 1)).all():
        line = 4 + int(np.flatnonzero(~np.isin(points[:, 2], (0, 1)))[0])
        raise UserError(f"{archive.path}: {keypoint}: line {line}: visible is 0 or 1, got {points[line - 4, 2]:g}")
    box = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
    if (box[2:] <= box[:2]).any():
        raise UserError(f"{archive.path}: {keypoint}: lines 2 and 3: the box is empty")
    placed = (points != 0).any(axis=1)
    points[:, :2] += origin
    points[~placed] = 0
    rows = _rows(archive, metadata, 9)
    track, model = _cells(archive, metadata, rows, 0, 2)
    if not re.fullmatch(r"\d{1,18}(\.0*)?", track):
        raise UserError(f"{archive.path}: {metadata}: line 1: expected a track id from 0, got {track[:40]!r}")
    return ArchiveVehicle(
        box, points, int(track.split(".")[0]), model, _numbers(archive, metadata, rows, slice(1, None), 2)
    )


def _rows(archive: Archive, member: str, count: int) -> list[list[str]]:
    try:
        text = decoded(archive.read(member, _CSV_BYTES))
        rows = list(csv.reader(io.StringIO(text), strict=True))
    except (UnicodeDecodeError, csv.Error):
        raise UserError(f"{archive.path}: {member}: not a CSV file") from None
    while rows and not any(cell.strip() for cell in rows[-1]):
        rows.pop()
    if len(rows) != count:
        raise UserError(f"{archive.path}: {member}: expected {count} rows, got {len(rows)}")
    return rows


def _unfilled(row: list[str]) -> list[str]:
    """Return a row of two values without the 0 or -1 that fills the third column of an array."""
    return row[:2] if len(row) == 3 and FILLING_VALUE.fullmatch(row[2].strip()) else row


def _cells(archive: Archive, member: str, rows: list[list[str]], row: int, count: int) -> list[str]:
    cells = [cell.strip() for cell in rows[row]]
    # Tables that were written as a whole have the same number of cells in every row.
    if len(cells) < count or any(cells[count:]) or not all(cells[:count]):
        raise UserError(f"{archive.path}: {member}: line {row + 1}: expected {count} values, got {','.join(cells)!r}")
    return cells[:count]


def _numbers(archive: Archive, member: str, rows: list[list[str]], part: slice, count: int) -> Array:
    out = []
    for row in range(len(rows))[part]:
        cells = _cells(archive, member, rows, row, count)
        try:
            values = [float(cell) for cell in cells]
        except ValueError:
            values = [np.nan]
        if not np.isfinite(values).all():
            raise UserError(f"{archive.path}: {member}: line {row + 1}: expected numbers, got {','.join(cells)!r}")
        out.append(values)
    return np.array(out)
