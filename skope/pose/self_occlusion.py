"""Keypoints that a vehicle's own body hides from a camera: detectors put those anywhere, with high scores.

`keypoint_visibility.json` is worked out from the fleet by `scripts/vehicle_sight.py`: of each body type and keypoint
the logistic regression of "seen" on the direction from the keypoint to the eye, which tells 97 to 99% of them right.
"""

from functools import cache
from importlib import resources
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.errors import UserError
from skope.files.json_files import read_json
from skope.pose.shape_model import Shapes, of_edition
from skope.types import Array

_FIELD_COUNT: Final = 4


@cache
def _fleet_sight(edition: int) -> dict[str, Array]:
    """Body type -> (33, 4) weights of a logistic regression: of the direction's x, y, z in the vehicle frame, and 1."""
    with resources.as_file(resources.files("skope.pose").joinpath(of_edition("keypoint_visibility", edition))) as path:
        document = read_json(path)
    if not isinstance(document, dict) or document.get("scheme") != keypoints.SCHEME:
        raise UserError(f"{path}: scheme: expected keypoint scheme {keypoints.SCHEME!r}")
    return {name: np.reshape(row, (keypoints.K, _FIELD_COUNT)) for name, row in document["types"].items()}


def facing(shapes: Shapes, kind: NDArray[np.intp], points: Array, eye: Array) -> NDArray[np.bool_]:
    """Find the keypoints that a camera sees past the vehicle's own body.

    Args:
        shapes: The body types.
        kind: (N,) index of each vehicle's body type in `shapes`. Of a type that the fleet has not, all are seen.
        points: (N, 33, 3) keypoints in the vehicle frame, metres.
        eye: (N, 3) the camera's position in the vehicle frame, metres.

    Returns:
        (N, 33) whether each keypoint is seen.
    """
    always = np.tile([0.0, 0.0, 0.0, 1.0], (keypoints.K, 1))
    weights = np.stack([_fleet_sight(shapes.edition).get(name, always) for name in shapes.types])[kind]
    away = eye[:, None] - points
    away = away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
    return np.asarray(np.einsum("nki,nki->nk", away, weights[..., :3]) + weights[..., 3] > 0)
