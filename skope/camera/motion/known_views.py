"""The views that a video shows one after another, as `info` of its frames says, and where the first view's pixels lie
in each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.motion.view_registration import ViewHomography
from skope.dataset.folder import CHANGES
from skope.errors import UserError
from skope.types import Array

MOVING: Final = -1
"""Number in place of a view's, for frames that were taken while the camera was moving."""


@dataclass(frozen=True, eq=False)
class KnownView:
    """One of the views of a video."""

    begin_s: float
    """Time from which frames show it, or the movement to it, seconds."""
    settled_s: float
    """Time from which the camera stands still in it, seconds."""
    from_first: ViewHomography | None
    """Where pixels of the first view lie in it; None: not surely known."""


def read_views(name: str, info: Mapping[str, Any]) -> list[KnownView]:
    """Read the views of a video, the first one included.

    Args:
        name: The name of the frames' file, for errors.
        info: The `info` of the frames' file.

    Raises:
        UserError: `info.view_changes` is malformed.
    """
    first = KnownView(-np.inf, -np.inf, ViewHomography(np.eye(3), 0.0, 0.0))
    changes = info.get(CHANGES)
    if not isinstance(changes, list):
        return [first]
    try:
        return [first, *map(_view, changes)]
    except (KeyError, TypeError, ValueError):
        raise UserError(
            f"{name}: info.{CHANGES}: expected objects with time_s, and perhaps settled_s, homography (3 rows of 3 "
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
    """(N,) index in `views` of the view that frames at times (N,) show; `MOVING` while the camera was moving."""
    times = np.asarray(times_s, dtype=np.float64)
    number = np.searchsorted([view.begin_s for view in views[1:]], times, side="right")
    settled = np.array([view.settled_s for view in views])
    return np.where(times >= settled[number], number, MOVING)
