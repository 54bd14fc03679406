"""`skope eval camera --refit`: estimate the new pose of a turned camera from its previous calibration.

The old image is registered to the new one. If the motion of most corners is not that of a turned camera, the command
stops. The turn transforms the old marks to the new image, and the calibration is repeated. For a camera file without
marks, the camera itself is turned, and its uncertainty does not decrease.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.optimize import least_squares

from skope.camera.calibrate import calibrate
from skope.camera.calibration_files import read_uncertain_camera
from skope.camera.evidence import Evidence
from skope.camera.fit.camera_from_marks import evidence_of, position_errors
from skope.camera.fit.write_camera import write_camera
from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera
from skope.camera.motion.camera_motion import TURN_ANGLES, covariance_of_turns, turned_camera
from skope.camera.motion.camera_shake import CameraShakeEstimator
from skope.camera.motion.image_shift import FollowedCorners, ImageMotion, ReferencePicture, SmallPicture
from skope.camera.uncertain_camera import UncertainCamera, moved_camera
from skope.dataset.camera_of_file import fitted_camera, read_camera
from skope.errors import UserError
from skope.terminal.console import counted
from skope.types import Array, Pixels
from skope.video.footage import FrameRange, open_footage


@dataclass(frozen=True)
class RefitLimits:
    """Limits of registering a camera that was turned."""

    image_width_px: int = 1280
    """Maximum width of the images in which corners are matched. Limits in pixels are pixels of these."""
    residual_ratio: float = 2.0
    """A turn explains the motion of corners if its residual is at most this many times that of a free homography."""
    least_residual_px: float = 0.3
    """Minimum assumed residual of that homography, pixels. Corners are matched with this precision."""
    near_m: float = 60.0
    """Distance within which road corners distinguish a turn from a move, metres. The nearer half of them must agree."""
    fewest_matches: int = 8
    """Minimum number of matched corners within `near_m`."""
    least_share: float = 0.5
    """Minimum share of these corners that must agree with a turn. Traffic hides some."""
    rest_s: float = 3.0
    """Duration over which the rest position of a shaking camera is averaged, seconds."""


REFIT_LIMITS: Final = RefitLimits()


@dataclass(frozen=True, eq=False)
class Registration:
    """Turn of a camera between two images."""

    camera: Camera
    """The old camera, turned."""
    motion: ImageMotion
    corners: int
    off_px: float
    """Residual of corners after the turn, root mean square per axis, pixels."""
    near_m: float
    """Median distance of the nearby road corners which show that the camera was not moved, metres."""


def refit(
    before: str, after: str, *, points: Path | None, camera: Path | None, size: str | None, out: Path
) -> Iterator[str]:
    """Estimate the pose of a turned camera, write `out`, and yield lines on the result.

    Args:
        before: The marked image, or a video: its first frame, or with "@SECONDS" the frame at that time.
        after: An image of the turned camera, or a video, in the same form. In a video, a frame at rest is chosen.
        points: The old marks, as in `skope eval camera --points`; None: `camera` is given.
        camera: The old camera's file.
        size: "WIDTHxHEIGHT" of the marked image; None: from the file.
        out: Camera file to write.

    Raises:
        UserError: A file cannot be read, or the images do not reliably show how the camera was turned.
    """
    (old_pixels, _), (new_pixels, part) = _frame(before, at_rest=False), _frame(after, at_rest=True)
    shape = (old_pixels.shape[1], old_pixels.shape[0])
    if new_pixels.shape != old_pixels.shape:
        raise UserError(
            f"{after}: is {new_pixels.shape[1]}x{new_pixels.shape[0]}, but {before} is {shape[0]}x{shape[1]}"
        )
    evidence = evidence_of(points, size or f"{shape[0]}x{shape[1]}") if points else None
    known: UncertainCamera
    if evidence:
        known = marked = calibrate(evidence)
        evidence = replace(evidence, points=tuple(p for p in evidence.points if p.name not in marked.outliers))
    else:
        known, scaled = _known(camera, shape, before)
        if scaled:
            yield scaled
    registered = registration(old_pixels, new_pixels, known, f"{before}, {after}")
    if evidence:
        moved = moved_evidence(evidence, known.camera, registered)
        found: UncertainCamera = calibrate(moved, start=registered.camera, check=False)
    else:
        found = turned_known(known, registered)
    source = points or camera
    assert source is not None
    origin = f"{source.name}, turned as {Path(_split(after)[0]).name} shows"
    extra_fields = {
        "covariance": found.covariance_dict(),
        "calibrated": {"when": _saved(after), "from": origin, **part},
        "refit": {
            "shift_px": [registered.motion.x, registered.motion.y],
            "turn_deg": math.degrees(registered.motion.turn),
            "corners": registered.corners,
            "off_px": registered.off_px,
        },
    }
    yield from write_camera(out, found.camera, extra_fields)
    yield (
        f"the image has moved by {math.hypot(registered.motion.x, registered.motion.y):.1f} px and turned by "
        f"{math.degrees(registered.motion.turn):.2f} deg: {counted(registered.corners, 'corner')} "
        f"{registered.off_px:.2f} px off (root mean square)"
    )
    yield position_errors(found)


def registration(before: Pixels, after: Pixels, known: UncertainCamera, name: str) -> Registration:
    """Measure the turn of a camera between two images.

    Args:
        before: (H, W, 3) RGB image from the `known` camera.
        after: (H, W, 3) RGB image from its new orientation.
        known: The camera before the turn.
        name: Name of the images, for errors.

    Raises:
        UserError: A turn does not explain the change of the image.
    """
    first, moved = (SmallPicture.of(pixels, REFIT_LIMITS.image_width_px) for pixels in (before, after))
    reference = ReferencePicture(first)
    motion, followed = reference.motion(moved), reference.followed(moved)
    if motion is None or followed is None:
        raise UserError(f"{name}: too few common corners in the two images to measure the turn of the camera")
    rays, valid = known.camera.rays(followed.before)
    rays, corners = rays[valid], replace(followed, before=followed.before[valid], after=followed.after[valid])
    camera, off = _turn(known.camera, rays, corners, motion)
    # Half the squared norm of errors that are normal per axis has a median of 0.69 variances.
    off_px = math.sqrt(float(np.median((off**2).sum(axis=1))) / (2 * math.log(2)))
    scale = max(1.0, known.camera.width / REFIT_LIMITS.image_width_px)
    lens = _by_the_lens(known, camera, rays)
    allowed = math.hypot(
        REFIT_LIMITS.residual_ratio * max(corners.sigma_px, REFIT_LIMITS.least_residual_px * scale), lens
    )
    if not off_px <= allowed:
        raise UserError(
            f"{name}: the image has not changed as by a turn of the camera ({off_px:.1f} px off, at most "
            f"{allowed:.1f} px expected): it was moved or zoomed; mark points in the new image"
        )
    near_m = _near_road(known.camera, camera, corners, 3 * allowed, name)
    return Registration(camera, motion, len(rays), off_px, near_m)


def _near_road(old: Camera, turned: Camera, corners: FollowedCorners, within_px: float, name: str) -> float:
    """Return the distance of the road's corners near the camera, metres, which a move would shift most.

    Raises UserError if there are too few corners, or most of them do not agree with the turn.
    """
    places = intersect_ground(old, corners.all_before)
    away = np.linalg.norm(places - old.position, axis=1)
    seen, _, valid = turned.project(np.where(np.isfinite(places), places, old.position))
    visible = np.flatnonzero(valid & turned.inside(seen) & (away < REFIT_LIMITS.near_m))
    if len(visible) < REFIT_LIMITS.fewest_matches:
        raise UserError(f"{name}: too few corners on the nearby road to distinguish a turn of the camera from a move")
    nearer = visible[np.argsort(away[visible])][: max(REFIT_LIMITS.fewest_matches, len(visible) // 2)]
    apart = np.linalg.norm(corners.all_before[nearer, None] - corners.before, axis=-1)
    match = apart.argmin(axis=1)
    good = (apart.min(axis=1) < 0.01) & (np.linalg.norm(corners.after[match] - seen[nearer], axis=1) < within_px)
    if good.mean() < REFIT_LIMITS.least_share:
        raise UserError(
            f"{name}: only {good.mean():.0%} of the nearby road is found where a turn of the camera puts it: it was "
            "moved or zoomed, or much hides the road; mark points in the new image"
        )
    return float(np.median(away[nearer[good]]))


def _turn(camera: Camera, rays: Array, corners: FollowedCorners, motion: ImageMotion) -> tuple[Camera, Array]:
    """Return the camera turned so that `rays` (N, 3) best fit the corners' new positions, and the (N, 2) errors."""
    away = rays @ camera.T_camera_world[:3, :3] + camera.position

    def residuals(values: Array) -> Array:
        pixels, _, valid = turned_camera(camera, *values.tolist()).project(away)
        return np.where(valid[:, None], pixels - corners.after, 0.0).ravel()

    begin = np.array([motion.x, motion.y, motion.turn])
    scale = [1.0, 1.0, 2 / camera.width]
    solved = least_squares(residuals, begin, x_scale=scale, loss="soft_l1", f_scale=max(corners.sigma_px, 0.1))
    return turned_camera(camera, *solved.x.tolist()), residuals(solved.x).reshape(-1, 2)


