"""Bodies of people on foot whose knees bend, with what they wear and carry."""

from typing import Final

import numpy as np

from skope.gen.bystanders import luggage
from skope.gen.bystanders.joints import leg_angles, shin, stepping, thigh
from skope.gen.bystanders.luggage import load_of
from skope.gen.bystanders.people import SHOULDER_HEIGHT, Look, arm, head, torso, turn_about
from skope.gen.bystanders.shapes import ball, trunk
from skope.gen.mesh import Mesh, merged
from skope.types import Array

_HELD: Final = {
    "umbrella": (1.0, None),
    "pushchair": (0.95, 0.95),
    "suitcase": (-0.45, None),
    "shopping bag": (0.0, None),
}
"""Angles from upright of the right and of the left arm with a load, radians; None for an arm that swings."""


def walker(look: Look) -> tuple[Mesh, ...]:
    """Body; right arm, left arm, right thigh, left thigh; right shin, left shin."""
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
    """A coat, a skirt or neither, and perhaps a cap."""
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
    """(6, 4, 4) poses of a walker's arms and legs; an arm swings with the leg of the other side."""
    h, g = look.height, look.girth
    held = _HELD.get(load_of(look), (None, None))
    legs = [angle for angle, _ in leg_angles(look, travelled, speed)]
    shoulder, arms = 0.102 * h * g + 0.012 * h, []
    for side, angle, leg in zip((-1, 1), held, reversed(legs), strict=True):
        arms.append(turn_about(0.85 * leg if angle is None else angle, (0.0, side * shoulder, SHOULDER_HEIGHT * h)))
    return np.concatenate([np.stack(arms), stepping(look, travelled, speed)])
