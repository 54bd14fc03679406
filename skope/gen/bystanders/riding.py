"""Bodies of riders of bicycles, motorcycles and scooters, with feet on pedals, pegs or (when stopped) the road."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skope.gen.bystanders import luggage
from skope.gen.bystanders.luggage import load_of
from skope.gen.bystanders.people import Look, ball, lens, limb, trunk, turn_about
from skope.gen.bystanders.riders import (
    MACHINE_SIZES,
    full_helmet,
    motor_paint,
    motor_wheel,
    roadster,
    spoked,
    upper_body,
)
from skope.gen.bystanders.walking import SOLE_SHARE, leg_to, shin, thigh
from skope.gen.mesh import Mesh, box, lathe, merged, tube
from skope.types import Array

MACHINE_NAMES: Final = {
    "cyclist": ("city bicycle", "racing bicycle"),
    "motorcyclist": ("roadster", "scooter", "tourer"),
}
"""Two-wheelers by kind of rider, indexed by `Look.machine`."""
_CITY, _RACING = range(2)
_ROADSTER, _SCOOTER, _TOURER = range(3)


@dataclass(frozen=True)
class RiderPosture:
    """Posture of riders, and dimensions of bicycles."""

    usual_height_m: float = 1.72
    """Height of the body that bicycles are drawn for, metres; smaller people have smaller bicycles."""
    wheel_m: float = 0.34
    """Radius of a bicycle's wheel, metres."""
    crank_m: float = 0.17
    """Length of the crank, metres."""
    gear: float = 2.4
    """Turns of the wheel per turn of the pedals."""
    standing_mps: float = 1.6
    """Speed below which a rider's left foot moves down to the road, m/s."""
    lean_rad: float = 0.09
    """Lean of a stopped rider towards the left foot, radians."""


RIDER_POSTURE: Final = RiderPosture()

_FRONT_WHEEL, _REAR = 0.54, -0.50
CRANK_POSITION: Final = np.array([-0.06, 0.0, 0.28])
HIP_POSITION: Final = np.array([-0.20, 0.0, 0.94])
HELMET_COLORS: Final = ("#dddddd", "#222233", "#aa2222", "#ddaa33", "#334466")
_MOTOR_HIP: Final = {_ROADSTER: (-0.20, 0.0, 0.88), _SCOOTER: (-0.24, 0.0, 0.86), _TOURER: (-0.22, 0.0, 0.88)}
PEG_PLACES: Final = {_ROADSTER: (-0.06, 0.17, 0.36), _SCOOTER: (0.16, 0.12, 0.33), _TOURER: (-0.14, 0.17, 0.38)}
"""Positions of the left sole by index of the machine, metres."""
_SCOOTER_WHEEL, _SCOOTER_AXLES = 0.24, (0.64, -0.62)


# ------------------------------------------------------------------------------------------------------------ bicycles


def bicycle(look: Look) -> tuple[Mesh, ...]:
    """Build bicycle and rider; front wheel, rear wheel, right thigh, left thigh; right shin, left shin, pedals."""
    usual, scale = replace(look, height=RIDER_POSTURE.usual_height_m), look.height / RIDER_POSTURE.usual_height_m
    racing = int(look.machine) == _RACING
    bar = np.array([0.40, 0.0, 0.92 if racing else 1.04])
    shoulder = HIP_POSITION + ([0.46, 0.0, 0.30] if racing else [0.26, 0.0, 0.43])
    parts = _frame(look, bar) + upper_body(
        usual, HIP_POSITION, shoulder, bar + [0.04 if racing else -0.06, 0.24, 0.02], 1.0
    )
    neck = shoulder + [0.07, 0.0, 0.01]
    if look.helmet > 0.5:
        color = HELMET_COLORS[look.digit(2, len(HELMET_COLORS))]
        parts.append(ball(neck + [0.02, 0.0, 0.215], (0.125, 0.095, 0.115), color, above=-0.1))
    load = load_of(look)
    if load == "backpack":
        parts += luggage.backpack(usual, shoulder + [-0.04, 0.0, 0.0])
    elif load == "delivery box":
        parts += luggage.delivery_box(look, shoulder + [-0.16, 0.0, -0.42], 0.44)
    elif load == "panniers":
        parts += luggage.panniers(look, np.array([-0.24, 0.0, 0.78]), 0.28)
    elif load == "basket":
        parts.append(box((0.48, -0.18, 0.86), (0.80, 0.18, 1.08), "rail"))
    elif load == "trailer":
        parts += [part.moved((_REAR, 0.0, 0.0)) for part in luggage.trailer(look)]
    if look.passenger > 0.5:
        parts += _child(look)
    legs = (thigh(usual), thigh(usual), shin(usual), shin(usual), _pedals())
    return tuple(
        _scaled(part, scale)
        for part in (merged(parts), spoked(RIDER_POSTURE.wheel_m), spoked(RIDER_POSTURE.wheel_m), *legs)
    )


