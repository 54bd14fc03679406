"""People on foot and on two wheels: how they move, and that they hide vehicles without being labelled."""

import math

import numpy as np
import pytest
from shapely import Point, Polygon

from skope import keypoints
from skope.camera.model import Camera
from skope.gen.bystanders.bystander import BYSTANDER_KINDS, build_bystander
from skope.gen.bystanders.luggage import LUGGAGE_KINDS
from skope.gen.bystanders.people import HIP, Look
from skope.gen.labels.annotate import annotate
from skope.gen.labels.ignore_rules import Rules
from skope.gen.mesh import Mesh
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.scene.recording import LAMP_BITS
from skope.gen.simulation.pedestrians import Riders, Walkers
from skope.gen.simulation.recorder import RECORDING_REACH, flashed
from skope.gen.traffic.sumo import SUMO_STEPS, SumoRider
from tests.gen.scenes import standing, with_people

PATH = np.array([[0.0, 0.0, 0.1], [30.0, 0.0, 0.1], [30.0, 40.0, 2.1]])


def volume(mesh: Mesh) -> float:
    """Enclosed by surfaces that face outward, cubic metres."""
    a, b, c = mesh.vertices[mesh.triangles].swapaxes(0, 1)
    return float((a * np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize("kind", BYSTANDER_KINDS)
def test_surfaces_face_outward_and_people_have_the_volume_of_people(kind: str) -> None:
    body = build_bystander(kind, Look().to_dict())
    for part in body.parts:
        assert volume(part) > 0 or not len(part.triangles)
    if kind == "pedestrian":
        assert 0.04 < sum(map(volume, body.parts)) < 0.12
    lowest = min(
        float((mesh.vertices @ T[:3, :3].T + T[:3, 3])[:, 2].min())
        for mesh, T in zip(body.parts, [np.eye(4), *body.pose(0.0)], strict=True)
        if len(mesh.vertices)
    )
    assert lowest == pytest.approx(0, abs=0.01)


def test_people_walk_on_the_path_at_their_speed() -> None:
    walkers = Walkers([PATH] * 20, np.random.default_rng(0))
    before, after = walkers.at(10.0), walkers.at(10.5)
    assert len(before) > 15
    stand = 0
    for name, one in before.items():
        x, y, z = one.T_world_body[:3, 3]
        assert min(abs(y), abs(x - 30)) < 2.5
        speed = np.linalg.norm(one.velocity)
        moved = np.linalg.norm(after[name].T_world_body[:2, 3] - one.T_world_body[:2, 3])
        stand += speed == 0
        # At a corner whoever walks outside goes farther.
        if np.linalg.norm(PATH[:, :2] - [x, y], axis=1).min() > 3:
            assert moved == pytest.approx(0.5 * speed, abs=0.01)
        assert -0.1 < z <= 2.1
    assert 0 < stand < len(before) / 2


def test_people_do_not_walk_through_parked_vehicles() -> None:
    """One that stands on a part of the sidewalk: those whose way leads through it keep to the middle."""
    car = Polygon([(10, 0.45), (14, 0.45), (14, 2.0), (10, 2.0)])
    free, careful = (Walkers([PATH] * 20, np.random.default_rng(0), places) for places in ((), (car,)))
    nearest = [
        min(car.distance(Point(one.T_world_body[:2, 3])) for t in range(60) for one in walkers.at(float(t)).values())
        for walkers in (free, careful)
    ]
    assert nearest[0] < 0.1
    assert nearest[1] > 0.25
    assert len(careful.at(0.0)) == len(free.at(0.0))
    across = Polygon([(10, -2), (14, -2), (14, 2), (10, 2)])
    assert not Walkers([PATH] * 20, np.random.default_rng(0), [across]).at(0.0)


def test_the_lower_foot_of_a_walker_touches_the_ground() -> None:
    walkers = Walkers([PATH[:2]] * 5, np.random.default_rng(1))
    for time in np.linspace(0, 2, 9):
        for one in walkers.at(float(time)).values():
            soles = []
            for leg, T in zip(one.body.parts[3:], one.part_poses[2:], strict=True):
                at = leg.vertices[leg.vertices[:, 2] < -(HIP - 0.01) * one.body.look.height]
                soles.append((at @ T[:3, :3].T + T[:3, 3])[:, 2].mean())
            assert min(soles) == pytest.approx(0.1, abs=0.04)


def test_labelled_people_walk_in_groups_and_keep_to_the_sidewalk() -> None:
    straight = PATH[:2]
    counts = [len(Walkers.labelled([straight] * 10, np.random.default_rng(k)).at(0.0)) for k in range(12)]
    assert max(counts) > 4 * max(min(counts), 1)  # few people in one recording, crowds in another
    walkers = Walkers.labelled([straight] * 40, np.random.default_rng(5))
    before, after = walkers.at(3.0), walkers.at(3.5)
    together, facing = 0, 0
    for name, one in before.items():
        assert one.body.jointed
        assert abs(one.T_world_body[1, 3]) <= 0.66
        moved = np.linalg.norm(after[name].T_world_body[:2, 3] - one.T_world_body[:2, 3])
        x = one.T_world_body[0, 3]
        if 3 < x < 27:
            assert moved == pytest.approx(0.5 * np.linalg.norm(one.velocity), abs=0.02)
        for other in before.values():
            apart = other.T_world_body[:3, 3] - one.T_world_body[:3, 3]
            alike = np.allclose(other.velocity, one.velocity) and other is not one
            if alike and 0 < np.linalg.norm(apart) < 1.2:
                together += 1
                facing += not one.velocity.any() and one.T_world_body[:3, 0] @ apart > 0
    assert together > len(before) / 4
    assert facing > 0
    tall = Polygon([(10, -2), (14, -2), (14, 2), (10, 2)])
    assert not Walkers.labelled([straight] * 10, np.random.default_rng(5), [tall]).at(0.0)
    rain = Walkers.labelled([straight] * 40, np.random.default_rng(5), raining=True).at(0.0)
    assert any(LUGGAGE_KINDS[int(one.body.look.load)] == "umbrella" for one in rain.values())


def test_labelled_riders_stand_on_their_left_foot_where_they_wait() -> None:
    riders = Riders({"r": "cyclist"}, lambda _: np.random.default_rng(1), jointed=True)
    for speed, leans in ((5.0, False), (0.0, True)):
        state = SumoRider((0.0, 0.0, 0.0), 0.0, 0.0, speed)
        rider = riders.follow({"r": state}, SUMO_STEPS.default_s)["r"]
        assert (rider.T_world_body[1, 2] > 0.05) == leans  # to the left
        assert rider.part_poses.shape == (7, 4, 4)


def test_riders_lean_into_curves_and_their_wheels_roll() -> None:
    riders, radius, speed = Riders({"r": "motorcyclist"}, lambda _: np.random.default_rng(1)), 20.0, 8.0
    for k in range(80):
        a = k * SUMO_STEPS.default_s * speed / radius
        ridden = SumoRider((radius * math.sin(a), radius * (1 - math.cos(a)), 0.0), a, 0.0, speed)
        rider = riders.follow({"r": ridden}, SUMO_STEPS.default_s)["r"]
    top = rider.T_world_body[:3, 2]
    left = rider.T_world_body[:3, :3] @ [0, 1, 0]
    centre = np.array([0, radius, 0]) - rider.T_world_body[:3, 3]
    assert top @ centre / radius == pytest.approx(math.sin(math.atan(speed**2 / radius / 9.81)), abs=0.03)
    assert left @ centre > 0
    assert rider.travelled == pytest.approx(80 * SUMO_STEPS.default_s * speed)


def test_indicators_flash_and_other_lamps_do_not() -> None:
    lamps = LAMP_BITS["indicator_left"] | LAMP_BITS["brake"]
    lit = [flashed(lamps, t, "v00001") for t in np.arange(0, 20 * RECORDING_REACH.flash_s, 0.01)]
    assert all(state & LAMP_BITS["brake"] for state in lit)
    on = np.array([bool(state & LAMP_BITS["indicator_left"]) for state in lit])
    assert on.mean() == pytest.approx(0.5, abs=0.02)
    assert int((np.diff(on.astype(int)) == 1).sum()) == pytest.approx(20, abs=1)


@pytest.mark.parametrize("name", ["gl", "pybullet"])
def test_bystanders_hide_vehicles_and_have_no_labels(name: str) -> None:
    camera = Camera.looking((0.0, 0.0, 4.0), yaw=0.0, pitch_down=0.2, size=(640, 360), fov=0.6)
    alone = standing(camera, [("sedan", 15.0, 0.0, math.pi / 2)])
    crowd = with_people(alone, [(13.2, 0.6 * i - 1.8, 0.0) for i in range(7)])
    seen, hidden = (
        annotate(r.moment(0), make_renderer(name, r).render(0), r.camera, Rules(), 1)[0] for r in (alone, crowd)
    )
    assert len(seen) == len(hidden) == 1
    assert hidden[0].occlusion > seen[0].occlusion + 0.2
    v, w = seen[0].keypoints[:, 2], hidden[0].keypoints[:, 2]
    assert not ((w == 2) & (v == 1)).any()
    assert int(((w == 1) & (v == 2)).sum()) >= 3
    assert len(w) == keypoints.K
