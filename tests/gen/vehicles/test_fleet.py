import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from skope import keypoints
from skope.errors import UserError
from skope.gen.labels.world_keypoints import transform, trilaterate
from skope.gen.mesh import Mesh, merged
from skope.gen.render.materials import MATERIAL_COLORS
from skope.gen.vehicles.fleet import build_vehicle, class_ranges, fleet, jittered, parametric
from skope.gen.vehicles.model import Sidecar, Vehicle, straight_lwh, straight_mesh
from skope.schema import VEHICLE_TYPES
from tests.gen.rays import distance_to_triangles
from tests.gen.thirds import a_third

MODELS = sorted(fleet())
OPEN = ("tipper", "flatbed", "hook", "platform", "crane", "recovery", "dropside")
"""Cargo bodies without a roof."""
RAYS = 25
"""Parallel rays in each direction."""


def assert_on_the_surface(vehicle: Vehicle) -> None:
    """All keypoints but the wheels' centres lie within 1 cm of a triangle."""
    mesh = straight_mesh(vehicle)
    corners = mesh.vertices[mesh.triangles]
    low, high = corners.min(axis=1) - 0.01, corners.max(axis=1) + 0.01
    for k in set(range(keypoints.K)) - set(keypoints.WHEELS):
        point = vehicle.points[k]
        near = corners[((low <= point) & (point <= high)).all(axis=1)]
        assert len(near), keypoints.NAMES[k]
        assert distance_to_triangles(point, near) < 0.01, keypoints.NAMES[k]


@pytest.mark.parametrize("model", MODELS)
def test_keypoints_lie_on_the_surface(model: str) -> None:
    assert_on_the_surface(fleet()[model].vehicle)


@pytest.mark.parametrize("model", MODELS)
def test_corners_of_bumpers_lie_farthest_out(model: str) -> None:
    vehicle = fleet()[model].vehicle
    surface = straight_mesh(vehicle).vertices
    for name in ("bumper_front_left", "bumper_rear_left", "bumper_front_right", "bumper_rear_right"):
        marker = vehicle.points[keypoints.INDEX[name]]
        outwards = np.sign(marker[:2]) / np.sqrt(2)
        beyond = (surface[:, :2] - marker[:2]) @ outwards
        near, under = np.abs(surface[:, 2] - marker[2]) < 0.15, surface[:, 2] < marker[2] - 0.03
        assert beyond[near].max() < 0.01, name
        # It is the lower edge: below it the bumper stands back, or there is nothing.
        assert beyond[under].max(initial=-1.0) < 0, name


@pytest.mark.parametrize("model", [name for name in MODELS if parametric(name).style.family in ("car", "step_van")])
@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(25, 25), (155, 15)])
def test_rear_corners_of_roofs_are_visible_from_both_ends(model: str, azimuth_deg: float, elevation_deg: float) -> None:
    """People mark them from the front too, where the roof hides what lies below its edge on the rear face."""
    vehicle = parametric(model)
    marker = vehicle.points[keypoints.INDEX["roof_rear_left"]]
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    to_camera = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    reach, _ = first_hits(straight_mesh(vehicle), -to_camera, marker[None])
    assert marker @ -to_camera - reach.item() < 0.05


@pytest.mark.parametrize("model", MODELS)
def test_keypoints_are_mirror_images(model: str) -> None:
    points = fleet()[model].vehicle.points
    np.testing.assert_allclose(points[list(keypoints.FLIP)], points * [1, -1, 1], atol=1e-12)
    right = [i for i, name in enumerate(keypoints.NAMES) if name.endswith("_right")]
    assert (points[right, 1] < -0.2).all()
    assert points[keypoints.INDEX["front_logo"], 1] == 0


@pytest.mark.parametrize("model", ["bus", "bus_midi"])
def test_roof_points_of_buses_are_the_windows_upper_corners(model: str) -> None:
    vehicle = fleet()[model].vehicle
    below = {
        name: vehicle.size_lwh[2] - vehicle.points[i, 2] for name, i in keypoints.INDEX.items() if name[:4] == "roof"
    }
    assert below == {name: pytest.approx(0.3 if name.startswith("roof_front") else 0.5, abs=0.01) for name in below}


