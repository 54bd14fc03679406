"""`skope eval camera`: a camera file from vehicles, or from points that were marked on the ground."""

import csv
import json
import math
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.camera.pose_from_points import fit_camera as fit_to_points
from skope.errors import UserError
from skope.eval.pose import fit_camera
from skope.eval.pose.vehicle_sample import sample
from skope.eval.pose.views import read_scene
from skope.files.output_folders import write_new
from skope.files.reading import read_bytes, read_text

_COLUMNS: Final = ("column", "row", "x", "y", "z")
_UNKNOWN: Final = 0.3
"""Standard deviation of focal length and height, as shares of them, from which a camera is worth nothing."""
_UNKNOWN_TILT: Final = math.radians(10)
"""Angle, radians, of which the standard deviation of the tilt is taken as a share like that of the focal length."""
_WRONG_PX: Final = 3.0
"""Distance of a marked point from where the camera sees it, from which it is to be looked at again."""


def from_vehicles(
    where: tuple[Path | None, Path | None, Path | None],
    count: int,
    *,
    score: float,
    noise: float,
    sigma_px: float | None,
    out: Path,
) -> Iterator[str]:
    """Fit to the vehicles of a folder, or of annotations and predictions, and write `out`; yields what was found."""
    scene = read_scene(*where, None, None)
    drawn = sample(scene, count, score=score, noise=noise, sigma_px=sigma_px)
    fit = fit_camera.fit_camera(drawn.views)
    sigma = {
        "focal": fit.sigma_focal,
        "pitch_deg": math.degrees(fit.sigma_pitch),
        "roll_deg": math.degrees(fit.sigma_roll),
        "height": fit.sigma_height,
    }
    focal, height = fit.camera.K[0, 0], fit.camera.position[2]
    if max(fit.sigma_focal / focal, fit.sigma_height / height, fit.sigma_pitch / _UNKNOWN_TILT) > _UNKNOWN:
        raise UserError(
            f"{scene.file.name}: {fit.vehicles} vehicles do not tell the camera: focal length {focal:.0f} px with a "
            f"standard deviation of {fit.sigma_focal:.0f}, height {height:.1f} m of {fit.sigma_height:.1f}, tilt "
            f"{math.degrees(fit.camera.angles[1]):.1f} degrees of {sigma['pitch_deg']:.1f}; other directions "
            f"and distances may tell it, or marked points (--points)"
        )
    yield from _written(out, fit.camera, {"vehicles": fit.vehicles, "sigma": sigma})
    _, pitch, roll = (math.degrees(angle) for angle in fit.camera.angles)
    yield f"focal length {fit.camera.K[0, 0]:.0f} px, one standard deviation {fit.sigma_focal:.0f}"
    yield f"tilt down {pitch:.2f} deg, {sigma['pitch_deg']:.2f}; roll {roll:.2f} deg, {sigma['roll_deg']:.2f}"
    yield f"height {fit.camera.position[2]:.2f} m, {fit.sigma_height:.2f}; from {fit.vehicles} vehicles"
    if where[0] is not None:
        yield f"next: skope eval track {shlex.quote(str(where[0]))} --camera {shlex.quote(str(out))}"


def from_points(path: Path, size: str | None, out: Path) -> Iterator[str]:
    """Fit to marked points of the world and write `out`; yields what was found."""
    if size is None:
        raise UserError("--size: needed with --points")
    pixels, world = _read_points(path)
    try:
        fit = fit_to_points(pixels, world, _size(size))
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    yield from _written(out, fit.camera, {"points": len(pixels), "rms_px": fit.rms_px})
    yield f"focal length {fit.camera.K[0, 0]:.0f} px; {len(pixels)} points {fit.rms_px:.2f} px off (root mean square)"
    off = np.linalg.norm(fit.camera.project(world)[0] - pixels, axis=1)
    for number, (pixel, place, distance) in enumerate(zip(pixels, world, off, strict=True), start=1):
        where = f"point {number}: pixel ({pixel[0]:g}, {pixel[1]:g}), world ({', '.join(f'{v:g}' for v in place)})"
        yield f"{where}: {distance:.2f} px off{'; wrong?' if distance > _WRONG_PX else ''}"


def doubt(path: Path) -> str | None:
    """How uncertain the camera of a file is that `from_vehicles` wrote, in words; None for other files."""
    try:
        document = json.loads(read_bytes(path))
        sigma = document["sigma"]
        focal, height = sigma["focal"] / document["K"][0][0], sigma["height"]
        return f"{path}: focal length within {focal:.0%}, height within {height:.2f} m (one standard deviation each)"
    except (ValueError, KeyError, TypeError, IndexError, ZeroDivisionError):
        return None


def _written(out: Path, camera: Camera, besides: dict[str, Any]) -> Iterator[str]:
    document = {"width": camera.width, "height": camera.height, **camera.to_dict(), **besides}
    write_new(out, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    yield f"wrote {out}"


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise UserError(f"--size: expected WIDTHxHEIGHT, got {text!r}")
    return int(width), int(height)


def _read_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(N, 2) pixels and (N, 3) metres."""
    reader = csv.DictReader(read_text(path).splitlines())
    missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise UserError(f"{path}: column {missing[0]}: missing; expected {','.join(_COLUMNS)}")
    rows = []
    for number, row in enumerate(reader, start=2):
        try:
            rows.append([float(row[name]) for name in _COLUMNS])
        except (TypeError, ValueError):
            raise UserError(f"{path}: line {number}: expected five numbers") from None
    values = np.array(rows, dtype=np.float64).reshape(-1, len(_COLUMNS))
    if not np.isfinite(values).all():
        raise UserError(f"{path}: not all numbers are finite")
    return values[:, :2], values[:, 2:]
