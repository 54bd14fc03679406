"""The road as it looks from straight above, for drawing on it: north is up, a cell is a square of metres."""

import base64
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.ground_plane import ground_places
from skope.camera.model import Camera
from skope.errors import UserError
from skope.viewer.pictures import encoded

_REACH: Final = 9.0
"""The view ends at so many times the camera's height."""
_REACH_M: Final = (25.0, 80.0)
_LONGER_SIDE: Final = 1000
"""Cells along the longer side."""
_EMPTY: Final = (226, 226, 226)


def seen_from_above(camera: Camera, pixels: NDArray[np.uint8] | None) -> dict[str, Any]:
    """Show the road of a camera's picture (H, W, 3), or of an empty one (None), from above.

    Returns `low` and `high`, world x, y of the south-west and north-east corners in metres, `cell_m`, `size` in cells,
    and `image`, a data address.
    """
    low, high = _extent(camera)
    cell = float(np.max(high - low)) / _LONGER_SIDE
    width, height = (int(v) for v in np.maximum(1, np.ceil((high - low) / cell)))
    x = low[0] + (np.arange(width) + 0.5) * cell
    y = high[1] - (np.arange(height) + 0.5) * cell
    places = np.stack([*np.meshgrid(x, y), np.zeros((height, width))], axis=-1)
    at = camera.project(places)[0]
    seen = camera.inside(at)
    above = np.full((height, width, 3), _EMPTY, dtype=np.uint8)
    if pixels is not None:
        index = np.where(seen[..., None], at - 0.5, -1e4).astype(np.float32)
        warped = cv2.remap(pixels, index[..., 0], index[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        above[seen] = warped[seen]
    else:
        above[seen] = 245
    picture = encoded(above)
    return {
        "low": low.tolist(),
        "high": [float(low[0] + width * cell), float(high[1])],
        "cell_m": cell,
        "size": [width, height],
        "image": f"data:{picture.media_type};base64,{base64.b64encode(picture.data).decode()}",
    }


def _extent(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(2,) and (2,) corners of the rectangle that holds the road near the camera."""
    reach = float(np.clip(_REACH * camera.position[2], *_REACH_M))
    u, v = np.meshgrid(np.linspace(0, camera.width, 41), np.linspace(0, camera.height, 41))
    places = ground_places(camera, np.stack([u, v], axis=-1)).reshape(-1, 3)
    away = np.linalg.norm(places[:, :2] - camera.position[:2], axis=-1)
    near = places[np.isfinite(away) & (away < reach), :2]
    if len(near) < 3:
        raise UserError("the camera sees no road near it")
    low, high = near.min(axis=0), near.max(axis=0)
    return low, np.maximum(high, low + 1.0)