def _frame(look: Look, bar: Array) -> list[Mesh]:
    """Build a bicycle without wheels and pedals, with its handlebar at a point (3,)."""
    paint = "#" + ("aa2222", "224488", "222222", "dddddd", "227744", "cc7722")[look.digit(0, 6)]
    seat, stem, low = np.array([-0.22, 0, 0.80]), np.array([0.35, 0, 0.84]), np.array([0.40, 0, 0.64])
    front, rear = np.array([_FRONT_WHEEL, 0, RIDER_POSTURE.wheel_m]), np.array([_REAR, 0, RIDER_POSTURE.wheel_m])
    parts = [
        tube([a, b], (0.018, 0.018), paint, 6)
        for a, b in ((CRANK_POSITION, seat), (seat, stem), (CRANK_POSITION, low), (low, stem))
    ]
    for side in (-0.05, 0.05):
        aside = np.array([0, side, 0])
        parts += [tube([end, rear + aside], (0.012, 0.010), paint, 5) for end in (CRANK_POSITION, seat * [1, 1, 0.92])]
        parts.append(tube([low, low + aside - [0, 0, 0.02], front + aside], (0.016, 0.014, 0.012), paint, 5))
    grip = bar + ([0.05, 0, 0.0] if int(look.machine) == _RACING else [-0.08, 0, 0.0])
    parts += [
        tube([stem, bar], (0.014, 0.014), "trim", 5),
        tube([grip + [0, -0.27, 0], bar, grip + [0, 0.27, 0]], (0.013,) * 3, "trim", 5),
        trunk([((-0.21, 0, 0.86), 0.13, 0.06), ((-0.22, 0, 0.90), 0.14, 0.09), ((-0.23, 0, 0.91), 0.12, 0.08)], "trim"),
        tube([seat, seat + [-0.01, 0, 0.08]], (0.014,) * 2, "rail", 5),
        ball((0.47, 0, 0.80), (0.035, 0.03, 0.03), "trim"),
        lens((0.507, 0, 0.80), 0.028, "reverse_light"),
        box((-0.31, -0.025, 0.70), (-0.28, 0.025, 0.75), "trim"),
        lens((-0.312, 0, 0.725), 0.03, "taillight"),
    ]
    if int(look.machine) == _CITY:
        rack = np.array([[-0.22, 0.06, 0.76], [-0.66, 0.06, 0.76]])
        parts += [tube(rack * [1, s, 1], (0.008,) * 2, "trim", 4) for s in (-1, 1)]
        parts += [_mudguard(x) for x in (_FRONT_WHEEL, _REAR)]
    return parts


def _mudguard(x: float) -> Mesh:
    angle = np.linspace(0.35, 2.6, 7)
    path = np.stack(
        [
            x + (RIDER_POSTURE.wheel_m + 0.02) * np.cos(angle),
            0 * angle,
            RIDER_POSTURE.wheel_m + (RIDER_POSTURE.wheel_m + 0.02) * np.sin(angle),
        ],
        axis=-1,
    )
    return tube(path, (0.022,) * len(path), "trim", 5)


