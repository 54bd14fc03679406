"""People: bodies, clothes and gait, with the proportions of Drillis and Contini (Body Segment Parameters, 1966).

Limbs and bodies are tubes with elliptic sections.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.mesh import Mesh, box, flat, grid, merged
from skope.types import Array

CrossSection = tuple[tuple[float, float, float], float, float]
"""Centre, half depth (x) and half width (y) of an ellipse, metres."""


def trunk(sections: Sequence[CrossSection], material: str, sides: int = 10) -> Mesh:
    """Build a closed upright body through level elliptic sections, from the lowest to the highest."""
    (low, *_), (high, *_) = sections[0], sections[-1]
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    rings = [
        np.asarray(center) + np.stack([rx * np.cos(angle), ry * np.sin(angle), 0 * angle], axis=-1)
        for center, rx, ry in ((low, 1e-4, 1e-4), *sections, (high, 1e-4, 1e-4))
    ]
    return grid(np.stack(rings), [[material] * sides] * (len(rings) - 1))


def limb(path: Sequence[ArrayLike], radii: Sequence[float], material: str, sides: int = 7) -> Mesh:
    """Build a closed round limb along points (N, 3) with a radius at each point."""
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
    """Build an ellipsoid, or only its part above a fraction of its half height (-1: all)."""
    steps = np.linspace(np.arcsin(above), np.pi / 2, 6)
    angle = np.linspace(0, 2 * np.pi, 11)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rings = [np.column_stack([around * np.cos(step), np.full(len(angle), np.sin(step))]) for step in steps]
    return grid(np.asarray(center) + np.array(rings) * radii, [[material] * 10] * (len(steps) - 1))


def lens(center: ArrayLike, radius: float, material: str) -> Mesh:
    """Build the glass of a lamp: a disc that faces forwards if it is in front of the origin, else backwards.

    The direction of a lamp is computed from its surface; a closed surface has no direction.
    """
    x, y, z = np.asarray(center, dtype=np.float64)
    angle = np.linspace(0, 2 * np.pi, 9)[:-1] * (1 if x > 0 else -1)
    return flat([np.stack([0 * angle + x, y + radius * np.cos(angle), z + radius * np.sin(angle)], axis=-1)], material)


EMPTY_MESH = Mesh(
    np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), ("trim",), np.zeros(0, np.int64)
)
"""Empty part, for bodies without this part."""


SKIN_COLORS: Final = ("#ffccaa", "#ddaa88", "#bb8866", "#886644", "#553322")
HAIR_COLORS: Final = ("#221111", "#332211", "#554422", "#887755", "#999999")
TOP_COLORS: Final = ("#222233", "#334466", "#777788", "#dddddd", "#882222", "#335544", "#aa8855", "#ddaa33", "#113355")
BOTTOM_COLORS: Final = ("#222233", "#333344", "#445577", "#776655", "#111111")
SHOE_COLORS: Final = ("#222222", "#dddddd", "#664433")

HIP, SHOULDER_HEIGHT = 0.53, 0.785
"""Heights of the joints, as fractions of the body's height."""
STRIDE_SHARE: Final = 0.83
"""Length of two steps at a normal pace, as a fraction of the body's height."""


@dataclass(frozen=True)
class Look:
    """Numbers that determine a bystander's body, clothes and luggage."""

    height: float = 1.72
    """Height of the body, metres."""
    girth: float = 1.0
    """Factor on the girth, relative to a slim body."""
    palette: float = 0.0
    """Number of a set of colours for clothes, skin and hair, from 0."""
    bag: float = 0.0
    """Whether the person carries a bag: yes if above 0.5."""
    jointed: float = 0.0
    """Whether knees bend, feet are on pedals and the following fields apply: yes if above 0.5."""
    helmet: float = 0.0
    """Whether a cyclist wears a helmet: yes if above 0.5."""
    load: float = 0.0
    """Luggage: index into `skope.gen.bystanders.luggage.LUGGAGE_KINDS`."""
    passenger: float = 0.0
    """Whether there is a passenger (on a bicycle, a child in a child seat): yes if above 0.5."""
    machine: float = 0.0
    """Two-wheeler: index into the names in `skope.gen.bystanders.riding.MACHINE_NAMES`."""

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
        """Return the numbers by name."""
        return asdict(self)

    def colors(self) -> tuple[str, str, str, str, str]:
        """Return the colours of skin, hair, top, bottom and shoes."""
        number, out = int(self.palette), []
        for choices in (SKIN_COLORS, HAIR_COLORS, TOP_COLORS, BOTTOM_COLORS, SHOE_COLORS):
            number, which = divmod(number, len(choices))
            out.append(choices[which])
        return tuple(out)  # type: ignore[return-value]

    def digit(self, index: int, choices: int) -> int:
        """Return a number below `choices` that is derived from the palette; each `index` gives a different number."""
        number: int = int(self.palette) // (3375 * 7**index)
        return number % choices


