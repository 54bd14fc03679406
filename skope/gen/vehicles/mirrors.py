"""Mirrors of heavy vehicles: a tall housing with a wide-angle glass below the main one, on two arms."""

import numpy as np

from skope.gen.mesh import Mesh, merged, quads
from skope.gen.vehicles.parts import block
from skope.gen.vehicles.solids import pipe
from skope.types import Array


def arm_mirror(
    root: tuple[float, float, float], material: str, *, reach: float = 0.25, high: float = 0.62, ahead: float = 0.0
) -> tuple[Mesh, Array]:
    """A mirror whose arms stand at `root` on the body's side, `high` and `ahead` of there, and its outer tip."""
    x, y, z = root
    inner, outer = y + reach - 0.2, y + reach
    middle = z + high / 2 - 0.05
    low, top = middle - high / 2, middle + high / 2
    at = x + ahead
    housing = block((at - 0.06, inner, low), (at + 0.08, outer, top), material, 0.05)
    panes = [
        [
            (at - 0.0615, inner + 0.025, a),
            (at - 0.0615, outer - 0.025, a),
            (at - 0.0615, outer - 0.025, b),
            (at - 0.0615, inner + 0.025, b),
        ]
        for a, b in ((low + 0.24 * high, top - 0.05), (low + 0.05, low + 0.22 * high))
    ]
    glass = quads(np.array(panes)[:, ::-1], "glass_mirror")
    arms = [
        pipe((x, y - 0.06, level), (at + 0.01, inner + 0.06, level + lift), 0.018, "trim", sides=6)
        for level, lift in ((low + 0.08, 0.0), (top - 0.08, 0.0))
    ]
    return merged([housing, glass, *arms]), np.array([at + 0.01, outer, middle])