def _by_the_lens(known: UncertainCamera, turned: Camera, rays: Array) -> float:
    """Return the error of corners from the uncertain focal length and lens, root mean square per axis, pixels."""
    T = turned.T_camera_world @ np.linalg.inv(known.camera.T_camera_world)
    pixels = known.camera.project(rays @ known.camera.T_camera_world[:3, :3] + known.camera.position)[0]
    shifts, total = _shifts(known.camera, T, pixels), 0.0
    for name in ("focal", "k1"):
        if name in known.parameters:
            k = known.parameters.index(name)
            changed = moved_camera(known.camera, {name: math.sqrt(known.covariance[k, k])})
            change = _shifts(changed, T, pixels) - shifts
            total += float(np.nanvar(change, axis=0).mean())
    return math.sqrt(total)


def _shifts(camera: Camera, T: Array, pixels: Array) -> Array:
    """Return (N, 2) shifts of pixels when the camera is turned by T (4, 4) in its own frame."""
    rays, valid = camera.rays(pixels)
    turned = replace(camera, T_camera_world=T)
    seen, _, before = turned.project(rays)
    return np.where((valid & before)[:, None], seen - pixels, np.nan)


def moved_evidence(evidence: Evidence, camera: Camera, registered: Registration) -> Evidence:
    """Transform marks to the image of the turned camera, with the registration error added to their errors.

    Args:
        evidence: The marks in the old image.
        camera: The camera of the old image.
        registered: The turned camera of the new image, and the residual of the corners.

    Returns:
        The same evidence with marks in pixels of the new image; other evidence is unchanged.

    Raises:
        UserError: A mark lies outside the view of the turned camera's lens.
    """

    def moved(pixels: Array) -> Array:
        rays, valid = camera.rays(pixels)
        away = rays @ camera.T_camera_world[:3, :3] + camera.position
        seen, _, before = registered.camera.project(away)
        if not (valid & before).all():
            raise UserError("--refit: a mark lies where the lens of the turned camera sees nothing")
        return np.asarray(seen)

    def wider(sigma_px: float) -> float:
        return math.hypot(sigma_px, registered.off_px)

    return replace(
        evidence,
        points=tuple(replace(p, pixel=moved(p.pixel), sigma_px=wider(p.sigma_px)) for p in evidence.points),
        lengths=tuple(replace(p, pixels=moved(p.pixels), sigma_px=wider(p.sigma_px)) for p in evidence.lengths),
        parallels=tuple(replace(p, lines=moved(p.lines), sigma_px=wider(p.sigma_px)) for p in evidence.parallels),
        verticals=tuple(replace(p, pixels=moved(p.pixels), sigma_px=wider(p.sigma_px)) for p in evidence.verticals),
    )


