"""`skope eval camera --points`: write a camera file from marked points, or from all marks of a site file."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.camera.calibrate import LeftOutError, SiteCalibration, calibrate, left_out_errors
from skope.camera.evidence import Evidence
from skope.camera.fit.write_camera import camera_figures, write_camera
from skope.camera.point_files import read_points
from skope.camera.uncertain_camera import UncertainCamera
from skope.errors import UserError
from skope.site.site_file import read_site
from skope.terminal.console import counted
from skope.types import Array


@dataclass(frozen=True)
class MarkReportLimits:
    """Distances and limits of the report on a camera from marks."""

    distances_m: tuple[float, ...] = (10.0, 20.0, 40.0, 60.0, 100.0)
    """Distances from the camera's foot at which position errors are reported, metres."""
    useless_share: float = 0.25
    """Maximum reported error, as a share of the distance."""
    doubtful_sigmas: float = 3.0
    """Minimum residual, in standard deviations, at which the report asks to check a point."""


MARK_REPORT: Final = MarkReportLimits()

SECTOR_ANGLES: Final = np.linspace(-math.pi / 2, math.pi / 2, 61)
"""Directions around the camera's foot, radians."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Marked:
    evidence: Evidence
    when: datetime
    world: Mapping[str, Any] | None
    notes: Sequence[str]


def camera_from_marks(path: Path, size: str | None, out: Path) -> Iterator[str]:
    """Calibrate with the marks of a file, write `out`, and yield lines that report the result. Heights are over z = 0.

    Args:
        path: A site file (`.toml`) with [calibration], or a file of points (`skope.camera.point_files`).
        size: "WIDTHxHEIGHT" of the marked image; None: from the site file.
        out: Camera file to write.

    Raises:
        UserError: A file is malformed, or the marks do not determine a camera.
    """
    marked = _read(path, size)
    try:
        found = calibrate(marked.evidence)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    left_out = left_out_errors(marked.evidence, found)
    points = _points(marked.evidence, found, left_out)
    rms = math.sqrt(np.mean([row["off_px"] ** 2 for row in points if not row["outlier"]])) if points else None
    counts = {"points": len(points)} if points else {}
    extra_fields = {
        "covariance": found.covariance_dict(),
        "calibrated": {"when": marked.when.isoformat(), "from": _from(path, marked.evidence)},
        **({"world": dict(marked.world)} if marked.world else {}),
        **counts,
        **({"rms_px": rms} if rms is not None else {}),
        "outliers": list(found.outliers),
        "warnings": list(found.warnings),
        "residuals": [
            {"kind": residual.kind, "name": residual.name, "value": residual.value, "sigmas": residual.sigmas}
            for residual in found.residuals
        ],
        **({"marked_points": points} if points else {}),
    }
    yield from write_camera(out, found.camera, extra_fields)
    if rms is not None:
        yield f"{counted(len(points), 'point')} {rms:.2f} px off (root mean square)"
    yield from _figures(found)
    yield position_errors(found)
    yield from (_point_line(row) for row in points)
    yield from (
        f"{residual.kind} {residual.name}: {residual.value:.2f} {_RESIDUAL_UNITS[residual.kind]} off"
        for residual in found.residuals
        if residual.kind in _RESIDUAL_UNITS
    )
    yield from (f"warning: {words}" for words in (*marked.notes, *found.warnings))


def evidence_of(path: Path, size: str | None) -> Evidence:
    """Return the marks of a file. Raises UserError if the file is malformed."""
    return _read(path, size).evidence


_RESIDUAL_UNITS: Final = {"length": "m", "parallel lines": "deg", "vertical": "px"}


def _read(path: Path, size: str | None) -> _Marked:
    shape = image_size(size) if size else None
    if path.suffix.lower() == ".toml":
        site = read_site(path)
        if site.calibration is None:
            raise UserError(f"{path}: calibration: missing")
        try:
            evidence = site.calibration.evidence(shape)
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
        return _Marked(
            evidence=evidence,
            when=site.calibration.when or _saved(path),
            world=site.world,
            notes=tuple(f"{path.name}: {key}: unknown; not used" for key in site.unknown),
        )
    if shape is None:
        raise UserError("--size: needed with --points")
    read = read_points(path)
    return _Marked(evidence=Evidence(shape, points=read.points), when=_saved(path), world=read.world, notes=read.notes)


def image_size(text: str) -> tuple[int, int]:
    """Return width and height of "WIDTHxHEIGHT"."""
    width, _, height = text.partition("x")
    right = all(part.isascii() and part.isdecimal() and len(part) <= 5 and int(part) for part in (width, height))
    if not right:
        raise UserError(f"--size: expected WIDTHxHEIGHT, got {text!r}")
    return int(width), int(height)


def _saved(path: Path) -> datetime:
    """Return the modification time of the file, as the time at which the marks were made."""
    return datetime.fromtimestamp(int(path.stat().st_mtime), UTC)


def _from(path: Path, evidence: Evidence) -> str:
    kinds = [
        (len(evidence.points), "point"),
        (len(evidence.lengths), "length"),
        (len(evidence.parallels), "group of parallel lines"),
        (len(evidence.verticals), "vertical"),
    ]
    parts = [
        f"{n} groups of parallel lines" if "group" in kind and n > 1 else counted(n, kind) for n, kind in kinds if n
    ]
    parts += [prior.name for prior in evidence.priors]
    return f"{path.name}: {', '.join(parts)}"


def _points(evidence: Evidence, found: SiteCalibration, left_out: Mapping[str, LeftOutError]) -> list[dict[str, Any]]:
    """Return each point with its residual and its leave-one-out error."""
    rows = []
    for point in evidence.points:
        seen = found.camera.project(point.place)[0]
        row: dict[str, Any] = {
            "name": point.name,
            "pixel": point.pixel.tolist(),
            "place": point.place.tolist(),
            "off_px": float(np.linalg.norm(seen - point.pixel)) if np.isfinite(seen).all() else math.inf,
            "outlier": point.name in found.outliers,
        }
        error = left_out.get(point.name)
        if error is not None and math.isfinite(error.error_m) and math.isfinite(error.stated_m):
            row["left_out"] = {"error_m": error.error_m, "stated_m": error.stated_m}
        rows.append(row)
    return rows


def _figures(found: SiteCalibration) -> Iterator[str]:
    def sigma(name: str) -> float:
        if name not in found.parameters:
            return 0.0
        k = found.parameters.index(name)
        return math.sqrt(found.covariance[k, k])

    focal = float(found.camera.K[0, 0])
    _, pitch, roll = found.camera.angles
    yield from camera_figures(
        focal=(focal, focal * sigma("focal")),
        pitch=(pitch, sigma("pitch")),
        roll=(roll, sigma("roll")),
        height=(float(found.camera.position[2]), sigma("z")),
    )


def position_errors(found: UncertainCamera) -> str:
    """Return a sentence on the largest position error on the road at several distances from the camera."""
    yaw, foot = found.camera.angles[0], found.camera.position[:2]
    parts, farthest = [], ""
    for distance in MARK_REPORT.distances_m:
        pixels = _seen_at(found, yaw, foot, distance)
        if not len(pixels):
            continue
        error = float(np.max(np.nan_to_num(found.place_error(pixels), nan=math.inf)))
        if error > MARK_REPORT.useless_share * distance:
            farthest = f"; from {distance:g} m on the error exceeds a quarter of the distance"
            break
        parts.append(f"{error:.2g} m at {distance:g} m")
    if not parts:
        return f"positions on the road are not known (90%){farthest}"
    return f"position errors on the road (90%): {', '.join(parts)} from the camera{farthest}"


def _seen_at(found: UncertainCamera, yaw: float, foot: Array, distance: float) -> Array:
    """Return (N, 2) pixels of visible positions at a distance from the camera's foot."""
    angles = yaw + SECTOR_ANGLES
    ring = np.column_stack([foot + distance * np.column_stack([np.cos(angles), np.sin(angles)]), np.zeros(len(angles))])
    pixels, _, valid = found.camera.project(ring)
    return np.asarray(pixels[valid & found.camera.inside(pixels)])


def _point_line(row: Mapping[str, Any]) -> str:
    (u, v), position = row["pixel"], ", ".join(f"{value:g}" for value in row["place"])
    line = f"point {row['name']}: pixel ({u:g}, {v:g}), world ({position}): {row['off_px']:.2f} px off"
    if "left_out" in row:
        error = row["left_out"]
        line += f"; located by the others {error['error_m']:.2f} m off ({error['stated_m']:.2f} m stated)"
    return f"{line}; wrong?" if row["outlier"] else line