def head(look: Look, at: Array) -> list[Mesh]:
    """Build neck, head and hair of a body with the base of the neck at a point (3,)."""
    h = look.height
    skin, hair, *_ = look.colors()
    middle = at + [0.015 * h, 0.0, 0.115 * h]
    return [
        limb([at, middle], (0.032 * h, 0.03 * h), skin),
        ball(middle, (0.056 * h, 0.045 * h, 0.066 * h), skin),
        ball(middle + [-0.012 * h, 0, 0.006 * h], (0.055 * h, 0.049 * h, 0.067 * h), hair, above=-0.2),
    ]


def torso(look: Look) -> Mesh:
    """Build the upright torso above the origin, from the hips to the neck."""
    h, g = look.height, look.girth
    *_, top, bottom, _ = look.colors()
    levels = [(0.50, 0.060, 0.088), (0.55, 0.066, 0.094), (0.61, 0.058, 0.084), (0.70, 0.066, 0.096)]
    levels += [(0.77, 0.062, 0.108), (0.81, 0.046, 0.098), (0.835, 0.030, 0.05)]
    at = [((0.0, 0.0, z * h), rx * h * g, ry * h * g) for z, rx, ry in levels]
    return merged([trunk(at[:2], bottom), trunk(at[1:], top)])


def pedestrian(look: Look) -> tuple[Mesh, ...]:
    """Build the body; right arm, left arm, right leg and left leg, each about shoulder or hip."""
    h = look.height
    *_, top, _, _ = look.colors()
    body = [torso(look), *head(look, np.array([0.0, 0.0, 0.82 * h]))]
    if look.bag > 0.5:
        body.append(box((-0.15 * h, -0.08 * h, 0.60 * h), (-0.05 * h, 0.08 * h, 0.79 * h), "#333344"))
    return merged(body), arm(look, top), arm(look, top), leg(look), leg(look)


def arm(look: Look, sleeve: str) -> Mesh:
    """Build an arm that hangs from the origin."""
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
    """Build a leg that hangs from the origin; the sole is on the ground if the leg is straight."""
    h, g = look.height, look.girth
    *_, bottom, shoes = look.colors()
    knee, ankle = np.array([0.012 * h, 0, -0.245 * h]), np.array([-0.005 * h, 0, -(HIP - 0.04) * h])
    foot = box((-0.035 * h, -0.026 * h, -HIP * h), (0.105 * h, 0.026 * h, -(HIP - 0.038) * h), shoes)
    return merged([limb([(0, 0, 0.02 * h), knee, ankle], (0.05 * h * g, 0.036 * h * g, 0.026 * h * g), bottom), foot])


def turn_about(angle: float, at: tuple[float, float, float]) -> Array:
    """Return the (4, 4) rotation about a y axis through a point; positive angles move hanging parts forwards."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, -s, at[0]], [0, 1, 0, at[1]], [s, 0, c, at[2]], [0, 0, 0, 1.0]])


def strides(look: Look, travelled: float) -> Array:
    """Return the poses of a walker's limbs; the opposite arm and leg swing together."""
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
    """Return how far a walker's body sinks when the legs are apart, metres."""
    swing = 0.38 * np.sin(2 * np.pi * travelled / (STRIDE_SHARE * look.height))
    return float(HIP * look.height * (1 - np.cos(swing)))