def _pedals() -> Mesh:
    """Build cranks, pedals and chain wheel around the axle at the origin, with the right pedal at the bottom."""
    parts = [lathe([(-0.075, 0.09), (-0.065, 0.09)], ["rim"], 12, "y")]
    for side in (-1, 1):
        end = np.array([0.0, side * 0.09, side * RIDER_POSTURE.crank_m])
        parts.append(tube([end * [1, 1, 0], end], (0.012,) * 2, "rim", 5))
        parts.append(box(end + [-0.045, -0.045, -0.01], end + [0.045, 0.045, 0.01], "trim"))
    return merged(parts)


def _child(look: Look) -> list[Mesh]:
    """Build a child in a seat behind the saddle."""
    small = replace(look, height=1.0, girth=1.1, palette=float(int(look.palette) // 3))
    hip = np.array([-0.50, 0.0, 0.86])
    seat = [
        box((-0.66, -0.15, 0.80), (-0.36, 0.15, 0.86), "#444455"),
        box((-0.70, -0.15, 0.82), (-0.65, 0.15, 1.28), "#444455"),
    ]
    parts = upper_body(small, hip, hip + [-0.02, 0.0, 0.27], (-0.36, 0.10, 1.00), 0.0)
    helmet = ball(hip + [0.03, 0.0, 0.42], (0.085, 0.07, 0.075), HELMET_COLORS[look.digit(1, 5)], above=-0.1)
    *_, bottom, _ = small.colors()
    legs = [
        limb([hip + [0, y, 0], hip + [0.16, y, 0], hip + [0.16, 1.4 * y, -0.24]], (0.05, 0.045, 0.035), bottom)
        for y in (-0.1, 0.1)
    ]
    return [*seat, *parts, helmet, *legs]


def pedalling(look: Look, travelled: float, speed: float) -> Array:
    """Return the poses (7, 4, 4) of a bicycle's wheels, its rider's legs and its pedals."""
    scale, usual = look.height / RIDER_POSTURE.usual_height_m, replace(look, height=RIDER_POSTURE.usual_height_m)
    turn = travelled / (RIDER_POSTURE.wheel_m * scale)
    angle = -turn / RIDER_POSTURE.gear
    wheels = [turn_about(-turn, (x, 0.0, RIDER_POSTURE.wheel_m)) for x in (_FRONT_WHEEL, _REAR)]
    ankles = []
    for side, phase in ((-1, angle), (1, angle + np.pi)):
        pedal = CRANK_POSITION + RIDER_POSTURE.crank_m * np.array([np.sin(phase), 0.0, -np.cos(phase)])
        ankles.append(pedal + [-0.03, side * 0.115, SOLE_SHARE * RIDER_POSTURE.usual_height_m + 0.01])
    ankles[1] = _foot_down(ankles[1], np.array([-0.02, 0.30, SOLE_SHARE * RIDER_POSTURE.usual_height_m]), speed)
    thighs, shins = _legs(usual, HIP_POSITION, 0.08, ankles)
    T = np.stack(
        [*wheels, *thighs, *shins, turn_about(angle, (CRANK_POSITION[0], CRANK_POSITION[1], CRANK_POSITION[2]))]
    )
    T[:, :3, 3] *= scale
    return T


# --------------------------------------------------------------------------------------------- motorcycles and scooters


def motorcycle(look: Look) -> tuple[Mesh, ...]:
    """Build motorcycle, rider, passenger; front wheel, rear wheel, right thigh, left thigh; right shin, left shin."""
    machine, paint = int(look.machine), motor_paint(look)
    wheel = motor_wheel(_SCOOTER_WHEEL if machine == _SCOOTER else MACHINE_SIZES.motor_wheel_m)
    if machine == _SCOOTER:
        parts = [
            *_scooter_body(paint),
            lens((0.503, 0, 0.94), 0.06, "headlight"),
            lens((-0.862, 0, 0.62), 0.05, "taillight"),
        ]
    else:
        parts = [
            *roadster(paint),
            lens((0.716, 0, 0.86), 0.07, "headlight"),
            lens((-0.882, 0, 0.73), 0.04, "taillight"),
        ]
    if machine == _TOURER:
        parts += _fairing(paint)
    h = look.height
    hip = np.array(_MOTOR_HIP[machine])
    shoulder = hip + np.array([0.10 if machine == _SCOOTER else 0.20, 0.0, 0.47]) * h / RIDER_POSTURE.usual_height_m
    hands = (0.40, 0.30, 1.02) if machine == _SCOOTER else (0.47, 0.34, 1.04)
    parts += upper_body(look, hip, shoulder, hands, 0.5)
    parts += full_helmet(shoulder + [0.05, 0.0, 0.01], h, paint)
    if look.passenger > 0.5:
        parts += _pillion(look, hip + [-0.32, 0.0, 0.05])
    parts += _motor_load(look, shoulder)
    return merged(parts), wheel, wheel, thigh(look), thigh(look), shin(look), shin(look)


def _scooter_body(paint: str) -> list[Mesh]:
    """Build a scooter without its wheels."""
    front, _ = _SCOOTER_AXLES
    parts = [
        box((-0.20, -0.17, 0.26), (0.34, 0.17, 0.32), "trim"),
        trunk([((0.36, 0, 0.28), 0.05, 0.16), ((0.40, 0, 0.60), 0.06, 0.22), ((0.40, 0, 0.96), 0.05, 0.13)], paint),
        trunk([((-0.46, 0, 0.32), 0.26, 0.10), ((-0.46, 0, 0.50), 0.38, 0.17), ((-0.42, 0, 0.70), 0.38, 0.16)], paint),
        trunk([((-0.40, 0, 0.70), 0.38, 0.13), ((-0.40, 0, 0.77), 0.40, 0.14), ((-0.42, 0, 0.80), 0.34, 0.12)], "trim"),
        trunk(
            [
                ((front, 0, 0.40), 0.17, 0.07),
                ((front - 0.02, 0, 0.48), 0.20, 0.08),
                ((front - 0.04, 0, 0.52), 0.14, 0.06),
            ],
            paint,
        ),
        tube([(0.42, 0, 0.60), (front, 0, _SCOOTER_WHEEL)], (0.035, 0.03), "chrome", 6),
        tube([(0.36, -0.32, 1.02), (0.42, 0.0, 1.0), (0.36, 0.32, 1.02)], (0.016,) * 3, "trim", 6),
        ball((0.44, 0, 0.94), (0.06, 0.08, 0.075), "headlight"),
        box((-0.86, -0.10, 0.58), (-0.82, 0.10, 0.66), "taillight"),
        box((-0.88, -0.09, 0.38), (-0.85, 0.09, 0.53), "plate"),
        tube([(-0.30, -0.2, 0.30), (-0.78, -0.2, 0.34)], (0.04, 0.05), "trim", 7),
    ]
    for side in (-1, 1):
        parts.append(tube([(0.36, side * 0.28, 1.02), (0.36, side * 0.34, 1.16)], (0.008,) * 2, "trim", 4))
        parts.append(box((0.34, side * 0.34 - 0.06, 1.14), (0.37, side * 0.34 + 0.06, 1.22), "glass_mirror"))
    return parts


def _fairing(paint: str) -> list[Mesh]:
    """Build the fairing and windscreen of a touring motorcycle."""
    levels = ((0.42, 0.40, 0.26, 0.15), (0.46, 0.62, 0.28, 0.19), (0.54, 0.84, 0.22, 0.21), (0.52, 0.98, 0.14, 0.18))
    return [
        trunk([((x, 0, z), rx, ry) for x, z, rx, ry in levels], paint),
        trunk(
            [((0.54, 0, 0.97), 0.10, 0.17), ((0.46, 0, 1.14), 0.07, 0.14), ((0.41, 0, 1.24), 0.03, 0.08)],
            "glass_tinted",
        ),
        lens((0.79, 0, 0.82), 0.07, "headlight"),
    ]


def _pillion(look: Look, hip: Array) -> list[Mesh]:
    """Build a passenger behind the rider."""
    passenger = replace(look, height=min(look.height, 1.68), palette=float(int(look.palette) // 7))
    h = passenger.height
    shoulder = hip + np.array([0.06, 0.0, 0.48]) * h / RIDER_POSTURE.usual_height_m
    parts = upper_body(passenger, hip, shoulder, hip + [0.26, 0.17, 0.16], 0.2)
    *_, bottom, shoes = passenger.colors()
    for side in (-1, 1):
        joint, ankle = hip + [0.0, side * 0.10, 0.0], np.array([hip[0] + 0.12, side * 0.19, 0.46])
        knee = hip + [0.36, side * 0.17, -0.10]
        parts.append(limb([joint, knee, ankle], (0.05 * h, 0.038 * h, 0.026 * h), bottom))
        parts.append(box(ankle + [-0.07, -0.045, -0.06], ankle + [0.17, 0.045, 0.01], shoes))
    return [*parts, *full_helmet(shoulder + [0.04, 0.0, 0.01], h, HELMET_COLORS[look.digit(1, 5)])]


def _motor_load(look: Look, shoulder: Array) -> list[Mesh]:
    load, rear = load_of(look), np.array([-0.66, 0.0, 0.84])
    if load == "backpack":
        return luggage.backpack(look, shoulder + [-0.02, 0.0, 0.0])
    if load == "panniers":
        return luggage.panniers(look, np.array([-0.46, 0.0, 0.80]), 0.50)
    if load == "delivery box":
        return luggage.delivery_box(look, rear + [0.20, 0.0, 0.0], 0.46)
    if load == "top case":
        levels = ((-0.90, 0.84, 0.16, 0.20), (-0.90, 0.98, 0.19, 0.23), (-0.89, 1.12, 0.15, 0.19))
        return [trunk([((x, 0, z), rx, ry) for x, z, rx, ry in levels], "trim")]
    return []


def riding(look: Look, travelled: float, speed: float) -> Array:
    """Return the poses (6, 4, 4) of a motorcycle's wheels and its rider's legs."""
    machine = int(look.machine)
    radius, axles = (
        (_SCOOTER_WHEEL, _SCOOTER_AXLES)
        if machine == _SCOOTER
        else (MACHINE_SIZES.motor_wheel_m, MACHINE_SIZES.motor_axles_m)
    )
    wheels = [turn_about(-travelled / radius, (x, 0.0, radius)) for x in axles]
    sole, (x, y, z) = SOLE_SHARE * look.height, PEG_PLACES[machine]
    ankles = [np.array([x, side * y, z + sole]) for side in (-1, 1)]
    ankles[1] = _foot_down(ankles[1], np.array([-0.04, 0.36, sole]), speed)
    thighs, shins = _legs(look, np.array(_MOTOR_HIP[machine]), 0.10, ankles)
    return np.stack([*wheels, *thighs, *shins])


# ----------------------------------------------------------------------------------------------------------------- both


def standing_share(speed: float) -> float:
    """Return how far a rider at a speed (m/s) stands on the left foot, from 0 (rides) to 1 (stands)."""
    share = float(np.clip(1 - speed / RIDER_POSTURE.standing_mps, 0.0, 1.0))
    return share * share * (3 - 2 * share)


def standing_lean(speed: float) -> float:
    """Return the lean to the left of a rider at a speed (m/s), radians."""
    return RIDER_POSTURE.lean_rad * standing_share(speed)


def _foot_down(riding_at: Array, ground: Array, speed: float) -> Array:
    """Return the position of the left ankle between a pedal or peg and the road: first outwards, then down."""
    share = standing_share(speed)
    # For a rider who leans to the left, the road is higher on that side.
    lifted = ground + [0.0, 0.0, ground[1] * np.tan(standing_lean(speed))]
    return np.asarray(riding_at + share * (lifted - riding_at) + [0.0, 0.12 * share * (1 - share), 0.0])


def _legs(look: Look, hip: Array, apart: float, ankles: list[Array]) -> tuple[list[Array], list[Array]]:
    """Return the poses of both thighs and both shins, right and left, with the hips `apart` from the middle."""
    pairs = [leg_to(look, hip + [0.0, side * apart, 0.0], ankle) for side, ankle in zip((-1, 1), ankles, strict=True)]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


def _scaled(mesh: Mesh, scale: float) -> Mesh:
    return Mesh(mesh.vertices * scale, mesh.normals, mesh.triangles, mesh.materials, mesh.material)
