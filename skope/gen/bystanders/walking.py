"""Jointed bodies of pedestrians with clothes and luggage: legs, gait, and the placing of feet."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.bystanders import luggage
from skope.gen.bystanders.luggage import load_of
from skope.gen.bystanders.people import (
    HIP,
    SHOULDER_HEIGHT,
    STRIDE_SHARE,
    Look,
    arm,
    ball,
    head,
    limb,
    torso,
    trunk,
    turn_about,
)
from skope.gen.mesh import Mesh, box, merged
from skope.types import Array


@dataclass(frozen=True)
class WalkerPosture:
    """Leg proportions and gait of walkers."""

    thigh: float = 0.245
    """Length from hip to knee, as a fraction of the body's height."""
    shin: float = 0.245
    """Length from knee to ankle, as a fraction of the body's height."""
    swing_rad: float = 0.40
    """Largest angle of a walker's thigh from the vertical, radians."""
    bend_rad: float = 0.95
    """Largest angle of a walker's knee, in the middle of the forward swing, radians."""


WALKER_POSTURE: Final = WalkerPosture()

SOLE_SHARE: Final = HIP - WALKER_POSTURE.thigh - WALKER_POSTURE.shin
"""Height of the ankle above the ground, as a fraction of the body's height."""
_HEEL, _TOES = -0.036, 0.105
"""Ends of a shoe behind and in front of the ankle, as fractions of the body's height."""


def thigh(look: Look) -> Mesh:
    """Build a thigh that hangs from the origin."""
    h, g = look.height, look.girth
    *_, bottom, _ = look.colors()
    path = [(0, 0, 0.02 * h), (0.008 * h, 0, -0.12 * h), (0, 0, -WALKER_POSTURE.thigh * h)]
    knee = ball(path[-1], (0.036 * h * g,) * 3, bottom)
    return merged([limb(path, (0.052 * h * g, 0.046 * h * g, 0.035 * h * g), bottom), knee])


def shin(look: Look) -> Mesh:
    """Build a lower leg with its shoe, hanging from the knee at the origin."""
    h, g = look.height, look.girth
    *_, bottom, shoes = look.colors()
    path = [(0, 0, 0), (-0.008 * h, 0, -0.09 * h), (0, 0, -WALKER_POSTURE.shin * h)]
    low = -(WALKER_POSTURE.shin + SOLE_SHARE) * h
    return merged(
        [
            limb(path, (0.035 * h * g, 0.036 * h * g, 0.024 * h * g), bottom),
            ball((0.03 * h, 0, low + 0.024 * h), (0.075 * h, 0.028 * h, 0.023 * h), shoes),
            box((_HEEL * h, -0.026 * h, low), (_TOES * h, 0.026 * h, low + 0.014 * h), shoes),
        ]
    )


def leg_angles(look: Look, travelled: float, speed: float) -> list[tuple[float, float]]:
    """Return the angles of a walker's right and left leg: thigh forward from the vertical, and knee, radians.

    The knee bends while the leg swings forwards. A standing person has two straight legs.
    """
    pace = min(speed / 1.2, 1.3)
    phase = 2 * np.pi * travelled / (STRIDE_SHARE * look.height)
    out = []
    for at in (phase, phase + np.pi):
        bend = 0.05 + WALKER_POSTURE.bend_rad * max(0.0, float(np.cos(at + 0.35))) ** 2
        out.append((pace * (WALKER_POSTURE.swing_rad * float(np.sin(at)) + 0.05), min(pace, 1.0) * bend))
    return out


def stepping(look: Look, travelled: float, speed: float) -> Array:
    """Return the poses (4, 4, 4) of a walker's right and left thigh, and right and left shin, in the body's frame."""
    h, g = look.height, look.girth
    thighs, shins = [], []
    for side, (angle, knee) in zip((-1, 1), leg_angles(look, travelled, speed), strict=True):
        T = turn_about(angle, (0.0, side * 0.05 * h * g, HIP * h))
        thighs.append(T)
        shins.append(T @ turn_about(-knee, (0.0, 0.0, -WALKER_POSTURE.thigh * h)))
    return np.stack([*thighs, *shins])


