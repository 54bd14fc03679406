"""Measure the motion of a fixed camera's image relative to a reference image.

A coarse step compares whole edge images by phase correlation, because edges change less than light. A fine step then
tracks corners of the first image into the second (Lucas and Kanade's method, after contrast normalisation). The motion
that most corners share is the camera's: shift and turn in the image's middle. Further displacements by a turned camera
and its lens grow with the square of the distance from there, and are fitted as well.
"""

import math
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.types import Array, Pixels


@dataclass(frozen=True)
class ShiftLimits:
    """Limits of comparing images and of tracking corners between them."""

    coarse_width_px: int = 160
    """Width of the images that are compared as a whole, pixels."""
    moved_share: float = 0.006
    """Minimum displacement of a moved view, as a share of the image's width."""
    blocks: tuple[int, int] = (6, 10)
    """Rows and columns of blocks in which images are compared. Traffic hides some blocks, but not all."""
    same_correlation: float = 0.6
    """Minimum correlation of edges of two equal blocks."""
    bare_ratio: float = 0.3
    """Deviation of edges, relative to the whole image, below which a block counts as empty."""
    same_share: float = 0.2
    """Minimum share of equal blocks of two images with one view."""
    unmoved_ratio: float = 0.9
    """Minimum fit of the old position, as a share of the best fit, for a view to count as unmoved."""
    least_edges: float = 0.03
    """Strength of edges, as a share of white, below which an image has too little texture."""
    fine_width_px: int = 640
    """Maximum width of the images in which corners are tracked, pixels."""
    most_corners: int = 300
    """Maximum number of corners."""
    corner_distance_px: float = 10.0
    """Minimum distance between corners, pixels of these images."""
    blur_px: float = 8.0
    """Standard deviation of the neighbourhood in which contrast is normalised, pixels of these images."""
    blur_step: int = 4
    """Factor by which pixels are enlarged to compute the neighbourhood, which takes a sixth of the time."""
    window_px: int = 15
    """Side of the window that is tracked around a corner, pixels."""
    round_trip_px: float = 0.3
    """Maximum distance of a corner from its start after tracking forth and back, pixels."""
    fewest_corners: int = 12
    """Minimum number of corners that must move together. A vehicle that fills the image has few of them."""
    least_share: float = 0.3
    """Minimum share of the first image's corners that must move together."""
    fit_rounds: int = 12
    """Number of rounds of the robust fit."""
    floor_px: float = 0.03
    """Minimum standard deviation for any number of corners. All corners share the error of interpolating images in
    steps of 1/32 pixel."""
    vague_px: float = 0.5
    """Maximum standard deviation of a known shift, pixels of these images."""


SHIFT_LIMITS: Final = ShiftLimits()


# ------------------------------------------------------------------------------------------------------ whole images


def small_grey(pixels: Pixels) -> Pixels:
    """Return an image (H, W, 3) RGB as a small grey one, `SHIFT_LIMITS.coarse_width_px` wide."""
    return _shrunk(_grey(pixels), SHIFT_LIMITS.coarse_width_px)


def _grey(pixels: Pixels) -> Pixels:
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def _shrunk(grey: Pixels, width: int) -> Pixels:
    """Shrink a grey image (H, W) to a width of `width` pixels by averaging areas."""
    size = (width, max(1, round(width * grey.shape[0] / grey.shape[1])))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def edges(grey: Pixels) -> Array | None:
    """Return (H, W) edge strengths of a small grey image, with mean 0 and deviation 1; None without texture."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32) / 255, (0, 0), 1.0)
    strength = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    if strength.mean() < SHIFT_LIMITS.least_edges:
        return None
    root = np.sqrt(strength)  # reduces the influence of lamps and white cars
    return np.asarray((root - root.mean()) / root.std(), dtype=np.float64)


def coarse_shift(first: Array, second: Array) -> tuple[float, float] | None:
    """Return the shift of the edges between two images, as shares of the width; None if they show different views."""
    height, width = first.shape
    if first.shape != second.shape:
        return None
    window = np.outer(np.hanning(height), np.hanning(width))
    # OpenCV multiplies its inputs by the window in place.
    (x, y), _ = cv2.phaseCorrelate(first.copy(), second.copy(), window)
    back = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y]])
    aligned: Any = cv2.warpAffine(second, back, (width, height), flags=cv2.INTER_LINEAR)
    unmoved, moved = (_agreement(first, picture) for picture in (second, aligned))
    if max(unmoved, moved) < SHIFT_LIMITS.same_share:
        return None
    return (0.0, 0.0) if unmoved >= SHIFT_LIMITS.unmoved_ratio * moved else (x / width, y / width)


def _agreement(first: Array, second: Array) -> float:
    """Return the share of the non-empty blocks of two images in which edges correlate."""
    firsts = [
        [part[0] for part in np.array_split(np.arange(size), min(parts, size))]
        for size, parts in zip(first.shape, SHIFT_LIMITS.blocks, strict=True)
    ]
    pixels = _block_sums(np.ones_like(first), firsts)

    def means(picture: Array) -> Array:
        """Return the mean of each block."""
        return np.asarray(_block_sums(picture, firsts) / pixels)

    a, b = means(first), means(second)
    a_variance, b_variance = means(first * first) - a * a, means(second * second) - b * b
    shows = np.maximum(a_variance, b_variance) >= SHIFT_LIMITS.bare_ratio**2
    if not shows.any():
        return 0.0
    deviations = np.sqrt(np.clip(a_variance * b_variance, 1e-18, None))
    return float((means(first * second) - a * b >= SHIFT_LIMITS.same_correlation * deviations)[shows].mean())


def _block_sums(picture: Array, firsts: list[list[int]]) -> Array:
    """Return the sum of each block; `firsts` are the first rows and the first columns of the blocks."""
    return np.asarray(np.add.reduceat(np.add.reduceat(picture, firsts[0], axis=0), firsts[1], axis=1))


# ---------------------------------------------------------------------------------------------------------- corners


@dataclass(frozen=True)
class ImageMotion:
    """Motion of an image: shift of the image's middle, and turn of everything around it."""

    x: float
    """Shift to the right, pixels."""
    y: float
    """Shift downwards, pixels."""
    turn: float
    """Turn, radians, from x towards y: clockwise on the screen."""
    sigma_px: float
    """Standard deviation of x and y each, pixels."""
    sigma_turn: float
    """Standard deviation of the turn, radians."""
    growth: float = 0.0
    """Relative growth of the image (zoom)."""


