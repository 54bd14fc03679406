"""Checks of gates that count badly: no room for tracks on both sides, a lane along them, places not well known."""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from skope.camera.model import Camera
from skope.types import Array

_ROOM_M: Final = 3.0
"""A track has to be seen so far from a gate on both of its sides."""
_SAMPLES: Final = 21
"""Points along a gate that are looked at."""
_BLIND: Final = 0.25
"""A gate is warned of where so much of it, as a share of its length, has no room on one side."""
_ALONG_DEG: Final = 30.0
"""Angle between a gate and a lane under which the gate runs along it."""
_KNOWN_M: Final = 1.0
"""Places of a gate are to be known to this, metres with 90%."""
_SHORTEST_M: Final = 0.5


def gate_warnings(
    line: Array, camera: Camera, lanes: Sequence[tuple[Array, float]], place_error: Callable[[Array], Array] | None
) -> list[str]:
    """Sentences on what is wrong with a gate.

    Args:
        line: (2, 2) its ends on the road, metres.
        camera: The camera that sees it, over a road at z = 0.
        lanes: Lines (N, 2) along the lanes and their widths, metres.
        place_error: Takes pixels (..., 2) to errors of places in metres (...,); None: they are not known.
    """
    along = line[1] - line[0]
    length = float(np.linalg.norm(along))
    if length < _SHORTEST_M:
        return [f"is {length:.1f} m long: nothing can cross it"]
    spots = line[0] + np.linspace(0, 1, _SAMPLES)[:, None] * along
    out = []
    seen = _seen(camera, spots)
    if not seen.any():
        return ["lies outside the image: nothing can be seen to cross it"]
    left = np.array([-along[1], along[0]]) / length
    for side, sign in (("left", 1.0), ("right", -1.0)):
        blind = float(np.mean(~(seen & _seen(camera, spots + sign * _ROOM_M * left))))
        if blind >= _BLIND:
            much = "all" if blind == 1 else f"{blind:.0%}"
            out.append(
                f"{much} of it has no {_ROOM_M:g} m of road in the image on its {side}: "
                "tracks there are never on both sides"
            )
    out += _lanes_along(line, lanes)
    if place_error is not None:
        errors = place_error(camera.project(_on_road(spots[seen]))[0])
        worst = float(np.nanmax(errors)) if np.isfinite(errors).any() else math.nan
        if worst > _KNOWN_M:
            out.append(f"places on it are known to {worst:.1f} m only (90%), more than {_KNOWN_M:g} m")
    return out


def _lanes_along(line: Array, lanes: Sequence[tuple[Array, float]]) -> list[str]:
    """A sentence where a gate runs along a lane that it touches."""
    along = line[1] - line[0]
    for lane, width in lanes:
        for a, b in itertools.pairwise(lane):
            if np.allclose(a, b) or _distance(line, np.stack([a, b])) > width / 2:
                continue
            cosine = abs(float(along @ (b - a))) / (float(np.linalg.norm(along)) * float(np.linalg.norm(b - a)))
            angle = math.degrees(math.acos(min(1.0, cosine)))
            if angle < _ALONG_DEG:
                return [f"runs along a lane ({angle:.0f} degrees to it): draw it across"]
    return []


def _distance(one: Array, other: Array) -> float:
    """Distance of two line segments (2, 2)."""
    from shapely import LineString

    return float(LineString(one).distance(LineString(other)))


def _on_road(xy: Array) -> Array:
    return np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], axis=-1)


def _seen(camera: Camera, xy: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """(N,) which places (N, 2) of the road are in the image."""
    return camera.inside(camera.project(_on_road(xy))[0])
