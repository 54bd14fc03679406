"""Bodies of cyclists and motorcyclists with their two-wheelers."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.bystanders.people import EMPTY_MESH, Look, ball, head, limb, trunk, turn_about
from skope.gen.mesh import Mesh, box, grid, lathe, merged, tube
from skope.types import Array


@dataclass(frozen=True)
class MachineSizes:
    """Dimensions of bicycles and motorcycles."""

    bike_wheel_m: float = 0.34
    """Radius of a bicycle's wheel, metres."""
    bike_axles_m: tuple[float, float] = (0.53, -0.52)
    """x of the front and rear axle of a bicycle, metres."""
    crank_m: tuple[float, float, float] = (-0.08, 0.0, 0.29)
    """Position of the crank, metres."""
    gear: float = 2.4
    """Turns of the wheel per turn of the pedals."""
    motor_wheel_m: float = 0.31
    """Radius of a motorcycle's wheel, metres."""
    motor_axles_m: tuple[float, float] = (0.70, -0.68)
    """x of the front and rear axle of a motorcycle, metres."""
    torso: tuple[tuple[float, float, float], ...] = (
        (0.0, 0.06, 0.088),
        (0.3, 0.06, 0.084),
        (0.65, 0.066, 0.098),
        (0.9, 0.056, 0.104),
        (1.05, 0.03, 0.05),
    )
    """Sections of a rider's torso: height, half depth and half width, metres."""


MACHINE_SIZES: Final = MachineSizes()


def tyre_ring(radius: float, thickness: float, material: str) -> Mesh:
    """Build a tyre around the y axis."""
    angle = np.linspace(0, 2 * np.pi, 25)
    path = radius * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1) * (1 - thickness / radius)
    around = np.linspace(0, 2 * np.pi, 6)
    out = path / np.linalg.norm(path, axis=1, keepdims=True)
    points = path[:, None] + thickness * (
        np.cos(around)[:, None] * out[:, None] + np.sin(around)[:, None] * np.array([0.0, 1.0, 0.0])
    )
    return grid(points, [[material] * 5] * 24)


def spoked(radius: float) -> Mesh:
    parts = [tyre_ring(radius, 0.022, "tyre"), tube([(0, -0.04, 0), (0, 0.04, 0)], (0.02, 0.02), "rim", 6)]
    for angle in np.linspace(0, np.pi, 7)[:-1]:
        end = 0.95 * radius * np.array([np.cos(angle), 0, np.sin(angle)])
        parts.append(tube([-end, end], (0.003, 0.003), "rim", 3))
    return merged(parts)


def upper_body(look: Look, hip: ArrayLike, shoulder: ArrayLike, hands: ArrayLike, lean: float) -> list[Mesh]:
    """Build torso, head and arms from a hip point to a shoulder point, with the hands on both sides of a point."""
    h, g = look.height, look.girth
    skin, _, top, bottom, _ = look.colors()
    a, b, grip = (np.asarray(p, dtype=np.float64) for p in (hip, shoulder, hands))
    upright = [((0.0, 0.0, t), rx * h * g, ry * h * g) for t, rx, ry in MACHINE_SIZES.torso]
    whole = trunk(upright, top)
    along = b - a
    R = np.array([[along[2], 0, along[0]], [0, np.hypot(along[0], along[2]), 0], [-along[0], 0, along[2]]])
    R = R / np.hypot(along[0], along[2])
    scale = np.linalg.norm(along)
    points = (whole.vertices * [1, 1, scale]) @ R.T + a
    out = [Mesh(points, whole.normals @ R.T, whole.triangles, whole.materials, whole.material)]
    out.append(ball(a + [-0.02, 0, 0], (0.075 * h * g, 0.09 * h * g, 0.06 * h), bottom))
    out += head(look, b + [0.03 + 0.04 * lean, 0.0, 0.01])
    for side in (-1, 1):
        joint, hand = b + [0.0, side * 0.105 * h * g, -0.02], grip * [1, side, 1]
        elbow = (joint + hand) / 2 + [-0.06, side * 0.05, -0.08]
        out.append(limb([joint, elbow, hand], (0.032 * h * g, 0.026 * h * g, 0.02 * h), top))
        out.append(ball(hand, (0.045, 0.03, 0.03), skin))
    return out


