"""When the camera has observed the road: without that, nothing counted and nothing observed look alike."""

import math
from dataclasses import dataclass, field
from functools import cached_property
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
_CUT_S: Final = 1.0
"""What begins or ends so near to where the footage does, or a gap in it, is cut by that."""


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
    eye: tuple[float, float, float] | None = None
    """Where the camera hangs, world, metres; None: not known."""
    focal_px: float | None = None
    """The camera's focal length, pixels; None: not known."""
    road_sigma_m: float = 0.0
    """By how much vehicles stand above and below the plane that the road is taken for, one standard deviation."""
    moved_s: Array = field(default_factory=lambda: np.zeros(0))
    """(M,) seconds of the frames after the camera had been moved, rising: they are not among `times_s`."""
    sight: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(L, 3) times (s), rising, brightness (0 to 1) and contrast of pictures of the footage; empty: not measured."""

    @cached_property
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

    def is_cut(self, time_s: float) -> bool:
        """Whether what begins or ends at a time is cut by the footage or by a gap in it, not lost."""
        return not len(self.spans) or bool(np.abs(self.spans - time_s).min() < _CUT_S)

    def pixels_per_metre(self, place: Array) -> float | None:
        """How many pixels a metre across the line of sight is at a place (2,) of the road; None: not known."""
        if self.eye is None or self.focal_px is None:
            return None
        return self.focal_px / max(1.0, math.dist(self.eye, (*map(float, place), 0.0)))

    def to_dict(self) -> dict[str, Any]:
        """What `footage.json` holds."""
        return {
            "version": _VERSION,
            "source": self.source,
            "times_s": [round(float(time), 4) for time in self.times_s],
            "moved_times_s": [round(float(time), 4) for time in self.moved_s],
            "common_sigma": self.common_sigma,
            "eye": self.eye,
            "focal_px": self.focal_px,
            "road_sigma_m": self.road_sigma_m,
            "sight": self.sight.tolist(),
        }


def held_s(times_s: Array, begin_s: float, end_s: float) -> Array:
    """(N,) for how many seconds from `begin_s` to `end_s` each frame stands: until the next one, but for gaps."""
    steps = np.diff(times_s)
    usual = float(np.median(steps)) if len(steps) else 0.0
    ends = times_s + np.append(np.minimum(steps, _GAP_STEPS * usual), usual)[: len(times_s)]
    return np.asarray(np.clip(ends, begin_s, end_s) - np.clip(times_s, begin_s, end_s))


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
    times = _numbers(path, document, "times_s")
    if (np.diff(times) <= 0).any():
        raise UserError(f"{path}: times_s: expected times that rise from frame to frame")
    for name in ("common_sigma", "road_sigma_m"):
        sigma = document.get(name)
        if sigma is not None and (type(sigma) not in (int, float) or not 0 <= sigma < 1):
            raise UserError(f"{path}: {name}: expected a number from 0 to 1, or null")
    eye = None if document.get("eye") is None else _numbers(path, document, "eye")
    if eye is not None and len(eye) != 3:
        raise UserError(f"{path}: eye: expected three numbers")
    focal = document.get("focal_px")
    if focal is not None and (type(focal) not in (int, float) or not 0 < focal < math.inf):
        raise UserError(f"{path}: focal_px: expected a number above 0, or null")
    source = document.get("source")
    return Observation(
        times_s=times,
        source=source if isinstance(source, str) else "",
        common_sigma=document.get("common_sigma"),
        eye=None if eye is None else (float(eye[0]), float(eye[1]), float(eye[2])),
        focal_px=document.get("focal_px"),
        road_sigma_m=document.get("road_sigma_m") or 0.0,
        moved_s=np.unique(_numbers(path, document, "moved_times_s")) if "moved_times_s" in document else np.zeros(0),
        sight=checked_sight(document.get("sight"), f"{path}: sight"),
    )


def checked_sight(rows: Any, where: str) -> Array:
    """(L, 3) `Observation.sight` of a file's rows, empty without any. Raises UserError that begins with `where`."""
    if rows is None or rows == []:
        return np.zeros((0, 3))
    try:
        values = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.ndim != 2 or values.shape[1] != 3 or not np.isfinite(values).all() or (np.diff(values[:, 0]) <= 0).any():
        raise UserError(f"{where}: expected rows of time, brightness and contrast, at times that rise")
    return values


def _numbers(path: Path, document: dict[str, Any], name: str) -> Array:
    values = document.get(name)
    if not isinstance(values, list) or not all(type(value) in (int, float) for value in values):
        raise UserError(f"{path}: {name}: expected a list of numbers")
    numbers = np.array(values, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise UserError(f"{path}: {name}: expected finite numbers")
    return numbers