def turned_known(known: UncertainCamera, registered: Registration) -> UncertainCamera:
    """Return the turned camera with the uncertainty of the old camera, the turn, and an undetected move."""
    motion = registered.motion
    sigmas = (motion.sigma_px, motion.sigma_px, motion.sigma_turn)
    # A camera moved by this much shifts nearby corners by the size of their residuals.
    hidden = registered.off_px * registered.near_m / float(known.camera.K[0, 0])
    return known.of_camera(registered.camera).widened(
        {TURN_ANGLES: covariance_of_turns(registered.camera, sigmas), ("x", "y", "z"): hidden**2 * np.eye(3)}
    )


def _known(path: Path | None, shape: tuple[int, int], picture: str) -> tuple[UncertainCamera, str]:
    """Return the old camera at the size of its image, and a sentence if it was scaled."""
    if path is None:
        raise UserError("--refit: needs the old camera: --points with its marks, or --camera with its file")
    camera, posed = read_camera(path, shape)
    if not posed:
        raise UserError(f"{path}: T_camera_world: missing: the pose of the old camera is unknown")
    known = read_uncertain_camera(path)
    if known is None:
        raise UserError(f"{path}: covariance: missing: the uncertainty of the old camera is unknown")
    camera, scaled = fitted_camera(camera, shape, str(path), picture)
    return known.of_camera(camera), scaled