def _bent_leg(look: Look, hip: ArrayLike, knee: ArrayLike, foot: ArrayLike) -> Mesh:
    """Build a leg in the frame of its hip."""
    h, g = look.height, look.girth
    *_, bottom, shoes = look.colors()
    a, b, c = (np.asarray(p, dtype=np.float64) - np.asarray(hip) for p in (hip, knee, foot))
    shoe = box(c + [-0.07, -0.045, -0.045], c + [0.17, 0.045, 0.035], shoes)
    return merged([limb([a, b, c], (0.05 * h * g, 0.038 * h * g, 0.028 * h * g), bottom), shoe])


def cyclist(look: Look) -> tuple[Mesh, ...]:
    """Build bicycle and rider; front wheel, rear wheel, right leg, left leg."""
    front, rear = MACHINE_SIZES.bike_axles_m
    frame = "#" + ("aa2222", "224488", "222222", "dddddd", "227744")[int(look.palette) % 5]
    crank, seat, stem = np.array(MACHINE_SIZES.crank_m), np.array([-0.24, 0, 0.86]), np.array([0.36, 0, 0.88])
    low = np.array([0.40, 0, 0.66])
    tubes = [(crank, seat), (seat, stem), (crank, low), (low, stem)]
    parts = [tube([a, b], (0.018, 0.018), frame, 6) for a, b in tubes]
    parts += [
        tube([end, np.array([rear, 0, MACHINE_SIZES.bike_wheel_m])], (0.012, 0.01), frame, 5)
        for end in (crank, seat * [1, 1, 0.9])
    ]
    parts += [tube([low, np.array([front, 0, MACHINE_SIZES.bike_wheel_m])], (0.016, 0.012), frame, 5)]
    parts += [tube([stem, stem + [0.05, 0, 0.14]], (0.014, 0.014), "trim", 5)]
    bar = stem + [0.05, 0, 0.14]
    parts += [tube([bar + [-0.06, -0.27, 0], bar, bar + [-0.06, 0.27, 0]], (0.013,) * 3, "trim", 5)]
    parts += [
        box((-0.34, -0.07, 0.90), (-0.08, 0.07, 0.95), "trim"),
        tube([seat, seat + [-0.02, 0, 0.06]], (0.014,) * 2, "rail", 5),
    ]
    parts += [box((bar[0], -0.03, 0.80), (bar[0] + 0.06, 0.03, 0.86), "lamp_clear")]
    parts += [box((-0.36, -0.025, 0.74), (-0.33, 0.025, 0.79), "taillight")]
    hip = np.array([-0.20, 0.0, 0.98])
    shoulder = hip + np.array([0.30, 0, 0.40]) * look.height / 1.72
    parts += upper_body(look, hip, shoulder, bar + [-0.05, 0.25, 0.02], 1.0)
    # The knee of a rigid leg is at its position for a level pedal.
    foot = crank + [0.02, 0.0, -0.02]
    knee = hip + np.array([0.36, 0.0, -0.20])
    leg = _bent_leg(look, hip, knee, foot)
    wheel = spoked(MACHINE_SIZES.bike_wheel_m)
    return merged(parts), wheel, wheel, leg, leg


def pedalled(look: Look, travelled: float) -> Array:
    """Return the poses of a cyclist's wheels and legs."""
    front, rear = MACHINE_SIZES.bike_axles_m
    turn = travelled / MACHINE_SIZES.bike_wheel_m
    swing = 0.24 * float(np.sin(turn / MACHINE_SIZES.gear))
    return np.stack(
        [
            turn_about(-turn, (front, 0.0, MACHINE_SIZES.bike_wheel_m)),
            turn_about(-turn, (rear, 0.0, MACHINE_SIZES.bike_wheel_m)),
            turn_about(swing, (-0.20, -0.09, 0.98)),
            turn_about(-swing, (-0.20, 0.09, 0.98)),
        ]
    )


def motor_paint(look: Look) -> str:
    """Return the paint of a motorcycle and of its rider's helmet."""
    return "#" + ("aa1111", "113388", "111111", "dddddd", "336633", "cc6600")[int(look.palette) % 6]