@pytest.mark.parametrize("model", MODELS)
def test_keypoints_are_where_their_names_say(model: str) -> None:
    vehicle = fleet()[model].vehicle
    p = {name: vehicle.points[i] for name, i in keypoints.INDEX.items()}
    length, width, height = straight_lwh(vehicle)
    front, style = vehicle.shape.length / 2, parametric(model).style
    # A long nose has its bumper before it.
    assert p["front_logo"][0] == pytest.approx(front, abs=0.16 if vehicle.shape.hood_length else 0.08)
    assert p["bumper_rear_left"][0] == pytest.approx(front - length, abs=0.25)
    roof = p["roof_rear_left"] if style.family in ("truck", "chassis") else p["roof_front_left"]
    under = 0.65 if fleet()[model].further else 0.35
    assert roof[2] == pytest.approx(height, abs=under) or style.body in OPEN
    assert p["roof_front_left"][0] < p["windscreen_base_left"][0] < p["hood_front_left"][0]
    assert p["roof_rear_left"][0] >= p["rear_window_base_left"][0] - 0.01
    assert p["rear_window_base_left"][0] >= p["trunk_rear_left"][0] - 0.08
    assert p["headlight_inner_left"][1] < p["headlight_outer_left"][1] <= width / 2
    assert p["taillight_inner_left"][1] < p["taillight_outer_left"][1] <= width / 2
    assert p["bumper_front_left"][2] < p["headlight_outer_left"][2] < p["hood_front_left"][2]
    assert p["windscreen_base_left"][2] < p["roof_front_left"][2]
    assert p["rear_window_base_left"][2] < p["roof_rear_left"][2]
    assert p["mirror_left"][1] > width / 2
    assert p["wheel_front_left"][2] == vehicle.shape.wheel_radius


@pytest.mark.parametrize("model", MODELS)
def test_meshes_are_as_large_as_their_dimensions(model: str) -> None:
    vehicle = fleet()[model].vehicle
    length, width, height = straight_lwh(vehicle)
    body = straight_mesh(vehicle).vertices
    assert np.ptp(body[:, 0]) == pytest.approx(length, abs=0.015)
    assert np.ptp(body[:, 1]) == pytest.approx(width + 0.3, abs=0.17)  # with mirrors
    assert body[:, 2].max() == pytest.approx(height, abs=0.02)
    assert np.abs(vehicle.wheel.vertices[:, [0, 2]]).max() == pytest.approx(vehicle.shape.wheel_radius, abs=0.005)


