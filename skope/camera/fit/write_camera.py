"""`skope eval camera`: write a camera file from vehicles, report it, and correct its scale with known lengths.

The mean vehicle size of a country cannot be measured in an image, and every distance scales with it. A length measured
on the road (a dash, a lane's width, a kerb) corrects the scale.
"""

import json
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from skope.camera.fit import fit_camera
from skope.camera.fit.bundle_adjustment import Known
from skope.camera.fit.camera_doubts import rejection_reason, sigma_of_ways
from skope.camera.fit.camera_unknowns import FOCAL, HEIGHT, RAY_LIMITS, UNKNOWN_NAMES, camera_of_unknowns, on_road
from skope.camera.fit.fit_camera import CameraEstimate
from skope.camera.fit.vehicle_sample import sample_vehicles
from skope.camera.model import Camera
from skope.camera.uncertain_camera import slopes
from skope.confidence_level import INTERVAL_SIGMAS
from skope.dataset.folder import PIXEL_WIDTH
from skope.errors import UserError
from skope.files.output_folders import write_new
from skope.pose.keypoint_views import Scene
from skope.terminal.console import counted
from skope.types import Array


@dataclass(frozen=True)
class KnownLengthErrors:
    """Errors of lengths and camera properties given by the user."""

    end_px: float = 1.0
    """Standard deviation of a marked end of a length, pixels per axis."""
    length_share: float = 0.01
    """Relative standard deviation of a measured length."""
    contradiction: float = 3.0
    """Difference between a length and its estimate from vehicles, in standard deviations, at which the length is
    rejected."""
    step_px: float = 0.1
    """Step of numerical derivatives, pixels."""
    property_share: float = 0.02
    """Relative standard deviation of a given height or field of view."""


LENGTH_ERRORS: Final = KnownLengthErrors()


@dataclass(frozen=True, eq=False)
class KnownLength:
    """Straight line of known length on the road."""

    ends: Array
    """(2, 2) column and row of both ends, pixels."""
    metres: float

    def log_under(self, unknowns: Array, size: tuple[int, int]) -> Array:
        """Return the logarithm of the length under the camera with the unknowns (5,)."""
        begin, end = on_road(camera_of_unknowns(unknowns, size), self.ends)
        return np.asarray(np.log(np.linalg.norm(end - begin) + 1e-9))


def corrected(estimate: CameraEstimate, lengths: Sequence[KnownLength]) -> CameraEstimate:
    """Correct an estimate with known lengths, each as a measurement of a Kalman filter.

    Raises:
        UserError: A length contradicts the vehicles, or an end lies at the horizon.
    """
    unknowns, covariance = estimate.solved.bundle.camera, estimate.covariance
    size = estimate.views.size
    for length in lengths:
        says = float(length.log_under(unknowns, size))
        slope = slopes(partial(length.log_under, size=size), unknowns, RAY_LIMITS.step)
        across = covariance @ slope
        variance = float(slope @ across) + _variance(length, unknowns, size)
        away = math.log(length.metres) - says
        if not abs(away) < LENGTH_ERRORS.contradiction * math.sqrt(variance):
            (a, b), (c, d) = length.ends.tolist()
            raise UserError(
                f"--length {a:g},{b:g},{c:g},{d:g},{length.metres:g}: under the camera from the vehicles this is "
                f"{math.exp(says):.3g} m: it is not on the road, the road is not a plane, or a number is wrong"
            )
        unknowns = unknowns + across * away / variance
        covariance = covariance - np.outer(across, across) / variance
    solved = estimate.solved
    shared = np.concatenate([unknowns, solved.bundle.shared[len(unknowns) :]])
    return replace(
        estimate,
        camera=camera_of_unknowns(unknowns, size),
        solved=replace(solved, bundle=replace(solved.bundle, shared=shared)),
        covariance=covariance,
    )


def _variance(length: KnownLength, unknowns: Array, size: tuple[int, int]) -> float:
    """Return the variance of the logarithm of a length, from marking and measuring."""

    def marked(ends: Array) -> Array:
        return replace(length, ends=ends.reshape(2, 2)).log_under(unknowns, size)

    by_ends = slopes(marked, length.ends.ravel(), LENGTH_ERRORS.step_px)
    return float(by_ends @ by_ends) * LENGTH_ERRORS.end_px**2 + LENGTH_ERRORS.length_share**2


