"""When the camera has observed the road: without that, nothing counted and nothing observed look alike."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.errors import UserError
from skope.files.json_files import check_version, read_json
from skope.types import Array

FOOTAGE: Final = "footage.json"
"""What `skope eval track` writes of its footage, beside the tracks."""
_VERSION: Final = 1
_GAP_S: Final = 1.0
"""Between frames that are farther apart than this, and than `_GAP_STEPS` usual steps, nothing was observed."""
_GAP_STEPS: Final = 3.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Observation:
    """The frames of a footage and what is known of its camera."""

    times_s: Array
    """(F,) seconds of the frames in which places are known, rising."""
    source: str = ""
    """Name of the footage."""
    common_sigma: float | None = None
    """Relative standard deviation that all distances and speeds share, from the camera's calibration; None: nothing
    says how well the camera is known."""

    @property
    def spans(self) -> Array:
        """(S, 2) begin and end of the times without a gap, seconds.

        A frame stands for a usual step from its time on, so that a footage lasts as long as its frames are shown.
        """
        if len(self.times_s) == 0:
            return np.zeros((0, 2))
        steps = np.diff(self.times_s)
        usual = float(np.median(steps)) if len(steps) else 0.0
        cuts = np.flatnonzero(steps > max(_GAP_S, _GAP_STEPS * usual))
        begins = self.times_s[np.concatenate([[0], cuts + 1]).astype(int)]
        ends = self.times_s[np.concatenate([cuts, [len(self.times_s) - 1]]).astype(int)]
        return np.stack([begins, ends + usual], axis=1)

    def seconds_in(self, begin_s: float, end_s: float) -> float:
        """How many seconds from `begin_s` to `end_s` were observed."""
        spans = np.clip(self.spans, begin_s, end_s)
        return float((spans[:, 1] - spans[:, 0]).sum())

    def together(self, one_s: float, other_s: float) -> bool:
        """Whether all between two times was observed."""
        low, high = sorted((one_s, other_s))
        return bool(((self.spans[:, 0] <= low) & (high <= self.spans[:, 1])).any())

    def to_dict(self, moved_s: Sequence[float] = ()) -> dict[str, Any]:
        """What `footage.json` holds; `moved_s` are times of frames in which the camera had been moved."""
        return {
            "version": _VERSION,
            "source": self.source,
            "times_s": [round(float(time), 4) for time in self.times_s],
            "moved_times_s": [round(float(time), 4) for time in moved_s],
            "common_sigma": self.common_sigma,
        }


def read_observation(folder: Path) -> Observation:
    """What `skope eval track` has written of the footage in a folder of tracks.

    Raises:
        UserError: It is missing or wrong; the message names the file and the field.
    """
    path = folder / FOOTAGE
    if not path.is_file():
        raise UserError(f"{path}: no such file; `skope eval track` of this version writes it beside the tracks")
    document = read_json(path)
    if not isinstance(document, dict):
        raise UserError(f"{path}: expected an object")
    check_version(path, document.get("version"), _VERSION)
    values = document.get("times_s")
    if not isinstance(values, list) or not all(type(value) in (int, float) for value in values):
        raise UserError(f"{path}: times_s: expected a list of numbers")
    times = np.array(values, dtype=np.float64)
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise UserError(f"{path}: times_s: expected times that rise from frame to frame")
    sigma = document.get("common_sigma")
    if sigma is not None and (type(sigma) not in (int, float) or not 0 <= sigma < 1):
        raise UserError(f"{path}: common_sigma: expected a number from 0 to 1, or null")
    source = document.get("source")
    return Observation(times_s=times, source=source if isinstance(source, str) else "", common_sigma=sigma)
