"""People: proportions after Drillis and Contini (Body Segment Parameters, 1966), clothes, and how they walk; limbs and
bodies are tubes with elliptic sections."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.mesh import Mesh, box, flat, grid, merged
from skope.types import Array

CrossSection = tuple[tuple[float, float, float], float, float]
"""Centre, and half the depth (x) and width (y) of an ellipse, metres."""


def trunk(sections: Sequence[CrossSection], material: str, sides: int = 10) -> Mesh:
    """A closed upright body through level elliptic sections, from the lowest to the highest."""
    (low, *_), (high, *_) = sections[0], sections[-1]
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    rings = [
        np.asarray(center) + np.stack([rx * np.cos(angle), ry * np.sin(angle), 0 * angle], axis=-1)
        for center, rx, ry in ((low, 1e-4, 1e-4), *sections, (high, 1e-4, 1e-4))
    ]
    return grid(np.stack(rings), [[material] * sides] * (len(rings) - 1))


def limb(path: Sequence[ArrayLike], radii: Sequence[float], material: str, sides: int = 7) -> Mesh:
    """A closed round limb along points (N, 3) with a radius at each."""
    p = np.array([np.asarray(point, dtype=np.float64) for point in path])
    along = np.gradient(p, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along, [1.0, 0.0, 0.0])
    flat = np.linalg.norm(side, axis=1, keepdims=True) < 0.3
    side = np.where(flat, np.cross(along, [0.0, 1.0, 0.0]), side)
    u = side / np.linalg.norm(side, axis=1, keepdims=True)
    w = np.cross(along, u)
    angle = np.linspace(0, 2 * np.pi, sides + 1)[:, None]
    ends = [1e-4, *radii, 1e-4]
    centers = [p[0], *p, p[-1]]
    frames = [(u[0], w[0]), *zip(u, w, strict=True), (u[-1], w[-1])]
    rings = [
        c + r * (np.cos(angle) * a + np.sin(angle) * b) for c, r, (a, b) in zip(centers, ends, frames, strict=True)
    ]
    return grid(np.stack(rings), [[material] * sides] * (len(rings) - 1))


def ball(center: ArrayLike, radii: tuple[float, float, float], material: str, *, above: float = -1.0) -> Mesh:
    """An ellipsoid, or what of it lies above a share of its height (-1: all)."""
    steps = np.linspace(np.arcsin(above), np.pi / 2, 6)
    angle = np.linspace(0, 2 * np.pi, 11)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = [np.column_stack([around * np.cos(step), np.full(len(angle), np.sin(step))]) for step in steps]
    return grid(np.asarray(center) + np.array(rings) * radii, [[material] * 10] * (len(steps) - 1))


def lens(center: ArrayLike, radius: float, material: str) -> Mesh:
    """The glass of a lamp: a disc that faces forward where it lies before the origin, else backward.

    Which way a lamp shines is worked out from its surface, and a closed one faces nowhere.
    """
    x, y, z = np.asarray(center, dtype=np.float64)
    angle = np.linspace(0, 2 * np.pi, 9)[:-1] * (1 if x > 0 else -1)
    return flat([np.stack([0 * angle + x, y + radius * np.cos(angle), z + radius * np.sin(angle)], axis=-1)], material)


EMPTY_MESH = Mesh(
    np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), ("trim",), np.zeros(0, np.int64)
)
"""A part that a body does without."""


SKIN_COLORS: Final = ("#ffccaa", "#ddaa88", "#bb8866", "#886644", "#553322")
HAIR_COLORS: Final = ("#221111", "#332211", "#554422", "#887755", "#999999")
TOP_COLORS: Final = ("#222233", "#334466", "#777788", "#dddddd", "#882222", "#335544", "#aa8855", "#ddaa33", "#113355")
BOTTOM_COLORS: Final = ("#222233", "#333344", "#445577", "#776655", "#111111")
SHOE_COLORS: Final = ("#222222", "#dddddd", "#664433")

HIP, SHOULDER_HEIGHT = 0.53, 0.785
"""Heights of the joints, as shares of the body's height."""
STRIDE_SHARE: Final = 0.83
"""Length of two steps at a usual pace, as a share of the body's height."""


@dataclass(frozen=True)
class Look:
    """Numbers that decide a bystander's body and clothes."""

    height: float = 1.72
    """Height of the body, metres."""
    girth: float = 1.0
    """Factor on the girth of a slim body."""
    palette: float = 0.0
    """Number of a set of colours of clothes, skin and hair, from 0."""
    bag: float = 0.0
    """Whether the person carries a bag: yes above 0.5."""
    jointed: float = 0.0
    """Whether knees bend, feet are on pedals and the numbers below count: yes above 0.5."""
    helmet: float = 0.0
    """Whether a cyclist wears a helmet: yes above 0.5."""
    load: float = 0.0
    """The load that is carried or drawn: number of one of `skope.gen.bystanders.luggage.LUGGAGE_KINDS`."""
    passenger: float = 0.0
    """Whether somebody rides along, on a bicycle a child in its seat: yes above 0.5."""
    machine: float = 0.0
    """The machine that is ridden: number of one of `skope.gen.bystanders.riding.MACHINE_NAMES`."""

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Look":
        grown = rng.random() > 0.12
        height = rng.normal(1.70, 0.09) if grown else rng.uniform(1.1, 1.5)
        return cls(
            round(float(np.clip(height, 1.1, 1.98)), 2),
            round(float(rng.uniform(0.95, 1.3)), 2),
            float(rng.integers(2**20)),
            float(rng.random() < 0.35),
        )

    def to_dict(self) -> Mapping[str, float]:
        """The numbers by name."""
        return asdict(self)

    def colors(self) -> tuple[str, str, str, str, str]:
        """Skin, hair, top, bottom, shoes."""
        number, out = int(self.palette), []
        for choices in (SKIN_COLORS, HAIR_COLORS, TOP_COLORS, BOTTOM_COLORS, SHOE_COLORS):
            number, which = divmod(number, len(choices))
            out.append(choices[which])
        return tuple(out)  # type: ignore[return-value]

    def digit(self, place: int, choices: int) -> int:
        """A further number below `choices` that follows from the palette, another one for each `place`."""
        number: int = int(self.palette) // (3375 * 7**place)
        return number % choices


