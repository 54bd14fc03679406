"""Lens distortion and dirt on the glass.

The distortion is one warp for image, depth, ids and silhouettes of a view without distortion. The dirt does not change
during a recording.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera, Distortion
from skope.errors import UserError
from skope.gen.render.frame import RenderedFrame, Silhouette
from skope.gen.render.pixel_windows import Window
from skope.gen.render.rain_and_snow import smaller
from skope.gen.scene.random_streams import Stream
from skope.gen.scene.recording import Recording
from skope.types import Array, Pixels


@dataclass(frozen=True)
class LensLimits:
    """Margins of the lens, and dirt on the glass."""

    largest_px: int = 8192
    """Largest side of an image, pixels."""
    margin_px: int = 2
    """Margin of the pinhole's image beyond the view of the lens, pixels."""
    specks: int = 60
    """Number of specks of dust on the dirtiest glass."""
    smears: int = 14
    """Number of smears and dried drops on the dirtiest glass."""
    blur_share: float = 0.022
    """Blur of dirt, as a share of the image's width. Dirt is far out of focus."""
    darkest: float = 0.45
    """Share of the light that a speck blocks."""
    thickest: float = 0.85
    """Share of the image that is out of focus behind the thickest smear."""
    veil_share: float = 0.16
    """Share of the light from the whole image in the veil that dirt adds."""


LENS_LIMITS: Final = LensLimits()


_WHOLE_PIXELS: Final = np.zeros((0, 0), dtype=np.uint16)
"""Empty fractional map for OpenCV's remap: whole pixels only."""


def pinhole_of(camera: Camera) -> Camera:
    """Return a camera without distortion that covers the view of `camera`, with the resolution of its middle.

    Raises:
        UserError: The distortion folds the image, or the view is too wide for a camera without distortion.
    """
    name = f"camera.distortion {camera.distortion.model} {list(camera.distortion.coefficients)}"
    columns, rows = (np.linspace(0, side, 64) for side in (camera.width, camera.height))
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    border = np.concatenate([grid[0], grid[-1], grid[:, 0], grid[:, -1]])
    rays, valid = camera.rays(border)
    if not valid.all():
        raise UserError(f"{name}: folds back inside the image at this field of view")
    focal = camera.K[[0, 1], [0, 1]]
    low = np.floor(rays[:, :2].min(axis=0) * focal) - LENS_LIMITS.margin_px
    high = np.ceil(rays[:, :2].max(axis=0) * focal) + LENS_LIMITS.margin_px
    width, height = (high - low).astype(int).tolist()
    if max(width, height) > LENS_LIMITS.largest_px:
        raise UserError(f"{name}: shows more than a view of {LENS_LIMITS.largest_px} pixels without distortion")
    K = np.array([[focal[0], 0, -low[0]], [0, focal[1], -low[1]], [0, 0, 1]])
    return replace(camera, width=width, height=height, K=K, distortion=Distortion())