def roadster(paint: str) -> list[Mesh]:
    """Build a motorcycle without fairing and wheels."""
    front, rear = MACHINE_SIZES.motor_axles_m
    parts = [
        trunk([((0.05, 0, 0.30), 0.22, 0.13), ((0.05, 0, 0.45), 0.30, 0.16), ((0.02, 0, 0.62), 0.25, 0.13)], "trim"),
        trunk([((0.16, 0, 0.66), 0.26, 0.10), ((0.16, 0, 0.78), 0.28, 0.15), ((0.14, 0, 0.88), 0.20, 0.11)], paint),
        trunk([((-0.38, 0, 0.70), 0.30, 0.10), ((-0.38, 0, 0.78), 0.36, 0.13), ((-0.36, 0, 0.82), 0.32, 0.12)], "trim"),
        box((-0.85, -0.07, 0.74), (-0.66, 0.07, 0.82), paint),
        box((-0.88, -0.06, 0.70), (-0.84, 0.06, 0.76), "taillight"),
        box((-0.92, -0.09, 0.52), (-0.89, 0.09, 0.68), "plate"),
        ball((0.60, 0, 0.86), (0.10, 0.11, 0.11), paint),
        ball((0.655, 0, 0.86), (0.06, 0.085, 0.085), "headlight"),
        tube([(0.50, -0.36, 1.02), (0.55, 0.0, 0.98), (0.50, 0.36, 1.02)], (0.016,) * 3, "trim", 6),
        tube([(-0.05, -0.17, 0.30), (-0.45, -0.19, 0.32), (-0.80, -0.20, 0.42)], (0.035, 0.045, 0.05), "chrome", 7),
    ]
    for side in (-1, 1):
        parts.append(
            tube(
                [(0.50, side * 0.09, 0.96), (front, side * 0.09, MACHINE_SIZES.motor_wheel_m)],
                (0.028, 0.025),
                "chrome",
                6,
            )
        )
        parts.append(
            tube([(-0.05, side * 0.1, 0.42), (rear, side * 0.1, MACHINE_SIZES.motor_wheel_m)], (0.03, 0.025), "trim", 5)
        )
        parts.append(tube([(0.46, side * 0.36, 1.02), (0.44, side * 0.40, 1.14)], (0.008,) * 2, "trim", 4))
        parts.append(box((0.42, side * 0.40 - 0.06, 1.12), (0.45, side * 0.40 + 0.06, 1.20), "glass_mirror"))
    return parts


def full_helmet(neck: Array, height: float, paint: str) -> list[Mesh]:
    """Build a full-face helmet with its visor, for a neck (3,) and a body height in metres."""
    return [
        ball(neck + np.array([0.02, 0, 0.12]) * height, (0.145, 0.125, 0.15), paint),
        ball(neck + np.array([0.045, 0, 0.125]) * height, (0.115, 0.105, 0.07), "glass_tinted"),
    ]


def motor_wheel(radius: float) -> Mesh:
    """Build a motorcycle wheel."""
    return merged([tyre_ring(radius, 0.06, "tyre"), lathe([(-0.04, 0.2), (0.04, 0.2)], ["rim"], 12, "y")])


def motorcyclist(look: Look) -> tuple[Mesh, ...]:
    """Build motorcycle and rider; front wheel, rear wheel."""
    paint = motor_paint(look)
    parts = roadster(paint)
    hip = np.array([-0.22, 0.0, 0.90])
    shoulder = hip + np.array([0.22, 0, 0.45]) * look.height / 1.72
    parts += upper_body(look, hip, shoulder, (0.47, 0.34, 1.04), 0.6)
    parts += full_helmet(shoulder + [0.05, 0, 0.01], look.height, paint)
    for side in (-1, 1):
        joint = hip + [0.0, side * 0.1, 0.0]
        leg = _bent_leg(look, joint, joint + [0.42, side * 0.06, -0.12], joint + [0.16, side * 0.07, -0.52])
        parts.append(leg.moved(joint))
    wheel = motor_wheel(MACHINE_SIZES.motor_wheel_m)
    return merged(parts), wheel, wheel, EMPTY_MESH, EMPTY_MESH


def rolled(look: Look, travelled: float) -> Array:
    """Return the poses of a motorcycle's wheels."""
    front, rear = MACHINE_SIZES.motor_axles_m
    turn = travelled / MACHINE_SIZES.motor_wheel_m
    at = [turn_about(-turn, (x, 0.0, MACHINE_SIZES.motor_wheel_m)) for x in (front, rear)]
    return np.stack([*at, np.eye(4), np.eye(4)])
