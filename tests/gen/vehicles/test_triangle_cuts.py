import numpy as np
import pytest

from skope.gen.vehicles.triangle_cuts import ConvexPolygon, cut

SQUARE = ConvexPolygon.of([(0.3, 0.25), (0.75, 0.25), (0.75, 0.7), (0.3, 0.7)])


def sheet(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 8) of the unit square and its triangles, two a cell."""
    side = np.linspace(0, 1, cells + 1)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    vertices = np.zeros((len(x), 8))
    vertices[:, 0], vertices[:, 1], vertices[:, 5] = x, y, 1.0
    a = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    b, c, d = a + 1, a + cells + 2, a + cells + 1
    return vertices, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


def areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    a, b, c = vertices[triangles][..., :2].swapaxes(0, 1)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    return np.asarray((ux * vy - uy * vx) / 2)


@pytest.mark.parametrize("keep_outside", [True, False])
def test_what_lies_inside_fills_the_polygon(keep_outside: bool) -> None:
    vertices, triangles = sheet(7)
    made = cut(vertices, triangles, np.ones(len(triangles), dtype=bool), SQUARE, (0, 1), keep_outside=keep_outside)
    area = areas(made.vertices, made.triangles)
    assert (area > -1e-12).all()  # none is turned over
    assert area[made.inside].sum() == pytest.approx(0.45 * 0.45)
    middles = made.vertices[made.triangles[made.inside]][..., :2].mean(axis=1)
    assert ((middles > [0.3, 0.25]) & (middles < [0.75, 0.7])).all()
    # Each part is as large as its share of the triangle that it comes from.
    whole = np.bincount(made.parent, area, minlength=len(triangles))
    if keep_outside:
        np.testing.assert_allclose(whole, areas(vertices, triangles))
    np.testing.assert_allclose(np.linalg.norm(made.vertices[:, 3:6], axis=1), 1)


def test_leaving_out_what_is_outside_leaves_what_is_inside_as_it_is() -> None:
    vertices, triangles = sheet(9)
    every = np.ones(len(triangles), dtype=bool)
    kept, left = (
        cut(vertices, triangles, every.copy(), SQUARE, (0, 1), keep_outside=keep_outside)
        for keep_outside in (True, False)
    )
    inside = kept.vertices[kept.triangles[kept.inside]]
    np.testing.assert_array_equal(inside, left.vertices[left.triangles[left.inside]])


def test_a_polygon_may_run_either_way() -> None:
    turned = ConvexPolygon.of([(0.3, 0.7), (0.75, 0.7), (0.75, 0.25), (0.3, 0.25)])
    middle = np.array([0.5, 0.5])
    for polygon in (SQUARE, turned):
        assert (((middle - polygon.starts) * polygon.normals).sum(axis=1) > 0).all()
