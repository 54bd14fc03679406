"""Marker lamps, lit windows and roof signs: where they are; they move no keypoint, and the low beam lights them."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from skope.camera.model import Camera
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.lit_lamps import lit_lamps
from skope.gen.scene.recording import LAMP_BITS
from skope.gen.towns.town import Town
from skope.gen.vehicles import bus, closed_bodies, coaches, lorry_parts, truck
from skope.gen.vehicles.fleet import BODY_KINDS, fleet, parametric
from skope.gen.vehicles.model import straight_mesh
from skope.gen.vehicles.panels import FRONT_MARKER, MARKER_MATERIAL, REAR_MARKER
from skope.gen.vehicles.trailer_body import TrailerBody
from tests.gen.scenes import conditions, standing

MARKED = ("truck_long", "box_truck", "articulated_curtain", "bus", "bus_low_floor", "bus_double_deck", "coach")


def places_of(model: str, material: str) -> np.ndarray:
    """(N, 3) middles of a vehicle's triangles of a material."""
    mesh = straight_mesh(fleet()[model].vehicle)
    chosen = mesh.triangles[mesh.material == mesh.materials.index(material)]
    return np.asarray(mesh.vertices[chosen].mean(axis=1))


@pytest.mark.parametrize("model", MARKED)
def test_wide_vehicles_have_lamps_at_their_upper_corners(model: str) -> None:
    vehicle = fleet()[model].vehicle
    tall, ahead = vehicle.shape.height, vehicle.shape.length / 2
    white, red = places_of(model, FRONT_MARKER), places_of(model, REAR_MARKER)
    rear = straight_mesh(vehicle).vertices[:, 0].min()
    assert white[:, 2].min() > 0.6 * tall
    assert red[:, 2].min() > 0.8 * tall
    assert white[:, 0].max() > ahead - 1.0
    assert red[:, 0].max() < rear + 0.4
    for lamps in (white, red):
        assert (lamps[:, 1] > 0.6).any()
        assert (lamps[:, 1] < -0.6).any()


@pytest.mark.parametrize("model", ["truck_long", "articulated_curtain", "bus_low_floor", "coach"])
def test_amber_lamps_lie_along_the_sides(model: str) -> None:
    amber = places_of(model, MARKER_MATERIAL)
    assert np.ptp(amber[:, 0]) > 4.0
    assert np.abs(amber[:, 1]).min() > 0.9 * fleet()[model].vehicle.shape.width / 2


def test_cars_have_none() -> None:
    assert not {FRONT_MARKER, REAR_MARKER, MARKER_MATERIAL} & set(fleet()["sedan"].vehicle.mesh.materials)


def left_points(model: str) -> dict[str, np.ndarray]:
    """The left keypoints of a body that is built anew, without the cache, and of its trailer."""
    vehicle = parametric(model)
    body: Any = BODY_KINDS[vehicle.style.family](vehicle.shape, vehicle.style)
    _ = body.mesh
    trailer = TrailerBody(vehicle.shape, vehicle.style).points if vehicle.style.trailer else {}
    return {**body.points, **trailer}


@pytest.mark.parametrize("model", ["truck_long", "box_truck", "articulated_curtain", "bus", "bus_low_floor"])
def test_lamps_move_no_keypoint(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = left_points(model)
    nothing: Callable[..., None] = lambda *_: None  # noqa: E731
    for module in (closed_bodies, bus, coaches, lorry_parts, truck):
        monkeypatch.setattr(module, "draw_upper_markers", nothing)
    monkeypatch.setattr(bus.BusBody, "lit_inside", False)
    bare = left_points(model)
    assert drawn.keys() == bare.keys()
    for stem, point in bare.items():
        np.testing.assert_array_equal(point, drawn[stem])


def at_night(model: str, lamps: int) -> np.ndarray:
    """(H, W) brightest channel of a vehicle seen from its left side, in the dark."""
    camera = Camera.looking([0, 14, 5.0], yaw=-np.pi / 2, pitch_down=0.25, size=(320, 180), fov=np.radians(60))
    recording = standing(camera, [(model, 0.0, 0.0, 0.0)])
    night = {"sun_elevation_deg": -30.0, "street_lighting": 0.5, "shutter_s": 0.04, "gain_db": 30.0}
    dark = conditions(**night, noise=0.0, exposure_ev=0.0)
    recording = replace(
        recording, town=Town("studio"), conditions=dark, lamps=np.array([lamps], dtype=np.uint8), signals=({},)
    )
    view = make_renderer("gl", recording).render(0)
    return np.asarray(np.where(view.ids == 1, view.rgb.max(axis=-1).astype(int), 0))


def test_a_bus_is_lit_inside_with_its_low_beam_only() -> None:
    dark, lit = (at_night("bus", lamps) for lamps in (0, LAMP_BITS["low_beam"]))
    assert (lit > dark + 40).sum() > 400
    braking = at_night("bus", LAMP_BITS["brake"])
    assert (braking > dark + 40).sum() < 100


def test_a_roof_sign_is_the_brightest_part_of_a_taxi() -> None:
    dark, lit = (at_night("taxi", lamps) for lamps in (0, LAMP_BITS["low_beam"]))
    rows = np.flatnonzero((dark > 0).any(axis=1))
    roof = slice(rows[0], rows[0] + max(3, len(rows) // 6))
    assert lit[roof].max() > dark[roof].max() + 60


def test_upper_lamps_glare_when_they_are_lit() -> None:
    camera = Camera.looking([0, 14, 5.0], yaw=-np.pi / 2, pitch_down=0.25, size=(320, 180))
    recording = replace(standing(camera, [("bus", 0.0, 0.0, 0.0)]), lamps=np.array([1], dtype=np.uint8))
    tall = fleet()["bus"].vehicle.shape.height
    upper = [lamp for lamp in lit_lamps(recording.moment(0)) if lamp.center[2] > 0.8 * tall]
    assert {np.sign(lamp.facing[0]) for lamp in upper} == {-1.0, 1.0}
    assert all(lamp.intensity > 0 for lamp in upper)
