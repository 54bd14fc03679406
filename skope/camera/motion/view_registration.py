"""Estimate the homography between two views of a fixed camera that was shifted, turned or zoomed; read a video's views.

Features that both images share give a first homography. This homography warps the second image back, and corners of the
first image are tracked into the warped image. The homography of these corners is accepted only if they agree with it,
cover the image, and give the same homography when only half of them are used.

`info` of a video's frames lists its views in order, with the homography from the first view to each.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.motion.image_shift import ReferencePicture, SmallPicture
from skope.dataset.folder import CHANGES_KEY
from skope.errors import UserError
from skope.types import Array, Mask, Pixels


@dataclass(frozen=True)
class RegistrationLimits:
    """Limits of the homography between two views."""

    image_width_px: int = 1280
    """Maximum width of the compared images. Limits in pixels are pixels of these."""
    feature_ratio: float = 0.8
    """Maximum ratio of a feature's distance to its best and second best match (Lowe's ratio test)."""
    fewest_features: int = 20
    """Minimum number of features that agree with the first homography."""
    feature_px: float = 3.0
    """Maximum distance of a feature from its position under the first homography, pixels."""
    residual_px: float = 1.0
    """Maximum residual of the final homography, pixels."""
    corner_error_px: float = 1.0
    """Maximum standard deviation of an image corner under the homography, pixels."""
    least_overlap: float = 0.6
    """Minimum share of the image that both views show."""
    grid_parts: int = 4
    """Rows and columns of parts into which the overlap of both views is divided."""
    fewest_parts: int = 9
    """Minimum number of parts of the grid with corners; more than half, so that a lorry near the camera is not
    enough."""
    fewest_per_part: int = 3
    """Minimum number of corners in such a part."""
    moving_view: int = -1
    """View number of frames that were taken while the camera moved."""


REGISTRATION_LIMITS: Final = RegistrationLimits()


@dataclass(frozen=True, eq=False)
class ViewHomography:
    """Homography from the pixels of one view to those of a second view."""

    matrix: Array
    """(3, 3) homography of continuous pixel coordinates, first view to second view; its last element is 1."""
    residual_px: float
    """Distance of corners from their position under the homography, root mean square per axis, pixels."""
    corner_error_px: float
    """Uncertainty at the image's corners, pixels: half the largest distance there between the homographies of two
    halves of the corners."""

    def inverse(self) -> "ViewHomography":
        """Return the homography from the second view to the first one, with the same errors."""
        matrix = np.linalg.inv(self.matrix)
        return replace(self, matrix=matrix / matrix[2, 2])

    def then(self, further: "ViewHomography") -> "ViewHomography":
        """Return the homography from the first view to a third one; `further` maps the second view to the third."""
        matrix = further.matrix @ self.matrix
        return ViewHomography(
            matrix / matrix[2, 2],
            float(np.hypot(self.residual_px, further.residual_px)),
            float(np.hypot(self.corner_error_px, further.corner_error_px)),
        )


def transformed(matrix: Array, pixels: Array) -> Array:
    """Apply a homography (3, 3) to pixels (..., 2); NaN beyond its horizon."""
    xyw = pixels @ matrix[:, :2].T + matrix[:, 2]
    return np.where(xyw[..., 2:] > 1e-9, xyw[..., :2] / np.maximum(xyw[..., 2:], 1e-9), np.nan)


def is_inside(pixels: Array, size: tuple[int, int]) -> Mask:
    """Return (...) whether pixels (..., 2) lie in an image of a width and a height; False for NaN."""
    return np.asarray(((pixels >= 0) & (pixels <= np.array(size))).all(axis=-1), dtype=bool)


def register(before: Pixels, after: Pixels) -> ViewHomography | None:
    """Estimate the homography from one view to a second one.

    Args:
        before: (H, W, 3) RGB image of the first view, preferably without traffic (a median of frames).
        after: (H, W, 3) RGB image of the second view.

    Returns:
        The homography; None if it is not reliable.
    """
    size = (before.shape[1], before.shape[0])
    if after.shape != before.shape:
        return None
    first, second = (SmallPicture.of(pixels, REGISTRATION_LIMITS.image_width_px) for pixels in (before, after))
    rough = _of_features(first, second)
    if rough is None or not _overlaps(rough, size):
        return None
    # OpenCV's pixel coordinates have pixel centres at whole numbers.
    halves = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
    back = halves @ np.linalg.inv(rough) @ np.linalg.inv(halves)
    warped: Any = cv2.warpPerspective(after, back, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    corners = ReferencePicture(first).followed(SmallPicture.of(warped, REGISTRATION_LIMITS.image_width_px))
    if corners is None:
        return None
    in_second = transformed(rough, corners.after)
    kept = is_inside(in_second, size)  # the warp has no data outside the second view
    return _checked(corners.before[kept], in_second[kept], size, first.scale)


def _of_features(first: SmallPicture, second: SmallPicture) -> Array | None:
    """Return the (3, 3) homography that most shared features agree with, in pixels; None if too few agree."""
    sift = cv2.SIFT.create(nfeatures=4000)
    (first_points, descriptors), (second_points, descriptions) = (
        sift.detectAndCompute(picture.fine, None) for picture in (first, second)
    )
    if min(len(first_points), len(second_points)) < REGISTRATION_LIMITS.fewest_features:
        return None
    pairs = cv2.BFMatcher().knnMatch(descriptors, descriptions, k=2)
    good = [
        pair[0]
        for pair in pairs
        if len(pair) == 2 and pair[0].distance < REGISTRATION_LIMITS.feature_ratio * pair[1].distance
    ]
    if len(good) < REGISTRATION_LIMITS.fewest_features:
        return None
    before = (np.array([first_points[match.queryIdx].pt for match in good]) + 0.5) / first.scale
    after = (np.array([second_points[match.trainIdx].pt for match in good]) + 0.5) / second.scale
    cv2.setRNGSeed(0)
    matrix, agree = cv2.findHomography(
        before, after, cv2.RANSAC, REGISTRATION_LIMITS.feature_px / first.scale, maxIters=5000
    )
    if matrix is None or int(agree.sum()) < REGISTRATION_LIMITS.fewest_features:
        return None
    return np.asarray(matrix, dtype=np.float64)


def _overlaps(matrix: Array, size: tuple[int, int]) -> bool:
    """Return whether both views share enough of their images, and neither is mirrored."""
    grid = _grid(size)
    shares = []
    for H in (matrix, np.linalg.inv(matrix)):
        H = H / H[2, 2]
        moved_grid = transformed(H, grid)
        across, down = (transformed(H, grid + step) - moved_grid for step in np.eye(2))
        upright = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0] > 0
        shares.append(float((is_inside(moved_grid, size) & upright).mean()))
    return min(shares) >= REGISTRATION_LIMITS.least_overlap


def _checked(before: Array, after: Array, size: tuple[int, int], scale: float) -> ViewHomography | None:
    """Return the homography of corners (N, 2) in both views; None if it fails a quality test."""
    # Neighbours in this order go to different halves, so that both halves cover the image.
    order = np.lexsort((before[:, 0], before[:, 1] // (size[1] / 8)))
    halves = [_fit(before[order[k::2]], after[order[k::2]]) for k in (0, 1)]
    whole = _fit(before, after)
    if whole is None or halves[0] is None or halves[1] is None or not _overlaps(whole, size):
        return None
    if _parts_with(before, whole, size) < REGISTRATION_LIMITS.fewest_parts:
        return None
    edges = np.array([[0, 0], [1, 0], [0, 1], [1, 1.0]]) * size
    apart = np.linalg.norm(transformed(halves[0], edges) - transformed(halves[1], edges), axis=1).max()
    residual = float(np.sqrt(((transformed(whole, before) - after) ** 2).mean()))
    if not (residual * scale < REGISTRATION_LIMITS.residual_px and apart * scale < REGISTRATION_LIMITS.corner_error_px):
        return None
    return ViewHomography(whole, residual, float(apart) / 2)


def _parts_with(corners: Array, matrix: Array, size: tuple[int, int]) -> int:
    """Return the number of parts of both views' overlap that have enough of the corners (N, 2)."""
    grid = _grid(size)
    shared = grid[is_inside(transformed(matrix, grid), size)]
    low, high = shared.min(axis=0), shared.max(axis=0)
    part = np.clip(
        (corners - low) / (high - low) * REGISTRATION_LIMITS.grid_parts, 0, REGISTRATION_LIMITS.grid_parts - 1
    ).astype(int)
    counts = np.bincount(
        part[:, 0] + REGISTRATION_LIMITS.grid_parts * part[:, 1], minlength=REGISTRATION_LIMITS.grid_parts**2
    )
    return int((counts >= REGISTRATION_LIMITS.fewest_per_part).sum())


