"""Loads on roofs: luggage boxes, bars, ladders, antennas."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.mesh import Mesh, box, grid, merged
from skope.types import Array

ROOF_LOAD_HEIGHTS_M: Final = {"box": 0.42, "bars": 0.05, "ladder": 0.12, "beacons": 0.13}
"""Height of each kind of load over the roof's highest point, metres."""
_BAR: Final = ROOF_LOAD_HEIGHTS_M["bars"]
_BOX_RING: Final = ((0.0, 0.0), (0.9, 0.0), (1.0, 0.12), (1.0, 0.5), (0.9, 0.88), (0.7, 1.0), (0.0, 1.0))
"""Half of a luggage box's section, from the middle below to the middle above: shares of its width and height."""
_BOX_SECTIONS: Final = ((1.0, 0.05), (0.98, 0.6), (0.8, 0.86), (0.4, 1.0), (-0.8, 1.0), (-0.97, 0.9), (-1.0, 0.05))
"""Shares of half the length of a luggage box from front to rear, and of its greatest section there."""


def roof_load(
    kind: str, front: float, rear: float, half_width: float, top: float, edge: Callable[[Array], Array]
) -> Mesh:
    """The left half of a load on a roof, metres.

    Args:
        kind: One of `ROOF_LOAD_HEIGHTS_M`.
        front: x of the roof's front end.
        rear: x of its rear end.
        half_width: From the middle to the roof's edge.
        top: The roof's highest point above the road.
        edge: Height of the roof's edge at x.
    """
    if kind == "beacons":
        return _beacons((front, rear), half_width, top, edge)
    high, length = top + _BAR, front - rear
    places = np.array([front - 0.25 * length, front - 0.72 * length])
    parts = []
    for x, low in zip(places.tolist(), edge(places).tolist(), strict=True):
        foot = half_width - 0.07
        parts.append(box((x - 0.03, 0.0, high - 0.025), (x + 0.03, half_width - 0.02, high), "rail"))
        parts.append(box((x - 0.032, foot, low - 0.02), (x + 0.032, half_width - 0.02, high - 0.005), "trim"))
    middle, reach = float(places.mean()), min(0.95, 0.5 * length)
    if kind == "box":
        size = (reach, min(0.4, half_width - 0.12), ROOF_LOAD_HEIGHTS_M["box"] - _BAR)
        parts.append(_shell((middle, 0.0, high), size, _BOX_SECTIONS, "#222222"))
    if kind == "ladder":
        parts += _ladder((middle - reach - 0.2, middle + reach), high)
    return merged(parts)


def _beacons(span: tuple[float, float], half_width: float, top: float, edge: Callable[[Array], Array]) -> Mesh:
    """Bars of blue lamps across the roof, ahead and behind."""
    out = []
    for x in (span[0] - 0.28, span[1] + 0.25):
        half, high = half_width - 0.12, top + ROOF_LOAD_HEIGHTS_M["beacons"]
        low = float(edge(np.array([x])).item())
        out.append(box((x - 0.1, 0.0, low), (x + 0.1, half - 0.05, top + 0.03), "trim"))
        for y, stop, material in ((0.0, 0.22, "#d8d8d8"), (0.22, half, "#1b52d8")):
            out.append(box((x - 0.14, y, top + 0.02), (x + 0.14, stop, high), material))
    return merged(out)


def _ladder(span: tuple[float, float], low: float) -> list[Mesh]:
    start, end = span
    rungs = np.arange(start + 0.2, end - 0.1, 0.28).tolist()
    sides = [box((start, y, low), (end, y + 0.045, low + 0.07), "chrome") for y in (0.1, 0.42)]
    return sides + [box((x, 0.14, low + 0.02), (x + 0.035, 0.43, low + 0.05), "chrome") for x in rungs]


def antenna(kind: str, x: float, top: float, fin: str) -> Mesh:
    """The left half of an antenna on the middle of a roof, `top` high at `x`, metres; a fin is of material `fin`."""
    if kind == "rod":
        return box((x - 0.006, 0.0, top - 0.02), (x + 0.006, 0.006, top + 0.28), "trim")
    sections = ((1.0, 0.05), (0.5, 0.4), (-0.6, 1.0), (-0.9, 0.95), (-1.0, 0.05))
    return _shell((x, 0.0, top - 0.03), (0.1, 0.024, 0.075), sections, fin)


def _shell(
    at: tuple[float, float, float], size: tuple[float, float, float], sections: ArrayLike, material: str
) -> Mesh:
    """The left half of a closed shell whose middle below is at `at`: half its length and width, and its height."""
    along, share = np.asarray(sections, dtype=np.float64).T[:, :, None]
    across, up = np.array(_BOX_RING).T[:, None]
    points = np.stack(np.broadcast_arrays(along, share * across, share * up), axis=-1) * size + at
    return grid(points[::-1], [[material] * (len(_BOX_RING) - 1)] * (points.shape[0] - 1))