@dataclass(frozen=True, eq=False)
class FollowedCorners:
    """Corners of one image that were found in a second image and move together with most others."""

    before: Array
    """(N, 2) positions in the first image, pixels."""
    after: Array
    """(N, 2) positions in the second image, pixels."""
    sigma_px: float
    """Standard deviation of their displacement, pixels per axis."""
    all_before: Array
    """(M, 2) all corners of the first image, also those that were lost or move differently, pixels."""


@dataclass(frozen=True, eq=False)
class SmallPicture:
    """Reduced grey versions of an image, for comparison with other images of the same camera."""

    size: tuple[int, int]
    """Width and height of the full image, pixels."""
    coarse: Pixels
    """(h, w) grey, `SHIFT_LIMITS.coarse_width_px` wide, for the comparison as a whole."""
    fine: Pixels
    """(h, w) grey, for tracking corners."""
    scale: float
    """Width of `fine`, as a share of the full image's width."""

    @classmethod
    def of(cls, pixels: Pixels, width: int = SHIFT_LIMITS.fine_width_px) -> "SmallPicture":
        """Make it from (H, W, 3) RGB; corners are tracked in an image at most `width` pixels wide."""
        size, grey = (pixels.shape[1], pixels.shape[0]), _grey(pixels)
        scale = min(1.0, width / size[0])
        fine = grey if scale == 1 else _shrunk(grey, round(size[0] * scale))
        return cls(size, _shrunk(grey, SHIFT_LIMITS.coarse_width_px), fine, scale)


class ReferencePicture:
    """Image that other images of the same camera are compared with."""

    def __init__(self, picture: SmallPicture) -> None:
        self.size = picture.size
        self._scale = picture.scale
        self._edges = edges(picture.coarse)
        self._even = _evened(picture.fine)
        found: Any = cv2.goodFeaturesToTrack(
            self._even, SHIFT_LIMITS.most_corners, 0.01, SHIFT_LIMITS.corner_distance_px, blockSize=7
        )
        self._corners = np.asarray(np.zeros((0, 2)) if found is None else found.reshape(-1, 2), dtype=np.float32)

    def motion(self, picture: SmallPicture) -> ImageMotion | None:
        """Measure the motion of the image to another image; None if it is not measurable or shows another view.

        Raises ValueError if the sizes differ.
        """
        fit = self._fit(picture)
        if fit is None or fit.sigma_px > SHIFT_LIMITS.vague_px:
            return None
        shrunk = self._scale
        return ImageMotion(
            fit.x / shrunk, fit.y / shrunk, fit.turn, fit.sigma_px / shrunk, fit.sigma_turn, growth=fit.growth
        )

    def followed(self, picture: SmallPicture) -> FollowedCorners | None:
        """Return the corners that move together to another image; None if the motion cannot be measured."""
        fit = self._fit(picture)
        if fit is None or fit.sigma_px > SHIFT_LIMITS.vague_px:
            return None
        # Corner coordinates have pixel centres at whole numbers.
        before, after, every = ((xy + 0.5) / self._scale for xy in (fit.before, fit.after, self._corners.astype(float)))
        return FollowedCorners(before, after, fit.spread / self._scale, every)

    def _fit(self, picture: SmallPicture) -> "_Fit | None":
        if picture.size != self.size:
            raise ValueError(f"expected a picture of {self.size}, got {picture.size}")
        picture_edges = edges(picture.coarse)
        shift = (
            coarse_shift(self._edges, picture_edges) if self._edges is not None and picture_edges is not None else None
        )
        if shift is None or len(self._corners) < SHIFT_LIMITS.fewest_corners:
            return None
        even = _evened(picture.fine)
        begin = (self._corners + np.array(shift) * self.size[0] * self._scale).astype(np.float32)
        after, good = _follow(self._even, even, self._corners, begin)
        back, home = _follow(even, self._even, after, self._corners)
        near = np.linalg.norm(back - self._corners, axis=1) < SHIFT_LIMITS.round_trip_px
        kept = good & home & near
        if kept.sum() < SHIFT_LIMITS.fewest_corners:
            return None
        least = max(SHIFT_LIMITS.fewest_corners, math.ceil(SHIFT_LIMITS.least_share * len(self._corners)))
        return _fitted(self._corners[kept].astype(float), after[kept].astype(float), self._even.shape, least)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Motion that most corners share, in pixels of the images in which they were tracked."""

    x: float
    y: float
    turn: float
    growth: float
    sigma_px: float
    sigma_turn: float
    spread: float
    """Standard deviation of a corner's displacement from the fit, per axis."""
    before: Array
    after: Array


