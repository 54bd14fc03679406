"""Details of jittered vehicles: other fronts, rears, tones and loads than their model's."""

from collections import Counter
from dataclasses import fields, replace

import numpy as np
import pytest

from skope import keypoints
from skope.errors import UserError
from skope.gen.render.materials import MATERIAL_COLORS, named_color
from skope.gen.vehicles.cabin import ROOF_LOAD_HEIGHTS_M
from skope.gen.vehicles.fleet import ParametricVehicle, build_vehicle, fleet, jittered, parametric
from skope.gen.vehicles.jittered_parts import ALL_DETAILS, draw_details, styled
from skope.gen.vehicles.shape import DETAIL_NAMES, Shape
from tests.gen.thirds import a_third
from tests.gen.vehicles.test_fleet import assert_on_the_surface, backs_seen, first_hits

CARS = sorted(name for name in fleet() if parametric(name).style.family == "car")
OPTIONS = [(name, number) for name, detail in ALL_DETAILS.items() for number in range(1, len(detail.options))]


def with_details(model: str, **details: float) -> ParametricVehicle:
    vehicle = build_vehicle(model, {**parametric(model).shape.to_dict(), **details})
    assert isinstance(vehicle, ParametricVehicle)
    return vehicle


@pytest.mark.parametrize("model", sorted(fleet()))
def test_models_have_no_details_of_their_own(model: str) -> None:
    vehicle = parametric(model)
    assert not set(vehicle.shape.to_dict()) & DETAIL_NAMES
    assert styled(vehicle.style, vehicle.shape) == vehicle.style


@pytest.mark.parametrize("model", sorted(fleet()))
def test_shapes_without_details_are_the_models(model: str) -> None:
    assert build_vehicle(model, parametric(model).shape.to_dict()) == parametric(model)


def test_details_are_neutral_where_nothing_is_said() -> None:
    assert {f.default for f in fields(Shape) if f.name in DETAIL_NAMES} == {0.0}


def assert_details_keep_the_keypoints(model: str, details: dict[str, float]) -> None:
    """Only lamps move keypoints, and only their own.

    Others move by no more than the 6 mm that a tail lamp is sunk; sides have other surfaces.
    """
    vehicle = with_details(model, **details)
    assert_on_the_surface(vehicle)
    points = vehicle.points
    np.testing.assert_allclose(points[list(keypoints.FLIP)], points * [1, -1, 1], atol=1e-12)
    moved = np.linalg.norm(points - parametric(model).points, axis=1) > (0.035 if "side" in details else 0.007)
    names = {keypoints.NAMES[i] for i in np.flatnonzero(moved)}
    allowed = tuple(name for name in details if name in ("headlight", "taillight"))
    assert all(one.startswith(allowed) for one in names)
    assert backs_seen(vehicle, np.random.default_rng(3), 6) == 0
    used = {vehicle.mesh.materials[i] for i in np.unique(vehicle.mesh.material)}
    assert {"headlight", "taillight", "brake_light", "reverse_light", "indicator_left", "indicator_right"} <= used
    assert all(material in {*MATERIAL_COLORS, "paint"} or named_color(material) for material in used)


@pytest.mark.parametrize("turn", range(max(len(detail.options) for detail in ALL_DETAILS.values()) - 1))
def test_details_keep_the_keypoints_on_the_surface(turn: int) -> None:
    """Each option of each detail once, all details at a time."""
    details = {name: float(1 + turn % (len(detail.options) - 1)) for name, detail in ALL_DETAILS.items()}
    assert_details_keep_the_keypoints(CARS[turn % len(CARS)], details)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "number"), OPTIONS)
def test_each_option_keeps_the_keypoints_on_the_surface(name: str, number: int) -> None:
    assert_details_keep_the_keypoints(CARS[OPTIONS.index((name, number)) % len(CARS)], {name: float(number)})


VANS = [name for name in CARS if parametric(name).vehicle_type == "van"]


@pytest.mark.parametrize("model", VANS)
def test_tail_lamps_of_vans_may_stand_beside_the_rear_window(model: str) -> None:
    numbers = [
        i for i, (_, option) in enumerate(ALL_DETAILS["taillight"].options) if option.get("taillight") == "pillar"
    ]
    vehicle = with_details(model, taillight=float(numbers[0]))
    assert_details_keep_the_keypoints(model, {"taillight": float(numbers[0])})
    outer, inner, base = (
        vehicle.points[keypoints.INDEX[f"{stem}_left"]]
        for stem in ("taillight_outer", "taillight_inner", "rear_window_base")
    )
    assert vehicle.shape.deck_height + 0.1 < outer[2] < vehicle.points[keypoints.INDEX["roof_rear_left"], 2] - 0.15
    assert base[1] < inner[1] < outer[1] - 0.03
    # Outside of the pane at its own height, which leans inwards.
    mesh = vehicle.mesh
    panes = np.isin(mesh.material, [k for k, name in enumerate(mesh.materials) if name in ("glass", "glass_tinted")])
    glass = mesh.vertices[np.unique(mesh.triangles[panes])]
    rear = glass[(glass[:, 0] < outer[0]) & (np.abs(glass[:, 2] - outer[2]) < 0.2)]
    assert 0 < rear[:, 1].max() < inner[1]