class VehicleCamera(NamedTuple):
    """Camera that was estimated from vehicles."""

    estimate: CameraEstimate
    summary: str
    """Number of vehicles and views, in words."""
    numbered: bool
    """Whether the views of one vehicle are known to be the same vehicle."""


def camera_of_vehicles(
    scene: Scene,
    count: int,
    *,
    score: float = 0.9,
    noise: float = 0.0,
    sigma_px: float | None = None,
    height: float | None = None,
    fov_deg: float | None = None,
) -> VehicleCamera:
    """Fit a camera to the vehicles of a scene.

    Args:
        scene: Images of one camera, and the keypoints in them.
        count: Maximum number of vehicles.
        score: Minimum score of detections.
        noise: Standard deviation of the noise that is added to labelled keypoints, pixels.
        sigma_px: Standard deviation of a keypoint, pixels; None as in `Scene.views`.
        height: The camera's height over the road, metres; None: unknown.
        fov_deg: The horizontal field of view, degrees; None: unknown.

    Raises:
        UserError: The pixels are not square, the vehicles do not determine the camera, or the estimated camera is
            implausible.
    """
    if width := scene.file.info.get(PIXEL_WIDTH):
        raise UserError(
            f"{scene.file.name}: info.{PIXEL_WIDTH}: a pixel of the video is {width:g} times as wide as high; rescale "
            "it to square pixels, and run skope eval predict again"
        )
    drawn = sample_vehicles(scene, count, score=score, noise=noise, sigma_px=sigma_px)
    fit = fit_camera.fit_camera_to_vehicles(drawn.views, known_of(height, fov_deg, drawn.views.size[0]))
    sample_text = f"{counted(fit.vehicles, 'vehicle')} in {counted(len(drawn.views.found), 'view')}"
    if reason := rejection_reason(fit, drawn.lower_edges):
        raise UserError(
            f"{scene.file.name}: no camera can be calibrated from {sample_text}: {reason}. Points marked on the road "
            "give one (--points)"
        )
    return VehicleCamera(fit, f"{scene.file.name}: {sample_text}", drawn.numbered)


def from_vehicles(
    scene: Scene,
    folder: Path | None,
    count: int,
    *,
    score: float,
    noise: float,
    sigma_px: float | None,
    height: float | None,
    fov_deg: float | None,
    lengths: Sequence[KnownLength],
    out: Path,
) -> Iterator[str]:
    """Fit a camera to the vehicles of a scene, write its file, and yield lines that report the result.

    Args:
        scene: Images of one camera, and the keypoints in them.
        folder: Folder of the scene's results, for the suggested next command; None: no suggestion.
        count: Maximum number of vehicles.
        score, noise, sigma_px, height, fov_deg: As in `camera_of_vehicles`.
        lengths: Known lengths that correct the scale; may be empty.
        out: The camera file; it must not exist with other content.

    Raises:
        UserError: The vehicles do not determine the camera, or the estimated camera is implausible.
    """
    if scene.left_out:
        yield scene.left_out
    fit, summary, numbered = camera_of_vehicles(
        scene, count, score=score, noise=noise, sigma_px=sigma_px, height=height, fov_deg=fov_deg
    )
    _, pitch, _ = fit.camera.angles
    fit = corrected(fit, lengths)
    ways = sigma_of_ways(fit)
    sigma = {
        "focal": fit.sigma_focal,
        "pitch_deg": math.degrees(fit.sigma_pitch),
        "roll_deg": math.degrees(fit.sigma_roll),
        "height": fit.sigma_height,
        "distance": ways,
    }
    extra_fields = {
        "vehicles": fit.vehicles,
        "sigma": sigma,
        "covariance": {"of": list(UNKNOWN_NAMES), "matrix": fit.covariance.tolist()},
        "calibrated": {"from": summary, **_part_of(scene)},
    }
    yield from write_camera(out, fit.camera, extra_fields)
    yield summary if numbered else f"{summary}; the file has no track numbers, so each view counts as one vehicle"
    yield from camera_figures(
        focal=(fit.camera.K[0, 0], fit.sigma_focal),
        pitch=(pitch, fit.sigma_pitch),
        roll=(fit.camera.angles[2], fit.sigma_roll),
        height=(fit.camera.position[2], fit.sigma_height),
    )
    yield (
        f"distances and speeds: all within {INTERVAL_SIGMAS * ways:.0%} of the truth, in one direction (90%), "
        f"if the images are neither squeezed nor cropped"
    )
    if folder is not None:
        yield f"next: skope eval track {shlex.quote(str(folder))} --camera {shlex.quote(str(out))}"


