"""Legs that bend at the knee: their meshes, how walkers step, and how a foot is held where it has to be."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.bystanders.people import HIP, STRIDE, Look, turn_about
from skope.gen.bystanders.shapes import ball, limb
from skope.gen.mesh import Mesh, box, merged
from skope.types import Array

THIGH: Final = 0.245
"""From hip to knee, as a share of the body's height."""
SHIN: Final = 0.245
"""From knee to ankle."""
SOLE: Final = HIP - THIGH - SHIN
"""From ankle to ground."""
_HEEL, _TOES = -0.036, 0.105
"""Ends of a shoe behind and before the ankle, as shares of the body's height."""
_SWING: Final = 0.40
"""Largest angle of a walker's thigh from upright, radians."""
_BEND: Final = 0.95
"""Largest angle of a walker's knee, in the middle of the leg's way forward, radians."""


def thigh(look: Look) -> Mesh:
    """A thigh that hangs from the origin."""
    h, g = look.height, look.girth
    *_, bottom, _ = look.colors()
    path = [(0, 0, 0.02 * h), (0.008 * h, 0, -0.12 * h), (0, 0, -THIGH * h)]
    knee = ball(path[-1], (0.036 * h * g,) * 3, bottom)
    return merged([limb(path, (0.052 * h * g, 0.046 * h * g, 0.035 * h * g), bottom), knee])


def shin(look: Look) -> Mesh:
    """A lower leg that hangs from the knee at the origin, with its shoe."""
    h, g = look.height, look.girth
    *_, bottom, shoes = look.colors()
    path = [(0, 0, 0), (-0.008 * h, 0, -0.09 * h), (0, 0, -SHIN * h)]
    low = -(SHIN + SOLE) * h
    return merged(
        [
            limb(path, (0.035 * h * g, 0.036 * h * g, 0.024 * h * g), bottom),
            ball((0.03 * h, 0, low + 0.024 * h), (0.075 * h, 0.028 * h, 0.023 * h), shoes),
            box((_HEEL * h, -0.026 * h, low), (_TOES * h, 0.026 * h, low + 0.014 * h), shoes),
        ]
    )


def leg_angles(look: Look, travelled: float, speed: float) -> list[tuple[float, float]]:
    """Angles of a walker's right and left leg: of the thigh from upright, forward, and of the knee, radians.

    The knee bends while the leg comes forward; who stands has both legs straight.
    """
    pace = min(speed / 1.2, 1.3)
    phase = 2 * np.pi * travelled / (STRIDE * look.height)
    out = []
    for at in (phase, phase + np.pi):
        bend = 0.05 + _BEND * max(0.0, float(np.cos(at + 0.35))) ** 2
        out.append((pace * (_SWING * float(np.sin(at)) + 0.05), min(pace, 1.0) * bend))
    return out


def stepping(look: Look, travelled: float, speed: float) -> Array:
    """(4, 4, 4) poses of a walker's right and left thigh, right and left shin, in the body's frame."""
    h, g = look.height, look.girth
    thighs, shins = [], []
    for side, (angle, knee) in zip((-1, 1), leg_angles(look, travelled, speed), strict=True):
        T = turn_about(angle, (0.0, side * 0.05 * h * g, HIP * h))
        thighs.append(T)
        shins.append(T @ turn_about(-knee, (0.0, 0.0, -THIGH * h)))
    return np.stack([*thighs, *shins])


def sunk(look: Look, travelled: float, speed: float) -> float:
    """Way that a walker's body comes down so that the lower foot is on the ground, metres."""
    down = []
    for angle, knee in leg_angles(look, travelled, speed):
        shin_angle = angle - knee
        # A shoe that is turned stands on its heel or on its toes.
        sole = (SHIN + SOLE) * np.cos(shin_angle) - np.sin(shin_angle) * np.array([_HEEL, _TOES])
        down.append(THIGH * np.cos(angle) + sole.max())
    return float(look.height * (HIP - max(down)))


def leg_to(look: Look, hip: ArrayLike, ankle: ArrayLike) -> tuple[Array, Array]:
    """(4, 4) poses of thigh and shin of a leg from a hip (3,) to an ankle (3,), the knee bent forward.

    An ankle that is too far away is as near to its place as the leg is long.
    """
    a, b = THIGH * look.height, SHIN * look.height
    start, end = np.asarray(hip, dtype=np.float64), np.asarray(ankle, dtype=np.float64)
    away = float(np.linalg.norm(end - start))
    along = (end - start) / away
    length = float(np.clip(away, abs(a - b) + 1e-3, a + b - 1e-3))
    forward = np.array([1.0, 0.0, 0.0]) - along[0] * along
    forward /= np.linalg.norm(forward)
    cosine = (a * a + length * length - b * b) / (2 * a * length)
    knee = start + a * (cosine * along + np.sqrt(1 - cosine * cosine) * forward)
    return _hanging(start, knee), _hanging(knee, start + length * along)


def _hanging(top: Array, low: Array) -> Array:
    """(4, 4) pose that takes what hangs from the origin to between two points."""
    z = (top - low) / np.linalg.norm(top - low)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(z, x), z]), top
    return T