def test_tail_lamps_beside_the_rear_window_are_of_vans_alone() -> None:
    rng = np.random.default_rng(4)
    drawn = Counter(
        (vehicle_type, styled(style, Shape(**shape)).taillight == "pillar")
        for model, vehicle_type in (("van", "van"), ("suv", "suv"), ("sedan", "sedan"))
        for style, shape in ((parametric(model).style, dict(jittered(model, rng))) for _ in range(60))
    )
    assert {kind for kind, pillar in drawn if pillar} == {"van"}
    assert 0.25 < drawn["van", True] / 60 < 0.6


def test_each_option_is_drawn() -> None:
    rng = np.random.default_rng(0)
    seen: Counter[tuple[str, float]] = Counter()
    for model in CARS * 60:
        style, kind = parametric(model).style, parametric(model).vehicle_type
        seen.update(draw_details(style, kind, rng).items())
    assert {option for option in OPTIONS if not seen[option]} == set()


@pytest.mark.parametrize("model", a_third(sorted(fleet())))
def test_jittered_vehicles_keep_their_keypoints(model: str) -> None:
    rng = np.random.default_rng(11)
    for _ in range(3):
        vehicle = build_vehicle(model, jittered(model, rng))
        assert_on_the_surface(vehicle)
        assert backs_seen(vehicle, rng, 3) == 0
        p = {name: vehicle.points[i] for name, i in keypoints.INDEX.items()}
        assert p["headlight_inner_left"][1] < p["headlight_outer_left"][1] <= vehicle.shape.width / 2
        assert p["taillight_inner_left"][1] < p["taillight_outer_left"][1] <= vehicle.shape.width / 2
        assert p["bumper_front_left"][2] < p["headlight_outer_left"][2] < p["hood_front_left"][2] + 0.03


def test_dimensions_do_not_depend_on_details() -> None:
    shape = jittered("suv", np.random.default_rng(4))
    again = jittered("suv", np.random.default_rng(4))
    assert shape == again
    rng = np.random.default_rng(4)
    before = rng.bit_generator.state
    jittered("suv", rng)
    after = rng.bit_generator.state
    other = np.random.default_rng(4)
    other.standard_normal(10)
    assert before != after == other.bit_generator.state


@pytest.mark.parametrize(("load", "over"), ROOF_LOAD_HEIGHTS_M.items())
def test_loads_count_for_the_height(load: str, over: float) -> None:
    wagon = parametric("wagon")
    vehicle = replace(wagon, style=replace(wagon.style, load=load))
    assert vehicle.size_lwh[2] == pytest.approx(vehicle.shape.height + over)
    assert vehicle.mesh.vertices[:, 2].max() == pytest.approx(vehicle.size_lwh[2], abs=0.01)


@pytest.mark.parametrize(("name", "value"), [("grille", 99.0), ("grille", 1.5), ("seams", -1.0), ("dirt", 1.2)])
def test_unknown_options_are_named(name: str, value: float) -> None:
    with pytest.raises(UserError, match=f"{name}: expected"):
        with_details("sedan", **{name: value})


@pytest.mark.parametrize("model", a_third(CARS))
def test_front_plates_stand_before_the_front(model: str) -> None:
    """What a ray from ahead meets in the middle of a plate is the plate."""
    for steps in (0, 1, 2):
        mesh = with_details(model, seams=1.0, plate_places=float(steps), grille=16.0).mesh
        corners = mesh.vertices[mesh.triangles]
        ahead = corners[:, :, 0].mean(axis=1) > 0
        plate = corners[ahead & (mesh.material == mesh.materials.index("plate"))].reshape(-1, 3)
        low, high = plate.min(axis=0), plate.max(axis=0)
        inside = np.linspace(low + 0.02, high - 0.02, 7)[:, 2]
        places = np.array([(0.0, y, z) for y in (0.02, 0.1) for z in inside])
        reach, _ = first_hits(mesh, np.array([-1.0, 0.0, 0.0]), places)
        assert (-reach > low[0] - 1e-6).all()
        assert (-reach < high[0] + 1e-6).all(), (model, steps)


@pytest.mark.parametrize("model", ["truck_platform", "truck_two_axle", "truck_long", "bus_double_deck"])
def test_liveries_and_loads_follow_from_the_length(model: str) -> None:
    """Vehicles of different lengths have different ones; one of the same shape is the same."""
    looks = set()
    for seed in range(8):
        shape = jittered(model, np.random.default_rng(seed))
        mesh = build_vehicle(model, shape).mesh
        looks.add(tuple(sorted(mesh.materials)))
    assert len(looks) >= 4
    again = replace(build_vehicle(model, shape)).mesh  # type: ignore[type-var]
    assert mesh.vertices.tobytes() == again.vertices.tobytes()