class Lens:
    """Converts views of a pinhole camera to those of a camera with distortion at the same place."""

    def __init__(self, camera: Camera) -> None:
        """Compute the warp.

        Raises:
            UserError: As in `pinhole_of`.
        """
        self._camera = camera
        self.pinhole = pinhole_of(camera)
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays, _ = camera.rays(np.stack([columns, rows], axis=-1))
        K = self.pinhole.K
        source = rays[..., :2] * K[[0, 1], [0, 1]] + K[:2, 2]
        # Position of each pixel's centre in the pinhole's image, in OpenCV's pixel convention.
        self._columns, self._rows = (source[..., k].astype(np.float32) - np.float32(0.5) for k in (0, 1))
        self._nearest = np.floor(source).astype(np.int16)
        """(H, W, 2) column and row of the pinhole's pixel that shows each pixel's centre."""
        self._shown = _window_within(source)
        off = (source - self._nearest - 0.5).astype(np.float32)
        self._off_right, self._off_down = (np.ascontiguousarray(off[..., k]) for k in (0, 1))
        """(H, W) offset from the centre of the nearest pixel to that position."""
        self._jacobian = [
            [np.gradient(source[..., k], axis=axis).astype(np.float32) for axis in (1, 0)] for k in (0, 1)
        ]
        """(H, W) change of the source's x, y (rows) per pixel to the right and down (columns)."""

    def straightened(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the image of a pinhole camera from that of the lens (`rgb`, (H, W, 3)).

        The border is extended outwards.
        """
        pinhole, camera = self.pinhole, self._camera
        columns, rows = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
        ideal, _ = pinhole.rays(np.stack([columns, rows], axis=-1))
        distorted, monotonic = camera.distortion.distort(ideal[..., :2])
        source = np.where(monotonic[..., None], distorted @ camera.K[:2, :2].T + camera.K[:2, 2], -1.0)
        x, y = (source[..., k].astype(np.float32) - np.float32(0.5) for k in (0, 1))
        return np.asarray(cv2.remap(rgb, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)

    def bent(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return an image of the pinhole camera as the lens shows it."""
        return np.asarray(cv2.remap(rgb, self._columns, self._rows, cv2.INTER_LINEAR), dtype=np.uint8)

    def bend(self, view: RenderedFrame) -> RenderedFrame:
        """Return the view as the lens shows it.

        Depth and ids are those of the nearest pixel; depth follows its slope.
        """
        depth = self._sampled(view.depth)
        right, down = cv2.split(self._sampled(view.slope))
        # Inverse depth is linear in the pixel on a plane. The sky has infinite depth and slope 0, so it does not
        # change.
        shift = cv2.add(cv2.multiply(right, self._off_right), cv2.multiply(down, self._off_down))
        moved = cv2.divide(depth, np.maximum(1 - cv2.divide(shift, depth), np.float32(0.5)))
        slope = [
            cv2.add(cv2.multiply(right, of_right), cv2.multiply(down, of_down))
            for of_right, of_down in zip(*self._jacobian, strict=True)
        ]
        return replace(
            view,
            rgb=self.bent(view.rgb),
            depth=np.asarray(moved),
            slope=np.asarray(cv2.merge(slope)),
            ids=self._sampled(view.ids),
            silhouettes=tuple(map(self._bend_silhouette, view.silhouettes)),
        )

    def _sampled(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the pinhole's image at the nearest pixels."""
        return np.asarray(cv2.remap(values, self._nearest, _WHOLE_PIXELS, cv2.INTER_NEAREST))

    def _bend_silhouette(self, silhouette: Silhouette) -> Silhouette:
        """Warp a silhouette: inside the image by the same warp.

        Outside, where only the pixel count matters, forwards by pixel.
        """
        camera, pinhole = self._camera, self.pinhole
        if not silhouette.mask.any():
            return silhouette
        doubtful = silhouette.mask & ~self._surely_sampled(silhouette)
        if not doubtful.any():
            return Silhouette(0, 0, np.zeros((0, 0), dtype=bool))
        centers = cv2.findNonZero(doubtful.view(np.uint8)).reshape(-1, 2) + np.array(
            [silhouette.x + 0.5, silhouette.y + 0.5]
        )
        distorted, monotonic = camera.distortion.distort((centers - pinhole.K[:2, 2]) / pinhole.K[[0, 1], [0, 1]])
        size = np.array([camera.width, camera.height])
        if not monotonic.all():
            distorted = distorted[monotonic]
        x, y = (
            np.floor(distorted[:, k] * camera.K[k, k] + camera.K[k, 2]).clip(-side - 1, 2 * side).astype(np.int32)
            for k, side in enumerate(size.tolist())
        )
        on_canvas = (x >= -size[0]) & (x < 2 * size[0]) & (y >= -size[1]) & (y < 2 * size[1])
        if not on_canvas.any():
            return Silhouette(0, 0, np.zeros((0, 0), dtype=bool))
        if not on_canvas.all():
            x, y = x[on_canvas], y[on_canvas]
        low, high = np.array([x.min(), y.min()]) - 1, np.array([x.max(), y.max()]) + 2
        mask = np.zeros(tuple((high - low)[::-1]), dtype=bool)
        mask[y - low[1], x - low[0]] = True
        x0, y0 = np.maximum(low, 0)
        x1, y1 = np.minimum(high, size)
        if x0 < x1 and y0 < y1:
            mask[y0 - low[1] : y1 - low[1], x0 - low[0] : x1 - low[0]] = self._sample_silhouette(
                silhouette, x0, y0, x1, y1
            )
        return Silhouette(int(low[0]), int(low[1]), mask)

    def _surely_sampled(self, silhouette: Silhouette) -> NDArray[np.bool_]:
        """Return the pixels of a silhouette that are visible in the image and surrounded by the silhouette.

        They need no forward warp, because they cannot become its outermost pixels.
        """
        x0, y0, x1, y1 = self._shown
        x, y = silhouette.x, silhouette.y
        out = np.zeros_like(silhouette.mask)
        overlap = slice(max(y0 - y, 0), max(y1 - y, 0)), slice(max(x0 - x, 0), max(x1 - x, 0))
        around = np.ones((3, 3), dtype=np.uint8)
        inner = cv2.erode(silhouette.mask.view(np.uint8), around, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        out[overlap] = inner[overlap]
        return out

    def _sample_silhouette(self, silhouette: Silhouette, x0: int, y0: int, x1: int, y1: int) -> NDArray[np.bool_]:
        """Return the silhouette at the source pixels of a window of the image."""
        at = self._nearest[y0:y1, x0:x1] - np.array([silhouette.x, silhouette.y], dtype=np.int16)
        return np.asarray(cv2.remap(silhouette.mask.view(np.uint8), at, _WHOLE_PIXELS, cv2.INTER_NEAREST)).view(bool)


def _window_within(source: Array) -> Window:
    """Return a window of the pinhole's image in which the lens shows every pixel.

    `source` (H, W, 2) is the position of each pixel of the lens in the pinhole's image. No edge of the lens image
    passes through the window: each of its four edges lies on its own side of the window.
    """
    left, top = np.ceil([source[:, 0, 0].max(), source[0, :, 1].max()]).astype(int) + LENS_LIMITS.margin_px
    right, bottom = np.floor([source[:, -1, 0].min(), source[-1, :, 1].min()]).astype(int) - LENS_LIMITS.margin_px
    return int(left), int(top), int(right), int(bottom)


class LensDirt:
    """Dirt on the glass of one recording's camera."""

    def __init__(self, recording: Recording) -> None:
        amount = recording.conditions.lens_dirt
        self._sharp: Pixels | None = None
        if amount > 0:
            size = (recording.camera.width, recording.camera.height)
            cover, through = _dirt(size, amount, recording.rng(Stream.LENS_DIRT))
            # Bytes (0 to 255) in all channels: OpenCV multiplies them much faster than numpy multiplies floats.
            self._sharp, self._soft = (_in_channels(share * through) for share in (1 - cover, cover))

    def soil(self, rgb: Pixels) -> Pixels:
        """Return the image (H, W, 3) through the glass."""
        if self._sharp is None:
            return rgb
        height, width = rgb.shape[:2]
        small = smaller(rgb, 8)
        soft = cv2.GaussianBlur(small, (0, 0), LENS_LIMITS.blur_share * small.shape[1]).astype(np.float32)
        mean = soft.mean(axis=(0, 1))
        soft = np.clip(soft * (1 - LENS_LIMITS.veil_share) + LENS_LIMITS.veil_share * 1.6 * mean, 0, 255).astype(
            np.uint8
        )
        soft = cv2.resize(soft, (width, height), interpolation=cv2.INTER_LINEAR)
        kept = cv2.multiply(rgb, self._sharp, scale=1 / 255)
        return np.asarray(cv2.add(kept, cv2.multiply(soft, self._soft, scale=1 / 255)), dtype=np.uint8)


def _in_channels(share: NDArray[np.float32]) -> Pixels:
    """Convert shares (H, W) from 0 to 1 to bytes (H, W, 3)."""
    return np.ascontiguousarray(np.broadcast_to(np.rint(255 * share)[..., None].astype(np.uint8), (*share.shape, 3)))


def _dirt(
    size: tuple[int, int], amount: float, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return two maps (H, W): the share of the image that is out of focus, and the share of the light that passes."""
    width, height = size
    cover, dark = (np.zeros((height, width), dtype=np.float32) for _ in range(2))
    for x, y, big, tall, turn, thick in rng.uniform(0, 1, (rng.poisson(LENS_LIMITS.smears * amount), 6)).tolist():
        radius = width * (0.008 + 0.06 * big**3)
        axes = (radius, radius * (0.5 + 1.6 * tall * big))
        smear = _blob(size, (x * width, y * height), axes, 180 * turn, 0.25 + 0.2 * big)
        cover = np.maximum(cover, smear * (0.35 + 0.65 * thick))
    for x, y, big, thick in rng.uniform(0, 1, (rng.poisson(LENS_LIMITS.specks * amount), 4)).tolist():
        radius = width * (0.001 + 0.004 * big**2)
        dark = np.maximum(dark, _blob(size, (x * width, y * height), (radius, radius), 0.0, 0.6) * thick)
    # A film covers all of the glass and is thicker towards the lower edge, where water runs and dries.
    film = 0.12 * amount * (0.4 + 0.6 * np.linspace(0, 1, height, dtype=np.float32)[:, None] ** 3)
    cover = np.maximum(np.minimum(LENS_LIMITS.thickest, cover * (0.5 + 0.5 * amount)), film)
    return np.asarray(cover, dtype=np.float32), np.asarray(1 - LENS_LIMITS.darkest * dark, dtype=np.float32)


def _blob(
    size: tuple[int, int], center: tuple[float, float], axes: tuple[float, float], degrees: float, soft: float
) -> NDArray[np.float32]:
    """Return a map (H, W) that is 1 inside an ellipse and falls to 0 over the share `soft` of its smaller axis."""
    canvas = np.zeros((size[1], size[0]), dtype=np.uint8)
    (x, y), (a, b) = center, axes
    cv2.ellipse(canvas, ((x, y), (2 * a, 2 * b), degrees), 255, -1, cv2.LINE_AA)
    return np.asarray(cv2.GaussianBlur(canvas, (0, 0), max(soft * min(axes), 0.6)) / np.float32(255), dtype=np.float32)
