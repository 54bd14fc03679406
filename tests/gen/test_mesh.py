"""Simplified meshes look like what they were made from; rows and cross products as numpy has them."""

import numpy as np
import pytest

from skope.gen.mesh import Mesh, box, cross, grid, merged, numbered_rows, simplified
from skope.gen.vehicles.fleet import fleet
from tests.gen.rays import cast


def _areas(mesh: Mesh) -> dict[str, float]:
    corners = mesh.vertices[mesh.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    return {name: float(area[mesh.material == i].sum()) for i, name in enumerate(mesh.materials)}


def test_a_plane_needs_few_triangles_and_keeps_its_materials_and_its_rim() -> None:
    at = np.linspace(0, 1, 21)
    points = np.stack([*np.meshgrid(at, at), np.zeros((21, 21))], axis=-1)
    cells = [["glass" if 5 <= i < 10 and 5 <= j < 10 else "paint" for i in range(20)] for j in range(20)]
    plane = grid(points, cells)
    small = simplified(plane, 0.1)
    assert len(small.triangles) < 0.15 * len(plane.triangles)
    assert _areas(small) == pytest.approx(_areas(plane), abs=1e-6)
    assert small.vertices.min() == pytest.approx(0)
    assert small.vertices.max() == pytest.approx(1)


def test_separate_boxes_stay_closed() -> None:
    boxes = merged([box((x, 0, 0), (x + 0.5, 1, 1), "trim") for x in range(20)])
    small = simplified(boxes, 0.25)
    corners = small.vertices[small.triangles]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert volume == pytest.approx(20 * 0.5, rel=1e-6)


@pytest.mark.parametrize("model", ["sedan", "pickup", "bus", "truck_box"])
def test_a_simplified_vehicle_hides_what_the_vehicle_hides(model: str) -> None:
    fine = fleet()[model].vehicle.mesh
    coarse = simplified(fine, 0.25)
    assert len(coarse.triangles) < 0.5 * len(fine.triangles)
    rng = np.random.default_rng(1)
    around = rng.uniform(-np.pi, np.pi, 400)
    eyes = 30 * np.stack([np.cos(around), np.sin(around), np.full(400, 0.3)], axis=-1)
    aims = fine.vertices[fine.triangles[rng.choice(len(fine.triangles), 400)]].mean(axis=1)
    rays = (aims - eyes) / np.linalg.norm(aims - eyes, axis=1, keepdims=True)
    hits = [cast(eyes, rays, mesh.vertices[mesh.triangles])[0] for mesh in (fine, coarse)]
    assert np.isfinite(hits[0]).mean() > 0.95
    assert np.isclose(*hits, rtol=0, atol=0.05).mean() > 0.95
    assert (np.isfinite(hits[0]) == np.isfinite(hits[1])).mean() > 0.98


def test_rows_have_the_numbers_that_numpy_gives_them() -> None:
    rng = np.random.default_rng(7)
    # Rows of many columns and wide ranges do not fit into one 64-bit key.
    wide = rng.normal(0, 9, (50, 8))[rng.integers(50, size=900)]
    for rows, decimals in ((rng.integers(-3, 3, (500, 2)), 0), (rng.normal(0, 0.02, (800, 3)), 2), (wide, 9)):
        unique, first, number = np.unique(np.round(rows, decimals), axis=0, return_index=True, return_inverse=True)
        assert 1 < len(unique) < len(rows)
        own, own_first = numbered_rows(rows, decimals)
        np.testing.assert_array_equal(own, number.reshape(-1))
        np.testing.assert_array_equal(own_first, first)
    assert numbered_rows(np.zeros((0, 3)), 4)[0].shape == (0,)


def test_cross_products() -> None:
    a, b = np.random.default_rng(8).normal(size=(2, 50, 3))
    np.testing.assert_array_equal(cross(a, b), np.cross(a, b))