def _split(source: str) -> tuple[str, float | None]:
    """Split a source into its file and the second after "@"."""
    name, at, seconds = source.rpartition("@")
    if not at or Path(source).exists():
        return source, None
    try:
        value = float(seconds)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0):
        raise UserError(f"{source}: expected a file, or FILE@SECONDS")
    return name, value


def _frame(source: str, *, at_rest: bool) -> tuple[Pixels, dict[str, Any]]:
    """Read an image, or a frame of a video: the first, or for a shaking camera the one nearest to its rest position.

    Returns:
        The image; of a video, also its `source` and `seconds`, as in the `calibrated` field of a camera file.
    """
    name, seconds = _split(source)
    begin = seconds or 0.0
    footage = open_footage(name, FrameRange(start_s=begin, end_s=begin + REFIT_LIMITS.rest_s))
    if footage.clip is not None and footage.clip.live:
        raise UserError(f"{name}: a live stream cannot be read again; record it to a file first")
    if footage.clip is None and (seconds is not None or len(footage.images) > 1):
        raise UserError(f"{source}: expected one image, or a video")
    watch, frames, times = CameraShakeEstimator(), dict[int, Pixels](), list[float]()
    for image, pixels in watch.watch(footage.frames()):
        frames[image.id] = pixels
        times.append(image.time_s or 0.0)
        if not at_rest or footage.clip is None:
            break
    if not frames:
        raise UserError(f"{source}: {'; '.join(footage.skipped) or 'has no such frame'}")
    part = {"source": footage.name, "seconds": [times[0], times[-1]]} if footage.clip else {}
    motions = {number: watch.taken(number) for number in frames}
    measured = {number: motion for number, motion in motions.items() if motion is not None}
    if not measured or len(frames) == 1:
        return next(iter(frames.values())), part
    places = np.array([(motion.x, motion.y) for motion in measured.values()])
    away = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    return frames[list(measured)[int(away.argmin())]], part


def _saved(source: str) -> Any:
    """Return the time at which the new image was saved, ISO 8601."""
    return datetime.fromtimestamp(int(Path(_split(source)[0]).stat().st_mtime), UTC).isoformat()