def head(look: Look, at: Array) -> list[Mesh]:
    """Neck, head and hair of a body whose neck starts at a point (3,)."""
    h = look.height
    skin, hair, *_ = look.colors()
    middle = at + [0.015 * h, 0.0, 0.115 * h]
    return [
        limb([at, middle], (0.032 * h, 0.03 * h), skin),
        ball(middle, (0.056 * h, 0.045 * h, 0.066 * h), skin),
        ball(middle + [-0.012 * h, 0, 0.006 * h], (0.055 * h, 0.049 * h, 0.067 * h), hair, above=-0.2),
    ]


def torso(look: Look) -> Mesh:
    """The body from the hips to the neck, upright over the origin."""
    h, g = look.height, look.girth
    *_, top, bottom, _ = look.colors()
    levels = [(0.50, 0.060, 0.088), (0.55, 0.066, 0.094), (0.61, 0.058, 0.084), (0.70, 0.066, 0.096)]
    levels += [(0.77, 0.062, 0.108), (0.81, 0.046, 0.098), (0.835, 0.030, 0.05)]
    at = [((0.0, 0.0, z * h), rx * h * g, ry * h * g) for z, rx, ry in levels]
    return merged([trunk(at[:2], bottom), trunk(at[1:], top)])


def pedestrian(look: Look) -> tuple[Mesh, ...]:
    """Body; right arm, left arm, right leg, left leg, about shoulder and hip."""
    h = look.height
    *_, top, _, _ = look.colors()
    body = [torso(look), *head(look, np.array([0.0, 0.0, 0.82 * h]))]
    if look.bag > 0.5:
        body.append(box((-0.15 * h, -0.08 * h, 0.60 * h), (-0.05 * h, 0.08 * h, 0.79 * h), "#333344"))
    return merged(body), arm(look, top), arm(look, top), leg(look), leg(look)


def arm(look: Look, sleeve: str) -> Mesh:
    """An arm that hangs from the origin."""
    h, g = look.height, look.girth
    skin = look.colors()[0]
    elbow, wrist = np.array([-0.01 * h, 0.0, -0.18 * h]), np.array([0.02 * h, 0.0, -0.33 * h])
    return merged(
        [
            limb(
                [(0, 0, 0.012 * h), (0, 0, -0.01 * h), elbow, wrist],
                (0.018 * h, 0.034 * h * g, 0.027 * h * g, 0.02 * h),
                sleeve,
            ),
            ball(wrist + [0.005 * h, 0, -0.035 * h], (0.02 * h, 0.013 * h, 0.042 * h), skin),
        ]
    )


def leg(look: Look) -> Mesh:
    """A leg that hangs from the origin, its sole at the ground when it is straight."""
    h, g = look.height, look.girth
    *_, bottom, shoes = look.colors()
    knee, ankle = np.array([0.012 * h, 0, -0.245 * h]), np.array([-0.005 * h, 0, -(HIP - 0.04) * h])
    foot = box((-0.035 * h, -0.026 * h, -HIP * h), (0.105 * h, 0.026 * h, -(HIP - 0.038) * h), shoes)
    return merged([limb([(0, 0, 0.02 * h), knee, ankle], (0.05 * h * g, 0.036 * h * g, 0.026 * h * g), bottom), foot])


def turn_about(angle: float, at: tuple[float, float, float]) -> Array:
    """(4, 4) a turn about y, forward for what hangs, at a point."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, -s, at[0]], [0, 1, 0, at[1]], [s, 0, c, at[2]], [0, 0, 0, 1.0]])


def strides(look: Look, travelled: float) -> Array:
    """Poses of a walker's limbs; opposite arm and leg swing together."""
    h, g = look.height, look.girth
    swing = float(np.sin(2 * np.pi * travelled / (STRIDE_SHARE * h)))
    shoulder, hip = 0.102 * h * g, 0.05 * h * g
    return np.stack(
        [
            turn_about(-0.4 * swing, (0.0, -shoulder - 0.012 * h, SHOULDER_HEIGHT * h)),
            turn_about(0.4 * swing, (0.0, shoulder + 0.012 * h, SHOULDER_HEIGHT * h)),
            turn_about(0.38 * swing, (0.0, -hip, HIP * h)),
            turn_about(-0.38 * swing, (0.0, hip, HIP * h)),
        ]
    )


def lowered(look: Look, travelled: float) -> float:
    """Way that a walker's body comes down where both legs are apart, metres."""
    swing = 0.38 * np.sin(2 * np.pi * travelled / (STRIDE_SHARE * look.height))
    return float(HIP * look.height * (1 - np.cos(swing)))