def _grid(size: tuple[int, int]) -> Array:
    """Return (40, 40, 2) pixels spread over an image."""
    u, v = ((np.arange(40) + 0.5) / 40 * side for side in size)
    return np.stack(np.meshgrid(u, v), axis=-1)


def _fit(before: Array, after: Array) -> Array | None:
    """Fit a (3, 3) homography to corners (N, 2) by least squares."""
    matrix = cv2.findHomography(before, after, 0)[0] if len(before) >= 4 else None
    return None if matrix is None else np.asarray(matrix, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class KnownView:
    """View of a video."""

    begin_s: float
    """Time at which the view, or the movement to it, begins, seconds."""
    settled_s: float
    """Time from which the camera is at rest in it, seconds."""
    from_first: ViewHomography | None
    """Homography from the first view to this one; None: not reliably known."""


def read_views(name: str, info: Mapping[str, Any]) -> list[KnownView]:
    """Read the views of a video, including the first one.

    Args:
        name: Name of the frames' file, for errors.
        info: The `info` of the frames' file.

    Raises:
        UserError: `info.view_changes` is malformed.
    """
    first = KnownView(-np.inf, -np.inf, ViewHomography(np.eye(3), 0.0, 0.0))
    changes = info.get(CHANGES_KEY)
    if not isinstance(changes, list):
        return [first]
    try:
        return [first, *map(_view, changes)]
    except (KeyError, TypeError, ValueError):
        raise UserError(
            f"{name}: info.{CHANGES_KEY}: expected objects with time_s, and perhaps settled_s, homography (3 rows of 3 "
            "numbers), residual_px and corner_error_px"
        ) from None


def _view(change: Mapping[str, Any]) -> KnownView:
    begin_s = float(change["time_s"])
    if "homography" not in change:
        return KnownView(begin_s, begin_s, None)
    matrix = np.array(change["homography"], dtype=np.float64)
    errors = (float(change["residual_px"]), float(change["corner_error_px"]))
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all() or not abs(np.linalg.det(matrix)) > 1e-9:
        raise ValueError(matrix)
    if not (np.isfinite(errors).all() and min(errors) >= 0):
        raise ValueError(errors)
    return KnownView(begin_s, float(change["settled_s"]), ViewHomography(matrix, *errors))


def view_numbers(views: Sequence[KnownView], times_s: Sequence[float] | Array) -> NDArray[np.intp]:
    """Return (N,) the index in `views` for frames at times (N,); `REGISTRATION_LIMITS.moving_view` while the
    camera was moving."""
    times = np.asarray(times_s, dtype=np.float64)
    number = np.searchsorted([view.begin_s for view in views[1:]], times, side="right")
    settled = np.array([view.settled_s for view in views])
    return np.where(times >= settled[number], number, REGISTRATION_LIMITS.moving_view)