def _evened(grey: Pixels) -> Pixels:
    """Return a grey image with uniform contrast, so that light and shade do not matter."""
    height, width = grey.shape
    coarse = (max(1, width // SHIFT_LIMITS.blur_step), max(1, height // SHIFT_LIMITS.blur_step))

    def around(picture: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return means around each pixel, in pixels `SHIFT_LIMITS.blur_step` times as large: they vary slowly."""
        larger: Any = cv2.resize(picture, coarse, interpolation=cv2.INTER_AREA)
        return np.asarray(
            cv2.GaussianBlur(larger, (0, 0), SHIFT_LIMITS.blur_px / SHIFT_LIMITS.blur_step), dtype=np.float32
        )

    away = grey.astype(np.float32)
    away -= cv2.resize(around(away), (width, height), interpolation=cv2.INTER_LINEAR)
    gain = 40 / (np.sqrt(around(away * away)) + 4)
    away *= cv2.resize(gain, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.addWeighted(away, 1, away, 0, 128, dtype=cv2.CV_8U), dtype=np.uint8)


def _follow(
    first: Pixels, second: Pixels, points: NDArray[np.float32], begin: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        np.ascontiguousarray(points, dtype=np.float32),
        np.ascontiguousarray(begin, dtype=np.float32).copy(),
        winSize=(SHIFT_LIMITS.window_px, SHIFT_LIMITS.window_px),
        maxLevel=2,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 0.003),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(found, dtype=np.float32), np.asarray(status.ravel() == 1)


def _fitted(before: Array, after: Array, shape: tuple[int, ...], least: int) -> _Fit | None:
    """Fit the motion of most corners (N, 2) with Tukey's weights; None if fewer than `least` agree."""
    half = shape[1] / 2
    x, y = ((before + 0.5 - [half, shape[0] / 2]) / half).T
    way = after - before
    middle = np.median(way, axis=0)
    design = _design(x, y)
    # The shift of a turned camera about doubles towards the edges; without a turn it stays the same.
    bend = float(np.hypot(*middle)) + 1e-3
    weight, spread = np.exp(-np.linalg.norm(way - middle, axis=1)), 1.0
    for _ in range(SHIFT_LIMITS.fit_rounds):
        weighted = np.repeat(weight, 2)[:, None] * design
        # The prior of the bend has the weight of one corner with the same uncertainty.
        normal = design.T @ weighted + np.diag([0.0] * 4 + [(spread / bend) ** 2] * 6)
        values = np.linalg.solve(normal + 1e-9 * np.eye(len(normal)), weighted.T @ way.ravel())
        off = np.linalg.norm(way - (design @ values).reshape(-1, 2), axis=1)
        spread = max(float(np.median(off)) / 1.1774, 0.01)  # the median of a Rayleigh distribution
        weight = np.clip(1 - (off / (5 * spread)) ** 2, 0, None) ** 2
    together = weight > 0
    if together.sum() < least:
        return None
    spread = max(math.sqrt(float((off[together] ** 2).mean() / 2)), 0.01)
    covariance = spread**2 * np.linalg.inv(normal + 1e-9 * np.eye(len(normal)))
    sigma = math.sqrt(max(covariance[0, 0], covariance[1, 1]) + SHIFT_LIMITS.floor_px**2)
    return _Fit(
        x=float(values[0]),
        y=float(values[1]),
        turn=float(values[2]) / half,
        growth=float(values[3]) / half,
        sigma_px=sigma,
        sigma_turn=math.sqrt(covariance[2, 2] + SHIFT_LIMITS.floor_px**2) / half,
        spread=spread,
        before=before[together],
        after=after[together],
    )


def _design(x: Array, y: Array) -> Array:
    """Return (2N, 10) derivatives of displacements by shift, turn, growth and bend, in units of half a width."""
    ones, zeros = np.ones_like(x), np.zeros_like(x)
    across = [ones, zeros, -y, x, x * x, y * y, x * y, zeros, zeros, zeros]
    down = [zeros, ones, x, y, zeros, zeros, zeros, x * x, y * y, x * y]
    return np.stack([np.column_stack(across), np.column_stack(down)], axis=1).reshape(-1, len(across))