def _part_of(scene: Scene) -> dict[str, Any]:
    """Return the used part of the footage, if the camera was moved during it."""
    if not scene.left_out:
        return {}
    times = [image.time_s for image in scene.file.images]
    return {"source": scene.file.info.get("source"), "seconds": [times[0], times[-1]]}


def camera_figures(**values: tuple[float, float]) -> Iterator[str]:
    """Yield lines with camera parameters and 90% confidence intervals; angles (radians) have standard deviations."""
    (focal, focal_sigma), (height, height_sigma) = values["focal"], values["height"]
    yield f"focal length {focal:.0f} px (90%: {_logarithmic(focal, focal_sigma, 0)})"
    angles = {
        name: f"{math.degrees(value):.2f} deg (90%: {math.degrees(value - INTERVAL_SIGMAS * sigma):.2f} to "
        f"{math.degrees(value + INTERVAL_SIGMAS * sigma):.2f})"
        for name, (value, sigma) in values.items()
        if name in ("pitch", "roll")
    }
    yield f"tilt down {angles['pitch']}; roll {angles['roll']}"
    yield f"height {height:.2f} m (90%: {_logarithmic(height, height_sigma, 2)})"


def _logarithmic(value: float, sigma: float, digits: int) -> str:
    """Return the 90% interval of a value with an uncertain logarithm, as text."""
    factor = math.exp(INTERVAL_SIGMAS * sigma / value)
    return f"{value / factor:.{digits}f} to {value * factor:.{digits}f}"


def known_of(height: float | None, fov_deg: float | None, width: int) -> Known:
    """Return the prior of a camera with a given height or field of view.

    Args:
        height: Height over the road, metres; None: not given.
        fov_deg: Horizontal field of view, degrees; None: not given.
        width: Width of the image, pixels.
    """
    known = Known()
    center, sigma = known.center.copy(), known.sigma.copy()
    if height is not None:
        center[HEIGHT], sigma[HEIGHT] = math.log(height), LENGTH_ERRORS.property_share
    if fov_deg is not None:
        center[FOCAL], sigma[FOCAL] = (
            math.log(width / 2 / math.tan(math.radians(fov_deg) / 2)),
            LENGTH_ERRORS.property_share,
        )
    return Known(center, sigma)


def known_length(text: str) -> KnownLength:
    """Read a length of `--length`: column and row of the first end, of the second end, and metres."""
    try:
        *ends, metres = [float(part) for part in text.split(",")]
    except ValueError:
        ends, metres = [], math.nan
    if len(ends) != 4 or not np.isfinite(ends).all() or not 0.1 <= metres <= 1000:
        raise UserError(f"--length: expected COLUMN,ROW,COLUMN,ROW,METRES with 0.1 to 1000 metres, got {text!r}")
    return KnownLength(np.array(ends).reshape(2, 2), metres)


def scale_error_line(name: Path | str, distance_sigma: float) -> str:
    """Return a sentence on the error that all distances measured with a camera share."""
    return (
        f"{name}: all distances and speeds may be off by {INTERVAL_SIGMAS * distance_sigma:.0%}, in one direction (90%)"
    )


def write_camera(out: Path, camera: Camera, extra_fields: Mapping[str, Any]) -> Iterator[str]:
    """Write a camera file, unless an identical one exists; yield a line on it.

    Args:
        out: The .json file.
        camera: The camera.
        extra_fields: Additional fields of the file, as JSON values.

    Raises:
        UserError: The file cannot be written, or exists with other content.
    """
    document = {"width": camera.width, "height": camera.height, **camera.to_dict(), **extra_fields}
    write_new(out, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
    yield f"wrote {out}"
