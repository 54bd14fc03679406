"""Traffic in the towns: tyres on sloped roads, bodies where SUMO has them, vehicles that do not run into each other."""

import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import sumolib
from shapely import Polygon

from skope.gen.scene.recording import Moment, Recording, RecordingPlan
from skope.gen.scenery.build import scenery
from skope.gen.simulation import simulate as simulation
from skope.gen.simulation.physics import World
from skope.gen.simulation.simulate import simulate
from skope.gen.simulation.smooth_paths import Driven
from skope.gen.towns.sites import site, sites
from skope.gen.towns.town import Town
from skope.gen.traffic.demand import in_town, ways
from skope.gen.vehicles.fleet import build_vehicle, fleet
from skope.gen.vehicles.model import Vehicle


def recorded(name: str, frames: int = 40) -> Recording:
    return simulate(
        RecordingPlan(site=site(name), index=0, frames=frames, interval=0.5, size=(1280, 720), fov_deg=110, seed=2)
    )


@cache
def lane_pieces(town: str) -> tuple[np.ndarray, np.ndarray]:
    """(S, 3) starts and ends of the straight pieces of all lanes that cars drive on."""
    net = sumolib.net.readNet(str(Town(town).network), withInternal=True)
    edges = net.getEdges(withInternal=True)
    lines = [np.array(lane.getShape3D()) for edge in edges for lane in edge.getLanes() if lane.allows("passenger")]
    return np.concatenate([line[:-1] for line in lines]), np.concatenate([line[1:] for line in lines])


def road_height(town: str, place: np.ndarray) -> float:
    """Of the nearest lane at a place (2,)."""
    a, b = lane_pieces(town)
    along = (b - a)[:, :2]
    share = np.clip(((place - a[:, :2]) * along).sum(1) / np.maximum((along**2).sum(1), 1e-9), 0, 1)
    foot = a + share[:, None] * (b - a)
    return float(foot[np.hypot(*(foot[:, :2] - place).T).argmin(), 2])


@pytest.mark.parametrize("name", [pytest.param("t07_hollow_bend", marks=pytest.mark.slow), "t07_county_rise"])
def test_tyres_stay_on_sloped_roads(name: str) -> None:
    recording, checked, heights = recorded(name, 20), 0, []
    for frame in range(len(recording)):
        moment = recording.moment(frame).labelled()
        for vehicle, wheels in zip(moment.vehicles, moment.T_world_wheels, strict=True):
            radius = build_vehicle(vehicle.model, vehicle.shape).shape.wheel_radius
            for T in wheels:
                heights.append(T[2, 3])
                assert T[2, 3] - radius == pytest.approx(road_height("town07", T[:2, 3]), abs=0.02)
                checked += 1
    assert checked > 200
    assert np.ptp(heights) > 1.0


def test_bodies_are_where_sumo_has_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The chassis, sprung and read back from the engine, against the road's frame under the vehicle."""
    away, tilt = [], []

    class Watched(World):
        def advance(self, driven: dict[str, tuple[Vehicle, Driven]]) -> None:
            super().advance(driven)
            for name, pose in self.poses().items():
                state = driven[name][1]
                away.append(np.linalg.norm(pose.T_world_chassis[:3, 3] - state.position))
                (cy, sy), (cp, sp) = ((np.cos(a), np.sin(a)) for a in (state.yaw, state.pitch))
                up = np.array([-cy * sp, -sy * sp, cp])
                tilt.append(np.degrees(np.arccos(np.clip(up @ pose.T_world_chassis[:3, 2], -1, 1))))

    monkeypatch.setattr(simulation, "World", Watched)
    recorded("t02_birch_mast", frames=20)
    assert len(away) > 1000
    assert np.percentile(away, 95) < 0.3
    assert np.percentile(tilt, 95) < 2.0
    assert max(tilt) > 0.2


def footprint(moment: Moment, i: int) -> Polygon:
    vehicle = build_vehicle(moment.vehicles[i].model, moment.vehicles[i].shape)
    length, width, _ = vehicle.size_lwh
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length / 2, width / 2]
    T = moment.T_world_chassis[i]
    return Polygon(corners @ T[:2, :2].T + T[:2, 3])


