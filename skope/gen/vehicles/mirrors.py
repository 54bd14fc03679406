"""Mirrors of heavy vehicles: a tall housing with a wide-angle glass below the main one, on two arms."""

import numpy as np

from skope.gen.mesh import Mesh, merged, quads
from skope.gen.vehicles.parts import block
from skope.gen.vehicles.solids import pipe
from skope.types import Array


def arm_mirror(
    root: tuple[float, float, float],
    material: str,
    *,
    reach: float = 0.25,
    high: float = 0.62,
    upright: bool = True,
    sunk: float = 0.06,
) -> tuple[Mesh, Array]:
    """A mirror `high` whose arms stand at `root` on the body's side, and its outer tip.

    Its arms lie level on an `upright` side, else both stand at its foot; they begin `sunk` inside of it.
    """
    x, y, z = root
    inner, outer = y + reach - 0.2, y + reach
    middle = z + high / 2 - 0.05
    low, top = middle - high / 2, middle + high / 2
    at = x
    housing = block((at - 0.06, inner, low), (at + 0.08, outer, top), material, 0.05)
    panes = [
        [
            (at - 0.0615, inner + 0.05, a),
            (at - 0.0615, outer - 0.05, a),
            (at - 0.0615, outer - 0.05, b),
            (at - 0.0615, inner + 0.05, b),
        ]
        for a, b in ((low + 0.24 * high, top - 0.07), (low + 0.07, low + 0.22 * high))
    ]
    glass = quads(np.array(panes)[:, ::-1], "glass_mirror")
    feet = (low + 0.08, top - 0.08) if upright else (z + 0.02, z + 0.07)
    arms = [
        pipe((x, y - sunk, foot), (at + 0.01, inner + 0.06, level), 0.018, "trim", sides=6)
        for foot, level in zip(feet, (low + 0.08, top - 0.14), strict=True)
    ]
    return merged([housing, glass, *arms]), np.array([at + 0.01, outer, middle])
