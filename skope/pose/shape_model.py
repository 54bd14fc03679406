"""The shape space of vehicles, and the keypoints that a vehicle's own body hides from a camera.

`vehicle_shapes.json` is computed from the fleet by `scripts/vehicle_shapes.py`: the mean and principal directions of
each body type's keypoints and dimensions. Coordinates are the vehicle frame's (x forward, y left, z up, origin on the
ground under the middle of the box), metres. A shape is `mean + a @ directions`, where the numbers `a` are independent
and of unit variance among vehicles of the type.

`keypoint_visibility.json` is computed from the fleet by `scripts/vehicle_shapes.py`. It holds, per body type and
keypoint, a logistic regression of "visible" on the direction from the keypoint to the camera, correct for 97 to 99% of
them. Detectors place hidden keypoints anywhere, with high scores.
"""

from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skope import keypoints
from skope.errors import UserError
from skope.files.json_files import read_json
from skope.types import Array

SHAPE_ROWS: Final = keypoints.K + 1
"""Number of rows of a shape: the keypoints and, last, length, width and height."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """Possible shapes of vehicles: T body types with M directions each."""

    types: tuple[str, ...]
    share: Array
    """(T,) relative frequency of each type, with sum 1."""
    mean: Array
    """(T, 34, 3) mean keypoints and, last, mean dimensions, metres."""
    directions: Array
    """(T, M, 34, 3) principal directions, metres per standard deviation."""
    rest: Array
    """(T, 33) standard deviation of a keypoint beyond the directions, metres per axis."""

    @classmethod
    def known(cls, points: ArrayLike, size_lwh: ArrayLike, *, name: str = "known") -> Self:
        """Make the shape of a known vehicle.

        Args:
            points: (33, 3) keypoints in the vehicle frame, metres.
            size_lwh: (3,) length, width and height, metres.
            name: Name of the body type.

        Returns:
            One body type without directions: its shape is fixed.
        """
        row = np.concatenate([np.asarray(points, dtype=np.float64), [np.asarray(size_lwh, dtype=np.float64)]])
        return cls((name,), np.ones(1), row[None], np.zeros((1, 0, SHAPE_ROWS, 3)), np.zeros((1, keypoints.K)))

    def mean_vehicle(self) -> Array:
        """Return (34, 3) keypoints and dimensions of the average vehicle on the road."""
        return np.asarray(np.einsum("t,tki->ki", self.share, self.mean))


@cache
def fleet_shapes() -> Shapes:
    """Return the shape space that comes with skope."""
    with resources.as_file(resources.files("skope.pose").joinpath("vehicle_shapes.json")) as path:
        return read_shapes(path)


def read_shapes(path: Path) -> Shapes:
    """Read a file of `scripts/vehicle_shapes.py`. Raises UserError with file and body type if it is malformed."""
    document = read_json(path)
    if not isinstance(document, dict) or document.get("scheme") != keypoints.SCHEME:
        raise UserError(f"{path}: scheme: expected shapes of keypoint scheme {keypoints.SCHEME!r}")
    types: dict[str, Any] = document.get("types") or {}
    try:
        mean = np.array([np.reshape(row["mean"], (SHAPE_ROWS, 3)) for row in types.values()])
        directions = np.array([np.reshape(row["directions"], (-1, SHAPE_ROWS, 3)) for row in types.values()])
        rest = np.array([np.reshape(row["rest"], keypoints.K) for row in types.values()])
        share = np.array([float(row["share"]) for row in types.values()])
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path}: types: {error}") from None
    if not types:
        raise UserError(f"{path}: types: none")
    return Shapes(tuple(types), share / share.sum(), mean, directions, rest)


_FIELD_COUNT: Final = 4


@cache
def _visibility_weights() -> dict[str, Array]:
    """Return (33, 4) weights of a logistic regression by body type: for x, y, z of the direction, and a constant."""
    with resources.as_file(resources.files("skope.pose").joinpath("keypoint_visibility.json")) as path:
        document = read_json(path)
    if not isinstance(document, dict) or document.get("scheme") != keypoints.SCHEME:
        raise UserError(f"{path}: scheme: expected keypoint scheme {keypoints.SCHEME!r}")
    return {name: np.reshape(row, (keypoints.K, _FIELD_COUNT)) for name, row in document["types"].items()}


def facing(shapes: Shapes, kind: NDArray[np.intp], points: Array, eye: Array) -> NDArray[np.bool_]:
    """Find the keypoints that are not hidden by the vehicle's own body.

    Args:
        shapes: The body types.
        kind: (N,) index of each vehicle's body type in `shapes`. For a type outside the fleet, all are visible.
        points: (N, 33, 3) keypoints in the vehicle frame, metres.
        eye: (N, 3) the camera's position in the vehicle frame, metres.

    Returns:
        (N, 33) whether each keypoint is visible.
    """
    always = np.tile([0.0, 0.0, 0.0, 1.0], (keypoints.K, 1))
    weights = np.stack([_visibility_weights().get(name, always) for name in shapes.types])[kind]
    away = eye[:, None] - points
    away = away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
    return np.asarray(np.einsum("nki,nki->nk", away, weights[..., :3]) + weights[..., 3] > 0)
