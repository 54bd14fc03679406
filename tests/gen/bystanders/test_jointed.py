"""Jointed people: their surfaces, their feet, and what they are drawn with."""

import itertools
from collections import Counter

import numpy as np
import pytest

from skope.gen.bystanders import bystander
from skope.gen.bystanders.bystander import BYSTANDER_KINDS, Bystander, build_bystander
from skope.gen.bystanders.luggage import LUGGAGE_KINDS
from skope.gen.bystanders.people import Look
from skope.gen.bystanders.riding import MACHINE_NAMES, standing_lean
from skope.gen.bystanders.walking import SOLE_SHARE, leg_to, sunk
from skope.gen.mesh import Mesh
from skope.gen.render.lit_lamps import lamps_of
from skope.types import Array


def placed(body: Bystander, travelled: float = 0.0, speed: float = 5.0) -> list[Array]:
    """(N, 3) vertices of each part in the body's frame."""
    poses = [np.eye(4), *body.pose(travelled, speed)]
    return [
        mesh.vertices @ T[:3, :3].T + T[:3, 3] for mesh, T in zip(body.parts, poses, strict=True) if len(mesh.vertices)
    ]


def volume(mesh: Mesh) -> float:
    a, b, c = mesh.vertices[mesh.triangles].swapaxes(0, 1)
    return float((a * np.cross(b, c)).sum() / 6)


def drawn(kind: str, count: int = 60) -> list[Look]:
    rng = np.random.default_rng(3)
    return [bystander.draw_look(kind, rng, raining=k % 2 == 0) for k in range(count)]


@pytest.mark.parametrize("kind", BYSTANDER_KINDS)
def test_every_load_is_drawn_on_the_ground_or_above_and_faces_outward(kind: str) -> None:
    machines = range(len(MACHINE_NAMES.get(kind, (0,))))
    for load, machine, passenger in itertools.product(range(len(LUGGAGE_KINDS)), machines, (0.0, 1.0)):
        look = Look(jointed=1.0, load=float(load), machine=float(machine), passenger=passenger, helmet=1.0)
        body = build_bystander(kind, look.to_dict())
        assert all(volume(part) > 0 for part in body.parts)
        assert len(body.parts) <= 8
        lowest = min(points[:, 2].min() for points in placed(body, speed=0.0 if kind == "pedestrian" else 5.0))
        assert lowest == pytest.approx(0, abs=0.012)


@pytest.mark.parametrize("kind", BYSTANDER_KINDS)
def test_no_pose_reaches_out_of_the_extent(kind: str) -> None:
    for look in drawn(kind, 20):
        body = build_bystander(kind, look.to_dict())
        low, high = body.extent
        for travelled, speed in itertools.product(np.linspace(0, 7, 15), (0.0, 0.5, 1.4, 2.9)):
            for points in placed(body, float(travelled), speed):
                assert (points >= low).all()
                assert (points <= high).all()


def test_the_lower_foot_of_a_walker_is_on_the_ground_and_the_knee_bends() -> None:
    look = Look(jointed=1.0)
    body = build_bystander("pedestrian", look.to_dict())
    lifted = []
    for travelled in np.linspace(0, 3, 40):
        for speed in (0.0, 0.7, 1.4):
            ankles = sorted(float(points[:, 2].min()) for points in placed(body, float(travelled), speed)[-2:])
            assert ankles[0] - sunk(look, float(travelled), speed) == pytest.approx(0, abs=0.006)
            lifted.append(ankles[1] - ankles[0])
            if speed == 0:
                assert ankles == pytest.approx([0, 0], abs=0.002)
    assert max(lifted) > 0.10


def test_feet_turn_with_the_pedals_and_come_down_where_the_rider_stands() -> None:
    body = build_bystander("cyclist", Look(jointed=1.0).to_dict())
    for travelled in np.linspace(0, 5, 21):
        *_, right, left, pedals = placed(body, float(travelled))
        for sole, side in ((right, -1), (left, 1)):
            pedal = pedals[np.sign(pedals[:, 1]) == side]
            end = pedal[np.argmax(np.abs(pedal[:, 1]))]
            near = np.linalg.norm(sole[:, [0, 2]] - end[[0, 2]], axis=1).min()
            assert near < 0.08
    before, after = (placed(body, travelled)[-3] for travelled in (0.0, 0.2))
    assert after[:, 0].mean() < before[:, 0].mean() - 0.01  # the right pedal begins below, and goes back there
    _, _, left, _ = placed(body, 1.0, 0.0)[-4:]
    lean = standing_lean(0.0)
    # On the side to which the bicycle leans the road is higher in its own frame.
    foot = left[np.argmin(left[:, 2])]
    assert foot[2] - foot[1] * np.tan(lean) == pytest.approx(0, abs=0.06)
    assert foot[1] > 0.2
    assert standing_lean(3.0) == 0


def test_a_leg_ends_where_it_has_to() -> None:
    look = Look(jointed=1.0)
    for ankle in ((0.1, 0.05, -0.7), (-0.2, 0.0, -0.5), (0.0, 0.3, -0.6)):
        thigh, shin = leg_to(look, (0.0, 0.0, 0.0), ankle)
        for T in (thigh, shin):
            assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3))
        assert np.allclose(thigh @ [0, 0, -0.245 * look.height, 1], shin[:, 3])
        assert np.allclose((shin @ [0, 0, -0.245 * look.height, 1])[:3], ankle)
        assert shin[0, 3] > min(0.0, ankle[0])  # the knee is in front
    far = leg_to(look, (0.0, 0.0, 0.0), (0.0, 0.0, -2.0))[1] @ [0, 0, -0.245 * look.height, 1]
    assert far[2] == pytest.approx(-(0.53 - SOLE_SHARE) * look.height, abs=0.002)


@pytest.mark.parametrize("machine", [0, 1, 2])
@pytest.mark.parametrize("kind", ["cyclist", "motorcyclist"])
def test_lamps_shine_ahead_and_behind(kind: str, machine: int) -> None:
    lamps = lamps_of(build_bystander(kind, Look(jointed=1.0, machine=float(machine)).to_dict()))
    ahead = {"cyclist": "reverse_light", "motorcyclist": "headlight"}[kind]
    assert {lamp.material for lamp in lamps} == {ahead, "taillight"}
    for lamp in lamps:
        assert lamp.facing[0] == pytest.approx(-1 if lamp.material == "taillight" else 1, abs=0.01)
        assert np.sign(lamp.center[0]) == lamp.facing[0].round()


def test_people_differ() -> None:
    for kind in BYSTANDER_KINDS:
        every = drawn(kind, 300)
        loads = Counter(LUGGAGE_KINDS[int(look.load)] for look in every)
        assert len(loads) >= 5
        assert loads["nothing"] > 40
        assert len({look.palette for look in every}) == 300
        assert {look.helmet for look in every} == ({0.0, 1.0} if kind == "cyclist" else {0.0})
        assert {look.passenger for look in every} == ({0.0} if kind == "pedestrian" else {0.0, 1.0})
        assert {int(look.machine) for look in every} == set(range(len(MACHINE_NAMES.get(kind, (0,)))))
    assert any(look.load == LUGGAGE_KINDS.index("umbrella") for look in drawn("pedestrian", 40))
    dry = [bystander.draw_look("pedestrian", np.random.default_rng(k)) for k in range(100)]
    assert not any(look.load == LUGGAGE_KINDS.index("umbrella") for look in dry)
    assert Look(**drawn("cyclist")[0].to_dict()) == drawn("cyclist")[0]
