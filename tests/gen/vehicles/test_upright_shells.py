import numpy as np
import pytest

from skope.gen.mesh import cross
from skope.gen.vehicles.lofted_surfaces import Plan
from skope.gen.vehicles.solids import Tower


@pytest.mark.parametrize("rounded", [0.0, 0.2])
def test_a_roof_with_a_ridge_lies_flat_at_its_ends_and_as_high_as_it_should(rounded: float) -> None:
    plan = Plan(1.2, 2.0, -2.0, rounded, 0.0, 0.05, 0.05)
    shell, _, _ = Tower(plan, 0.0, 2.5, edge=0.05, crown=0.06, ridge=0.5, stations=7).surface("paint")
    mesh = shell.half
    corners = mesh.vertices[mesh.triangles]
    roof = corners[corners[:, :, 2].min(axis=1) > 2.5 - 0.06 - 1e-9]
    normal = cross(roof[:, 1] - roof[:, 0], roof[:, 2] - roof[:, 0])
    area = np.linalg.norm(normal, axis=1)
    assert area.sum() > 0.8 * 1.2 * 4.0 * 2 / 2
    # Nothing stands upright, as a fold would.
    assert (normal[area > 1e-6, 2] / area[area > 1e-6]).min() > 0.9
    assert mesh.vertices[:, 2].max() == pytest.approx(2.5)
    ends = mesh.vertices[np.abs(np.abs(mesh.vertices[:, 0]) - 1.95) < 1e-6]
    assert ends[:, 2].max() == pytest.approx(2.5 - 0.06)
