"""Solids of heavy bodies: volumes say that they are closed and face outward, halves with their mirror image."""

import numpy as np
import pytest

from skope.gen.mesh import Mesh, box, cross, merged
from skope.gen.vehicles.solids import barrel, beam, ladder, mudguard, pipe, prism
from skope.gen.vehicles.triangle_cuts import clipped, rear_wall


def volume(mesh: Mesh) -> float:
    """What a closed surface holds, by the divergence theorem; less than nothing where it faces inward."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return float((a * cross(b, c)).sum() / 6)


def both(half: Mesh) -> Mesh:
    return merged([half, half.mirrored()])


OUTLINE = [(0.0, 0.5), (2.0, 0.5), (1.5, 1.5), (0.0, 1.5)]
"""1.75 square metres."""


@pytest.mark.parametrize("outline", [OUTLINE, OUTLINE[::-1]])
def test_prisms_hold_their_outline_times_their_width(outline: list[tuple[float, float]]) -> None:
    assert volume(prism(outline, 0.8, "trim", inner=0.3)) == pytest.approx(1.75 * 0.5)
    assert volume(both(prism(outline, 0.8, "trim"))) == pytest.approx(1.75 * 1.6)


def test_a_barrel_is_a_cylinder_with_flat_or_pointed_ends() -> None:
    flat = [(0.0, 2.0, 0.0, 0.0), (0.0, 2.0, 0.9, 0.5), (3.0, 2.0, 0.9, 0.5), (3.0, 2.0, 0.0, 0.0)]
    # Its section is a polygon of 24 corners on the ellipse.
    polygon = 12 * np.sin(np.pi / 12) * 0.9 * 0.5
    assert volume(both(barrel(flat, "paint", sharp=True))) == pytest.approx(3 * polygon)
    assert volume(both(barrel(flat, "paint"))) == pytest.approx(3 * polygon)
    cone = [(0.0, 2.0, 0.0, 0.0), (3.0, 2.0, 0.9, 0.5), (3.0, 2.0, 0.0, 0.0)]
    assert volume(both(barrel(cone, ["paint", "trim"], sharp=True))) == pytest.approx(polygon)


def test_a_square_barrel_comes_near_to_a_box() -> None:
    ends = [(0.0, 2.0, 0.0, 0.0), (0.0, 2.0, 0.9, 0.5), (1.0, 2.0, 0.9, 0.5), (1.0, 2.0, 0.0, 0.0)]
    round_one, square_one = (volume(both(barrel(ends, "paint", square=power))) for power in (2.0, 8.0))
    assert round_one < 0.8 * 1.8 < square_one < 1.8


@pytest.mark.parametrize("end", [(1.0, 0.5, 0.0), (0.1, 0.9, 0.7), (0.0, 0.5, -1.0), (-1.0, 0.4, 0.2)])
def test_pipes_hold_their_section_times_their_length(end: tuple[float, float, float]) -> None:
    start = np.array([0.0, 0.5, 0.0])
    polygon = 4 * np.sin(np.pi / 4) * 0.1**2
    expected = polygon * np.linalg.norm(np.array(end) - start)
    assert volume(pipe(start, end, 0.1, "chrome")) == pytest.approx(expected, rel=1e-3)


def test_beams_mudguards_and_ladders_face_outward() -> None:
    assert volume(beam((0, 1.0, 0), (3, 1.0, 4), 0.1, 0.2, "rail")) == pytest.approx(5 * 0.2 * 0.4)
    assert volume(both(beam((0, 0, 0), (3, 0, 4), 0.1, 0.2, "rail"))) == pytest.approx(5 * 0.2 * 0.4)
    sector = np.radians(78) * (0.53**2 - 0.5**2)
    assert volume(mudguard((1.0, 0.5), 0.5, (0.8, 1.2), "trim")) == pytest.approx(0.4 * sector, rel=0.02)
    assert volume(ladder(0.0, (0.2, 0.5), 0.0, 2.0, "rail")) > 0.005


def test_what_is_clipped_and_walled_is_closed() -> None:
    """Of a slanted half body, what lies ahead of a plane holds what it holds there."""
    half = prism(OUTLINE, 0.8, "paint")
    for x in (0.4, 1.7):
        front = clipped(half, x)
        assert front.vertices[np.unique(front.triangles), 0].min() == pytest.approx(x)
        closed = both(merged([front, rear_wall(front, x, "paint")]))
        # The outline's slant begins at 1.5, where it is a metre high.
        area = 1.75 - x if x < 1.5 else (2 - x) ** 2
        assert volume(closed) == pytest.approx(1.6 * area, rel=0.01)


def test_nothing_is_left_of_what_lies_behind_and_all_of_what_lies_ahead() -> None:
    block = box((0, 0, 0), (1, 1, 1), "trim")
    assert len(clipped(block, 1.5).triangles) == 0
    assert volume(clipped(block, -0.5)) == pytest.approx(1.0)
