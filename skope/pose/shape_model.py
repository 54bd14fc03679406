"""The shape space of vehicles: of each body type the mean and principal directions of its keypoints and dimensions.

`vehicle_shapes.json` is worked out from the fleet by `scripts/vehicle_shapes.py`. Coordinates are the vehicle frame's
(x forward, y left, z up, origin on the ground under the middle of the box), metres. A shape is `mean + a @ directions`,
where the numbers `a` are independent and of unit variance among vehicles of the type.
"""

from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from skope import keypoints
from skope.errors import UserError
from skope.files.json_files import read_json
from skope.types import Array

SHAPE_ROWS: Final = keypoints.K + 1
"""Rows of a shape: the keypoints and, last, length, width and height."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """Shapes that vehicles can have: T body types with M directions each."""

    types: tuple[str, ...]
    share: Array
    """(T,) how often each is seen, sum 1."""
    mean: Array
    """(T, 34, 3) mean keypoints and, last, mean dimensions, metres."""
    directions: Array
    """(T, M, 34, 3) metres for one standard deviation."""
    rest: Array
    """(T, 33) standard deviation of a keypoint beyond the directions, metres an axis."""
    edition: int = keypoints.EDITION
    """By which edition of the definition the keypoints are marked."""

    @classmethod
    def known(cls, points: ArrayLike, size_lwh: ArrayLike, *, name: str = "known") -> Self:
        """Make the shape of a vehicle that is known.

        Args:
            points: (33, 3) keypoints in the vehicle frame, metres.
            size_lwh: (3,) length, width and height, metres.
            name: What the body type is called.

        Returns:
            One body type without directions: nothing of its shape is free.
        """
        row = np.concatenate([np.asarray(points, dtype=np.float64), [np.asarray(size_lwh, dtype=np.float64)]])
        return cls((name,), np.ones(1), row[None], np.zeros((1, 0, SHAPE_ROWS, 3)), np.zeros((1, keypoints.K)))

    def mean_vehicle(self) -> Array:
        """(34, 3) keypoints and dimensions of the average vehicle on the road."""
        return np.asarray(np.einsum("t,tki->ki", self.share, self.mean))


@cache
def fleet_shapes(edition: int = keypoints.EDITION) -> Shapes:
    """The shape space that skope ships, of keypoints that are marked by an edition of their definition."""
    with resources.as_file(resources.files("skope.pose").joinpath(of_edition("vehicle_shapes", edition))) as path:
        return read_shapes(path)


def of_edition(stem: str, edition: int) -> str:
    """Name of the file that was worked out from models that were marked by an edition of the definition."""
    return f"{stem}.json" if edition == keypoints.EDITION else f"{stem}_edition_{edition}.json"


def read_shapes(path: Path) -> Shapes:
    """Read a file of `scripts/vehicle_shapes.py`. Raises UserError, naming file and type, where it is malformed."""
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
    return Shapes(tuple(types), share / share.sum(), mean, directions, rest, document.get("edition", 1))