def sunk(look: Look, travelled: float, speed: float) -> float:
    """Return how far a walker's body sinks so that the lower foot is on the ground, metres."""
    down = []
    for angle, knee in leg_angles(look, travelled, speed):
        shin_angle = angle - knee
        # A tilted shoe touches the ground with its heel or its toes.
        sole = (WALKER_POSTURE.shin + SOLE_SHARE) * np.cos(shin_angle) - np.sin(shin_angle) * np.array([_HEEL, _TOES])
        down.append(WALKER_POSTURE.thigh * np.cos(angle) + sole.max())
    return float(look.height * (HIP - max(down)))


def leg_to(look: Look, hip: ArrayLike, ankle: ArrayLike) -> tuple[Array, Array]:
    """Return the poses (4, 4) of thigh and shin of a leg from a hip (3,) to an ankle (3,), with the knee bent forwards.

    If the ankle is out of reach, the leg is stretched towards it.
    """
    a, b = WALKER_POSTURE.thigh * look.height, WALKER_POSTURE.shin * look.height
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
    """Return the pose (4, 4) that moves a part hanging from the origin to between two points."""
    z = (top - low) / np.linalg.norm(top - low)
    x = np.array([1.0, 0.0, 0.0]) - z[0] * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(z, x), z]), top
    return T


ARM_ANGLES: Final = {
    "umbrella": (1.0, None),
    "pushchair": (0.95, 0.95),
    "suitcase": (-0.45, None),
    "shopping bag": (0.0, None),
}
"""Angles of the right and the left arm from the vertical for each load, radians; None for an arm that swings."""


def walker(look: Look) -> tuple[Mesh, ...]:
    """Build the body; right arm, left arm, right thigh, left thigh; right shin, left shin."""
    h = look.height
    *_, top, _, _ = look.colors()
    neck = np.array([0.0, 0.0, 0.82 * h])
    body = [torso(look), *head(look, neck), *_clothes(look)]
    right = [arm(look, top)]
    load = load_of(look)
    if load == "backpack":
        body += luggage.backpack(look, neck)
    elif load == "suitcase":
        body += luggage.suitcase(look)
    elif load == "umbrella":
        body += luggage.umbrella(look)
    elif load == "pushchair":
        body += luggage.pushchair(look)
    elif load == "shopping bag":
        right += luggage.shopping_bag(look)
    return merged(body), merged(right), arm(look, top), thigh(look), thigh(look), shin(look), shin(look)


def _clothes(look: Look) -> list[Mesh]:
    """Build a coat, a skirt or neither, and in some cases a cap."""
    h, g = look.height, look.girth
    *_, top, bottom, _ = look.colors()
    out, kind = [], look.digit(2, 6)
    if kind == 0:
        levels = ((0.30, 0.088, 0.110), (0.42, 0.080, 0.106), (0.56, 0.070, 0.098))
        out.append(trunk([((0.0, 0.0, z * h), rx * h * g, ry * h * g) for z, rx, ry in levels], top))
    elif kind == 1:
        levels = ((0.29, 0.105, 0.120), (0.42, 0.085, 0.108), (0.55, 0.066, 0.092))
        out.append(trunk([((0.0, 0.0, z * h), rx * h * g, ry * h * g) for z, rx, ry in levels], bottom))
    if look.digit(3, 4) == 0:
        middle = np.array([0.010 * h, 0.0, 0.938 * h])
        out.append(ball(middle, (0.063 * h, 0.053 * h, 0.072 * h), luggage.cloth(look), above=0.35))
    return out


def walked(look: Look, travelled: float, speed: float) -> Array:
    """Return the poses (6, 4, 4) of a walker's arms and legs; each arm swings with the opposite leg."""
    h, g = look.height, look.girth
    held = ARM_ANGLES.get(load_of(look), (None, None))
    thigh_angles = [angle for angle, _ in leg_angles(look, travelled, speed)]
    shoulder, arms = 0.102 * h * g + 0.012 * h, []
    for side, angle, thigh_angle in zip((-1, 1), held, reversed(thigh_angles), strict=True):
        arms.append(
            turn_about(0.85 * thigh_angle if angle is None else angle, (0.0, side * shoulder, SHOULDER_HEIGHT * h))
        )
    return np.concatenate([np.stack(arms), stepping(look, travelled, speed)])
