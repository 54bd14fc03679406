"""Extent of a road user in the image: boxes, mask and pixel counts."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from pycocotools import mask as coco_mask

from skope.camera.model import Camera
from skope.gen.render.frame import RenderedFrame
from skope.types import Array, Mask


@dataclass(frozen=True, eq=False)
class Extent:
    """Boxes, mask and pixel counts of a road user in the image."""

    bbox: Array
    """(4,) x, y, width, height of the silhouette inside the image, pixels."""
    bbox_visible: Array
    """(4,) x, y, width, height of the visible pixels."""
    segmentation: dict[str, Any]
    """Visible pixels as COCO's RLE."""
    visible: int
    """Number of visible pixels."""
    inside: int
    """Number of pixels of the whole silhouette inside the image."""
    whole: int
    """Number of pixels of the whole silhouette, inside and outside the image."""

    def fields(self) -> dict[str, Any]:
        """Return the fields of `schema.Labelled` that follow from the extent."""
        return {
            "bbox": self.bbox,
            "bbox_visible": self.bbox_visible,
            "segmentation": self.segmentation,
            "area": self.visible,
            "area_full": self.inside,
            "occlusion": 1 - self.visible / self.inside,
            "truncation": 1 - self.inside / self.whole,
        }


def measure_extent(view: RenderedFrame, i: int, camera: Camera) -> Extent | None:
    """Measure the boxes, mask and pixel counts of a road user; return None if no pixel of it is visible.

    Args:
        view: The rendered frame.
        i: Index of the road user in the frame.
        camera: Camera of the frame.
    """
    silhouette = view.silhouettes[i]
    height, width = silhouette.mask.shape
    x0, y0 = max(silhouette.x, 0), max(silhouette.y, 0)
    x1, y1 = min(silhouette.x + width, camera.width), min(silhouette.y + height, camera.height)
    visible = view.ids[y0:y1, x0:x1] == i + 1
    if not visible.any():
        return None
    whole = silhouette.mask[y0 - silhouette.y : y1 - silhouette.y, x0 - silhouette.x : x1 - silhouette.x]
    # The silhouette is drawn in another window, where an edge can round to the neighbouring pixel. Visible pixels are
    # always part of the vehicle.
    inside = whole | visible
    corner = np.array([x0, y0, 0, 0])
    return Extent(
        bbox_of(inside) + corner,
        bbox_of(visible) + corner,
        _segmentation(visible, (x0, y0), (camera.width, camera.height)),
        int(np.count_nonzero(visible)),
        int(np.count_nonzero(inside)),
        int(np.count_nonzero(silhouette.mask) + np.count_nonzero(inside) - np.count_nonzero(whole)),
    )


def _segmentation(mask: Mask, corner: tuple[int, int], size: tuple[int, int]) -> dict[str, Any]:
    """Return COCO's RLE of an image of `size` (width, height) that contains only a mask at `corner` (x, y)."""
    (x0, y0), (width, height) = corner, size
    # RLE runs go down the columns; an empty row at the end separates the runs of adjacent columns.
    columns = np.pad(mask, ((0, 1), (0, 0))).T.ravel()
    edges = np.flatnonzero(np.diff(columns, prepend=False))
    column, row = np.divmod(edges, len(mask) + 1)
    edges = (x0 + column) * height + y0 + row
    # If a mask is as high as the image, a run can end where the next one begins: such runs are joined.
    meets = np.flatnonzero(edges[1:] == edges[:-1])
    edges = np.delete(edges, np.concatenate([meets, meets + 1]))
    counts = np.diff(edges[edges < width * height], prepend=0, append=width * height).tolist()
    rle = coco_mask.frPyObjects({"size": [height, width], "counts": counts}, height, width)
    return {"size": [height, width], "counts": rle["counts"].decode()}


def bbox_of(mask: Mask) -> Array:
    """Return x, y, width and height (4,) of the tight box around the pixels of a mask (H, W)."""
    return np.array(cv2.boundingRect(mask.view(np.uint8)), dtype=np.float64)