def overlap(a: Polygon, b: Polygon) -> float:
    """How far two boxes are in each other, metres."""
    if not a.intersects(b):
        return 0.0
    around = a.intersection(b).minimum_rotated_rectangle
    if around.geom_type != "Polygon":
        return 0.0
    return float(np.linalg.norm(np.diff(np.array(around.exterior.coords), axis=0), axis=1).min())


def test_vehicles_at_a_busy_crossing_do_not_run_into_each_other() -> None:
    recording, pairs, touching = recorded("t05_park_third", frames=60), 0, set()
    for frame in range(len(recording)):
        moment = recording.moment(frame).labelled()
        boxes = [footprint(moment, i) for i in range(len(moment.vehicles))]
        for i in range(len(boxes)):
            for j in range(i):
                pairs += 1
                if overlap(boxes[i], boxes[j]) > 0.05:
                    touching.add((moment.vehicles[i].track_id, moment.vehicles[j].track_id))
    assert pairs > 10_000
    assert len(touching) <= 1


def test_no_vehicle_enters_or_leaves_the_town_where_a_camera_sees_more_than_a_speck() -> None:
    for name, place in sites().items():
        camera = place.camera((1920, 1080), 110)
        net = sumolib.net.readNet(str(place.town.network))
        for edges, _ in ways(place.town.network):
            ends = ((net.getEdge(edges[0]), 0), (net.getEdge(edges[-1]), -1))
            rim = np.array([edge.getLanes()[0].getShape3D()[end] for edge, end in ends])
            both = np.stack([rim, rim + [0, 0, 1.5]])
            pixels, _, valid = camera.project(both)
            seen = valid.all(axis=0) & camera.inside(pixels[0])
            assert (np.abs(pixels[1] - pixels[0])[seen, 1] < 10).all(), name


def test_the_types_that_drive_by_have_the_shares_of_their_town() -> None:
    usual = {name: entry for name, entry in fleet().items() if not entry.further}
    models = in_town(usual, "town04")
    total = sum(entry.share for entry in models.values())
    of_type: dict[str, float] = {}
    for entry in models.values():
        kind = entry.vehicle.vehicle_type
        of_type[kind] = of_type.get(kind, 0) + 100 * entry.share / total
    assert of_type["suv"] == pytest.approx(25, abs=1)
    assert of_type["truck"] == pytest.approx(5, abs=0.5)
    assert set(of_type) == {entry.vehicle.vehicle_type for entry in usual.values()}
    assert in_town(fleet(), "elsewhere") == dict(fleet())


def test_parked_vehicles_stand_in_their_bays_all_the_time() -> None:
    recording = recorded("t06_plaza_opening", frames=3)
    poses: dict[int, list[np.ndarray]] = {}
    for frame in range(len(recording)):
        moment = recording.moment(frame).labelled()
        for vehicle, T in zip(moment.vehicles, moment.T_world_chassis, strict=True):
            if vehicle.parked:
                poses.setdefault(vehicle.track_id, []).append(T)
    bays = np.array([bay.position for bay in scenery(Town("town06")).bays])
    assert 5 <= len(poses) <= 30
    for stays in poses.values():
        assert len(stays) == len(recording)
        np.testing.assert_array_equal(stays[0], stays[-1])
        assert np.hypot(*(bays - stays[0][:2, 3]).T).min() < 0.5
    boxes = [footprint(moment, i) for i, vehicle in enumerate(moment.vehicles) if vehicle.parked]
    assert max(overlap(a, b) for k, a in enumerate(boxes) for b in boxes[:k]) < 0.05


def test_the_folder_for_temporary_files_may_have_any_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SUMO takes a comma in a list of files for the end of a name."""
    (tmp_path / "a, b ü").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "a, b ü"))
    assert recorded("t01_mill_corner", frames=1).vehicles


def test_libsumo_is_imported_without_its_words_on_pyarrow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LIBSUMO_AS_TRACI", "as before")
    code = (
        "import os; from skope.gen.traffic.sumo import load_libsumo; load_libsumo(); "
        "assert os.environ['LIBSUMO_AS_TRACI'] == 'as before'"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (ran.stdout, ran.stderr) == ("", "")