def first_hits(mesh: Mesh, direction: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far along a direction the parallel rays through points (R, 3) first meet a mesh, and whether its front.

    inf and True where they meet nothing. Seen along the direction, a triangle holds a point that lies on the same side
    of its three edges, and shows its front where it runs clockwise.
    """
    u = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    u /= np.linalg.norm(u)
    axes = np.stack([u, np.cross(direction, u)], axis=-1)
    corners = mesh.vertices[mesh.triangles]
    a, b, c = np.moveaxis(corners @ axes, 1, 0)
    area = cross(b - a, c - a)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    depth = corners @ direction
    reach, front = np.full(len(points), np.inf), np.ones(len(points), dtype=bool)
    for i, q in enumerate(points @ axes):
        near = np.flatnonzero(((low <= q) & (q <= high)).all(axis=1) & (np.abs(area) > 1e-12))
        pa, pb, pc = a[near] - q, b[near] - q, c[near] - q
        shares = np.stack([cross(pb, pc), cross(pc, pa), cross(pa, pb)], axis=-1) / area[near, None]
        held = (shares >= 0).all(axis=1)
        if held.any():
            at = (shares[held] * depth[near[held]]).sum(axis=1)
            reach[i], front[i] = at.min(), area[near[held]][at.argmin()] < 0
    return reach, front


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def whole(vehicle: Vehicle) -> Mesh:
    """Body and wheels."""
    sides = (vehicle.wheel.mirrored(), vehicle.wheel) * 2
    wheels = [mesh.moved(at) for mesh, at in zip(sides, vehicle.shape.wheel_centers(), strict=True)]
    if vehicle.trailer:
        hindmost = zip(sides[2:], vehicle.trailer.at_rest[1:, :3, 3], strict=True)
        wheels += [mesh.moved(at) for mesh, at in hindmost]
    return merged([straight_mesh(vehicle), *wheels])


def backs_seen(vehicle: Vehicle, rng: np.random.Generator, directions: int) -> int:
    """Of rays from all around, from above, to places in a vehicle's box, those that meet a triangle's back first."""
    size, mesh, back, hit = np.array(straight_lwh(vehicle)), whole(vehicle), 0, 0
    middle = [(vehicle.shape.length - size[0]) / 2, 0, size[2] / 2]
    for _ in range(directions):
        direction = rng.normal(size=3) * [1, 1, 0.7]
        direction[2] = -abs(direction[2])
        points = rng.uniform(-0.5, 0.5, (RAYS, 3)) * size + middle
        reach, front = first_hits(mesh, direction / np.linalg.norm(direction), points)
        back += int((~front).sum())
        hit += int(np.isfinite(reach).sum())
    assert hit > 0.7 * directions * RAYS
    return back


@pytest.mark.parametrize("model", a_third(MODELS))
def test_surfaces_face_outward(model: str) -> None:
    """Rays from all around meet the front of the first triangle that they hit."""
    assert backs_seen(fleet()[model].vehicle, np.random.default_rng(1), 16) == 0


@pytest.mark.parametrize("model", a_third(MODELS))
def test_interior_lies_inside(model: str) -> None:
    vehicle = fleet()[model].vehicle
    interior = vehicle.interior
    assert 50 < len(interior.triangles) < 600
    corners = interior.vertices[interior.triangles].reshape(-1, 3)
    centers = corners[:: max(1, len(corners) // 150)]
    for direction in np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]):
        reach, _ = first_hits(vehicle.mesh, direction, centers)
        assert (reach < centers @ direction).all()


@pytest.mark.parametrize("model", MODELS)
def test_trilateration_equals_the_rigid_transform(model: str) -> None:
    vehicle = fleet()[model].vehicle
    rng = np.random.default_rng(2)
    poses = np.tile(np.eye(4), (64, 1, 1))
    poses[:, :3, :3] = Rotation.random(64, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(-2000, 2000, (64, 3))
    rigid = transform(poses, np.tile(vehicle.points, (64, 1, 1)))
    wheels = transform(poses, np.tile(vehicle.shape.wheel_centers(), (64, 1, 1)))
    if vehicle.trailer is None:
        np.testing.assert_allclose(rigid[:, list(keypoints.WHEELS)], wheels, atol=1e-9)
    sidecar = vehicle.sidecar
    free = trilaterate(wheels, np.tile(sidecar.distances, (64, 1, 1)), np.tile(sidecar.side, (64, 1)))
    assert np.abs(free - rigid).max() < 1e-3


def test_trilateration_of_points_above_in_and_below_the_wheel_plane() -> None:
    wheels = np.array([[1.4, -0.8, 0.3], [1.4, 0.8, 0.3], [-1.4, -0.8, 0.3], [-1.4, 0.8, 0.3]])
    points = np.zeros((keypoints.K, 3))
    points[list(keypoints.WHEELS)] = wheels
    points[0], points[1], points[2] = [0.5, 0.2, 1.3], [0.1, -0.4, 0.3], [2.0, 0.9, 0.1]
    sidecar = Sidecar.of(points)
    assert sidecar.side[[0, 1, 2]].tolist() == [1, 0, -1]
    assert sidecar.distances[0, 0] == pytest.approx(np.sqrt(0.9**2 + 1.0**2 + 1.0**2))
    turned = Rotation.from_euler("zyx", [2.0, 0.1, 3.1]).as_matrix()  # nearly upside down
    found = trilaterate((wheels @ turned.T)[None], sidecar.distances[None], sidecar.side[None])[0]
    np.testing.assert_allclose(found[:3], points[:3] @ turned.T, atol=1e-6)


def test_sidecar_survives_json() -> None:
    sidecar = fleet()["sedan"].vehicle.sidecar
    again = Sidecar.from_dict(sidecar.to_dict())
    np.testing.assert_array_equal(again.distances, sidecar.distances)
    np.testing.assert_array_equal(again.side, sidecar.side)


def test_the_fleet_covers_the_body_types() -> None:
    entries = fleet(further=False).values()
    assert {entry.vehicle.vehicle_type for entry in fleet().values()} == set(VEHICLE_TYPES) - {"other"}
    assert len(entries) >= 24
    held_out = [entry.vehicle.vehicle_type for entry in entries if entry.held_out]
    assert len(held_out) == len(set(held_out)) >= 4


def test_further_models_are_many_heavy_ones_of_which_some_are_held_out() -> None:
    further = {name: entry for name, entry in fleet().items() if entry.further}
    assert fleet().keys() == fleet(further=False).keys() | further.keys()
    assert not fleet(further=False).keys() & further.keys()
    heavy = [name for name, entry in further.items() if entry.vehicle.vehicle_type in ("truck", "box_truck", "bus")]
    assert len(heavy) >= 13
    held_out = {name for name, entry in further.items() if entry.held_out}
    assert {"truck_tanker", "coach_three_axle", "truck_refuse_small", "motorhome"} <= held_out
    assert len(held_out) < len(further) / 4


@pytest.mark.parametrize("model", MODELS)
def test_wheels_of_all_axles_stand_on_the_ground(model: str) -> None:
    """Tyres touch the road under each axle, middle ones too, and nothing lies lower."""
    vehicle = parametric(model)
    shape, style, mesh = vehicle.shape, vehicle.style, whole(vehicle)
    tyres = mesh.vertices[np.unique(mesh.triangles[mesh.material == mesh.materials.index("tyre")])]
    axles = [shape.front_axle_x, shape.rear_axle_x]
    axles += [shape.rear_axle_x + ahead for ahead in style.axles] + [
        shape.front_axle_x - back for back in style.steered
    ]
    assert mesh.vertices[:, 2].min() > -0.01
    for x in axles:
        near = tyres[np.abs(tyres[:, 0] - x) < 0.05]
        assert near[:, 2].min() == pytest.approx(0, abs=0.01)
        assert np.abs(near[:, 1]).max() == pytest.approx(shape.track / 2 + shape.wheel_width / 2, abs=0.01)


@pytest.mark.parametrize(
    "model", [name for name in MODELS if fleet()[name].further and fleet()[name].vehicle.vehicle_type == "bus"]
)
def test_roof_points_of_further_buses_are_the_highest_corners_of_glass(model: str) -> None:
    vehicle = fleet()[model].vehicle
    mesh = vehicle.mesh
    panes = np.isin(mesh.material, [k for k, name in enumerate(mesh.materials) if name in ("glass", "glass_tinted")])
    glass = mesh.vertices[np.unique(mesh.triangles[panes])]
    for end in ("front", "rear"):
        point = vehicle.points[keypoints.INDEX[f"roof_{end}_left"]]
        near = glass[np.abs(glass[:, 0] - point[0]) < 0.4]
        assert -0.06 < point[2] - near[:, 2].max() < 0.36


@pytest.mark.parametrize("model", MODELS)
def test_models_measure_what_their_class_does(model: str) -> None:
    vehicle = fleet()[model].vehicle
    shape = vehicle.shape.to_dict()
    for name, (low, high) in class_ranges(vehicle.size_class).items():
        assert low <= shape[name] <= high, name


@pytest.mark.parametrize("model", MODELS)
def test_lamps_are_parts_of_their_own(model: str) -> None:
    mesh = straight_mesh(fleet()[model].vehicle)
    used = {mesh.materials[i] for i in np.unique(mesh.material)}
    lamps = {"headlight", "taillight", "brake_light", "reverse_light", "indicator_left", "indicator_right"}
    assert lamps <= {name for name in used if not name.startswith("#")} <= {*MATERIAL_COLORS, "paint"}
    for name, side in (("indicator_left", 1), ("indicator_right", -1)):
        at = mesh.vertices[mesh.triangles[mesh.material == mesh.materials.index(name)]].mean(axis=1)
        assert (at[:, 1] * side > 0).all()
        assert (at[:, 0] > 0).any()
        assert (at[:, 0] < 0).any()


@pytest.mark.parametrize("model", a_third(MODELS))
def test_jittered_shapes_keep_their_keypoints(model: str) -> None:
    rng = np.random.default_rng(5)
    shape = jittered(model, rng)
    assert shape == build_vehicle(model, shape).shape.to_dict()
    assert shape != fleet()[model].vehicle.shape.to_dict()
    vehicle = build_vehicle(model, shape)
    for name, (low, high) in class_ranges(vehicle.size_class).items():
        assert low - 1e-9 <= shape[name] <= high + 1e-9, name
    points = vehicle.points
    np.testing.assert_allclose(points[list(keypoints.FLIP)], points * [1, -1, 1], atol=1e-12)
    assert_on_the_surface(vehicle)
    assert backs_seen(vehicle, rng, 6) == 0


def test_unknown_models_and_shapes_are_named() -> None:
    with pytest.raises(UserError, match="hovercraft"):
        build_vehicle("hovercraft", {})
    with pytest.raises(UserError, match="sedan"):
        build_vehicle("sedan", {"wings": 2.0})
