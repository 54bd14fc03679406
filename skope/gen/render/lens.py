"""Lens distortion: one warp for picture, depth, ids and silhouettes, from a view without distortion."""

from dataclasses import replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera, Distortion
from skope.errors import UserError
from skope.gen.render.frame import RenderedFrame, Silhouette
from skope.gen.render.pixel_windows import Window
from skope.types import Array

_LIMIT: Final = 8192
_MARGIN_PX: Final = 2
"""Pixels of the pinhole's image beyond what the lens shows."""

_WHOLE_PIXELS: Final = np.zeros((0, 0), dtype=np.uint16)
"""Parts of a pixel between those that OpenCV takes: none."""


def pinhole_of(camera: Camera) -> Camera:
    """A camera without distortion that sees all that `camera` shows, as fine as its middle.

    Raises UserError when the distortion folds the image or shows more than such a camera could.
    """
    name = f"camera.distortion {camera.distortion.model} {list(camera.distortion.coefficients)}"
    columns, rows = (np.linspace(0, side, 64) for side in (camera.width, camera.height))
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    border = np.concatenate([grid[0], grid[-1], grid[:, 0], grid[:, -1]])
    rays, valid = camera.rays(border)
    if not valid.all():
        raise UserError(f"{name}: folds back inside the image at this field of view")
    focal = camera.K[[0, 1], [0, 1]]
    low = np.floor(rays[:, :2].min(axis=0) * focal) - _MARGIN_PX
    high = np.ceil(rays[:, :2].max(axis=0) * focal) + _MARGIN_PX
    width, height = (high - low).astype(int).tolist()
    if max(width, height) > _LIMIT:
        raise UserError(f"{name}: shows more than a view of {_LIMIT} pixels without distortion")
    K = np.array([[focal[0], 0, -low[0]], [0, focal[1], -low[1]], [0, 0, 1]])
    return replace(camera, width=width, height=height, K=K, distortion=Distortion())


class Lens:
    """Takes views of a pinhole camera to those of a camera with distortion at the same place."""

    def __init__(self, camera: Camera) -> None:
        """Raises UserError as `pinhole_of` does."""
        self._camera = camera
        self.pinhole = pinhole_of(camera)
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays, _ = camera.rays(np.stack([columns, rows], axis=-1))
        K = self.pinhole.K
        source = rays[..., :2] * K[[0, 1], [0, 1]] + K[:2, 2]
        # Where in the pinhole's image each pixel's centre is, counted in OpenCV's way.
        self._columns, self._rows = (source[..., k].astype(np.float32) - np.float32(0.5) for k in (0, 1))
        self._nearest = np.floor(source).astype(np.int16)
        """(H, W, 2) column and row of the pinhole's pixel that shows each pixel's centre."""
        self._shown = _window_within(source)
        off = (source - self._nearest - 0.5).astype(np.float32)
        self._off_right, self._off_down = (np.ascontiguousarray(off[..., k]) for k in (0, 1))
        """(H, W) from the centre of the nearest pixel to there."""
        self._jacobian = [
            [np.gradient(source[..., k], axis=axis).astype(np.float32) for axis in (1, 0)] for k in (0, 1)
        ]
        """(H, W) change of the source's x, y (rows) for a pixel to the right and down (columns)."""

    def straightened(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture of a pinhole camera, from that of the lens (`rgb`, (H, W, 3)); the rim is continued outwards."""
        pinhole, camera = self.pinhole, self._camera
        columns, rows = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
        ideal, _ = pinhole.rays(np.stack([columns, rows], axis=-1))
        distorted, monotonic = camera.distortion.distort(ideal[..., :2])
        source = np.where(monotonic[..., None], distorted @ camera.K[:2, :2].T + camera.K[:2, 2], -1.0)
        x, y = (source[..., k].astype(np.float32) - np.float32(0.5) for k in (0, 1))
        return np.asarray(cv2.remap(rgb, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)

    def bent(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture of the pinhole camera as the lens shows it."""
        return np.asarray(cv2.remap(rgb, self._columns, self._rows, cv2.INTER_LINEAR), dtype=np.uint8)

    def bend(self, view: RenderedFrame) -> RenderedFrame:
        """The view as the lens shows it; depth and ids are those of the nearest pixel, depth carried on its slope."""
        depth = self._sampled(view.depth)
        right, down = cv2.split(self._sampled(view.slope))
        # Inverse depth is linear in the pixel on a plane. The sky's depth is infinite and its slope 0: it stays.
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
        """The pinhole's image at the nearest pixels."""
        return np.asarray(cv2.remap(values, self._nearest, _WHOLE_PIXELS, cv2.INTER_NEAREST))

    def _bend_silhouette(self, silhouette: Silhouette) -> Silhouette:
        """Inside the image by the same warp; beyond it, where only their number counts, pixel by pixel forwards."""
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
        """Pixels of a silhouette that are shown in the image, and have the silhouette all around them.

        They need no warp forwards: it keeps them from being the silhouette's outermost.
        """
        x0, y0, x1, y1 = self._shown
        x, y = silhouette.x, silhouette.y
        out = np.zeros_like(silhouette.mask)
        there = slice(max(y0 - y, 0), max(y1 - y, 0)), slice(max(x0 - x, 0), max(x1 - x, 0))
        around = np.ones((3, 3), dtype=np.uint8)
        inner = cv2.erode(silhouette.mask.view(np.uint8), around, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        out[there] = inner[there]
        return out

    def _sample_silhouette(self, silhouette: Silhouette, x0: int, y0: int, x1: int, y1: int) -> NDArray[np.bool_]:
        """The silhouette at the source pixels of a window of the image."""
        at = self._nearest[y0:y1, x0:x1] - np.array([silhouette.x, silhouette.y], dtype=np.int16)
        return np.asarray(cv2.remap(silhouette.mask.view(np.uint8), at, _WHOLE_PIXELS, cv2.INTER_NEAREST)).view(bool)


def _window_within(source: Array) -> Window:
    """A window of the pinhole's image whose pixels the lens all shows.

    `source` (H, W, 2) is where in the pinhole's image each pixel of the lens is. No edge of the lens' image passes
    through the window: each of the four lies on its own side of it.
    """
    left, top = np.ceil([source[:, 0, 0].max(), source[0, :, 1].max()]).astype(int) + _MARGIN_PX
    right, bottom = np.floor([source[:, -1, 0].min(), source[-1, :, 1].min()]).astype(int) - _MARGIN_PX
    return int(left), int(top), int(right), int(bottom)
