"""Roads of users: site files and their mistakes, the example from end to end, left-hand traffic, flows, the sun."""

import json
import math
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
import shapely
from shapely import LineString
from shapely.ops import unary_union

from skope.camera.model import Camera, Distortion
from skope.cli import main
from skope.dataset.folder import open_dataset
from skope.errors import UserError
from skope.gen.generation_site import OwnSite, read_generation_site
from skope.gen.inspect.check import check
from skope.gen.labels.ignore_rules import Rules
from skope.gen.pipeline.config import DatasetRequest, from_preset
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.daylight import Daylight
from skope.gen.render.gl.background import fitted_to_photograph
from skope.gen.render.gl.renderer import device
from skope.gen.scene import recording as recordings
from skope.gen.scene.conditions import sun_direction, time_of_day
from skope.gen.scene.recording import Recording, RecordingPlan
from skope.gen.scene.variation import Variation
from skope.gen.scenery.build import scenery
from skope.gen.scenery.markings import markings, zebra_stripes
from skope.gen.simulation.simulate import simulate
from skope.gen.towns import netconvert
from skope.gen.towns.land_use import sidewalks
from skope.gen.towns.road_graph import RoadGraph, driven, is_lefthand, mirrored_town
from skope.gen.towns.sites import site, site_of
from skope.gen.towns.town import OwnRoad, Town, town_folder
from skope.gen.traffic.demand import trips
from skope.gen.traffic.route_files import scheduled, streams
from skope.gen.vehicles.fleet import fleet

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_road"
FLIP = np.array([1.0, -1.0, 1.0])


def run(*arguments: str) -> int:
    """The exit code of a `skope` command."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["skope", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
    return int(stop.value.code or 0)


def planned(own: OwnSite, **values: object) -> RecordingPlan:
    fields = {"index": 0, "frames": 3, "interval": 0.5, "size": (320, 180), "fov_deg": 0.0, "seed": 4}
    return RecordingPlan(site=own.site, **{**fields, **values})


# ---------------------------------------------------------------------------------------------------------- the example


@pytest.fixture(scope="module")
def own() -> OwnSite:
    return read_generation_site(EXAMPLE / "site.toml")


@pytest.fixture(scope="module")
def made(own: OwnSite) -> Recording:
    return simulate(planned(own))


def command(out: Path, example: Path = EXAMPLE) -> list[str]:
    site_file = str(example / "site.toml")
    return ["gen", "--site", site_file, "--size", "320x180", "--frames", "4", "--out", str(out), "--workers", "1", "-q"]


def test_the_example_from_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example = tmp_path / "example"
    shutil.copytree(EXAMPLE, example)
    out = tmp_path / "data"
    assert run(*command(out, example)) == 0
    dataset = open_dataset(out)
    assert dataset.splits == ("test", "train")
    assert list(check(dataset)) == []
    photograph = cv2.imread(str(EXAMPLE / "empty.jpg"))
    photograph = cv2.resize(photograph, (320, 180), interpolation=cv2.INTER_AREA)[..., ::-1].astype(float)
    for split in dataset.splits:
        file = dataset.read(split)
        assert len(file.images) == 2
        assert sum(not a.iscrowd for a in file.annotations) >= len(file.images)
        for image in file.images:
            difference = np.abs(dataset.image(image) - photograph).max(axis=-1)
            assert np.median(difference) < 6  # noise and JPEG
            assert (difference > 40).mean() > 0.005  # vehicles
    assert dataset.card["parameters"]["own"]["digests"].keys() == {"site", "network", "background", "camera.file"}
    assert "photograph" in dataset.card["licence"]
    assert run(*command(out, example)) == 0
    assert "complete already" in capsys.readouterr().out
    (example / "empty.jpg").write_bytes((EXAMPLE / "empty.jpg").read_bytes() + b"\0")
    assert run(*command(out, example)) == 2
    assert "started with other parameters (own" in capsys.readouterr().err


def test_shadows_and_vehicles_fit_the_photograph(own: OwnSite, made: Recording) -> None:
    camera = own.road.camera
    straight = OwnRoad(
        **{**vars(own.road), "camera": Camera(camera.width, camera.height, camera.K, camera.T_camera_world)}
    )
    plain = Recording(**{**vars(made), "town": Town.of(straight), "camera": straight.camera.resized((320, 180))})
    view = make_renderer("gl", plain).render(1)
    drawn = (view.ids > 0) | (cv2.dilate((view.ids > 0).astype(np.uint8), np.ones((41, 41))) > 0)
    assert plain.photograph is not None
    noise = plain.conditions.noise
    assert np.abs(view.rgb.astype(int) - plain.photograph)[~drawn].mean() < noise + 0.5
    # Beside the vehicles the road is darker: their shadows.
    beside = drawn & (view.ids == 0) & np.isfinite(view.depth)
    change = view.rgb.astype(int).sum(-1) - plain.photograph.astype(int).sum(-1)
    assert (change[beside] < -60).sum() > max(100, 5 * (change[beside] > 60).sum())


def test_vehicles_in_the_photographs_shade_are_dark(own: OwnSite, made: Recording) -> None:
    shade = ((300.0, 360.0), (1270.0, 250.0), (1270.0, 710.0), (500.0, 710.0))
    shaded = OwnRoad(**{**vars(own.road), "shades": (shade,)})
    frames = [make_renderer("gl", one).render(1) for one in (made, replace(made, town=Town.of(shaded)))]
    mask = cv2.fillPoly(np.zeros((180, 320), np.uint8), [np.array(shade).astype(int) // 4], 1) > 0
    vehicles = mask & (frames[0].ids > 0)
    assert vehicles.sum() > 300
    # Black paint shows the sky whether the sun shines on it or not; where it does is among the brighter places.
    grey = frames[0].rgb.mean(axis=-1)
    sunlit = vehicles & (grey > np.percentile(grey[vehicles], 60))
    bright, dark = (frame.rgb[sunlit].mean() for frame in frames)
    assert dark < 0.9 * bright
    alone = cv2.dilate((frames[0].ids > 0).astype(np.uint8), np.ones((41, 41))) == 0
    assert (frames[0].rgb[alone] != frames[1].rgb[alone]).mean() < 0.005  # long shadows


def test_depth_behind_a_photograph_is_the_ground_and_the_occluders(own: OwnSite, made: Recording) -> None:
    view = make_renderer("gl", made).render(0)
    empty = view.ids == 0
    rows, columns = np.nonzero(empty & np.isfinite(view.depth))
    points, _ = made.camera.unproject(np.stack([columns, rows], axis=-1) + 0.5, view.depth[rows, columns])
    near = np.linalg.norm(points - made.camera.position, axis=1) < 60
    flat = np.abs(points[near, 2]) < 0.05
    assert flat.mean() > 0.97
    shown = view.depth[rows, columns][near][~flat]
    assert len(shown) > 5
    assert np.abs(shown[:, None] - [one.distance for one in own.road.occluders]).min(axis=1).max() < 0.5


def test_the_light_of_a_drawn_photograph_is_found_again() -> None:
    """What skope draws with an exposure and photographs is exposed so again."""
    name, ev = "t01_mill_corner", 0.4
    plan = RecordingPlan(
        site=site(name), index=0, frames=1, interval=0.5, size=(480, 270), fov_deg=80, seed=1,
        variation=Variation(
            settings={"exposure_ev": (ev, ev), "noise": (0, 0), "vignetting": (0, 0), "clouds": (0, 0)}
        ),
    )  # fmt: skip
    recording = simulate(plan)
    rows = ("frame", "vehicle", "T_world_chassis", "T_world_wheels", "velocity", "lamps")
    fields = vars(recording) | {name: getattr(recording, name)[:0] for name in rows} | {"vehicles": ()}
    picture = make_renderer("gl", Recording(**fields)).render(0).rgb
    data = cv2.imencode(".png", picture[..., ::-1])[1].tobytes()
    shot = OwnRoad(
        title="shot", network=Town("town01").network.read_bytes(), style="", camera=recording.camera, photograph=data
    )
    daylight = Daylight.of(recording.conditions)
    found = fitted_to_photograph(device(), daylight, shot)
    assert math.log2((found.exposure / daylight.exposure).mean()) == pytest.approx(0, abs=0.35)
    np.testing.assert_allclose(found.sun / daylight.sun, 1, atol=0.1)


def test_recordings_carry_their_road(own: OwnSite, made: Recording, tmp_path: Path) -> None:
    recordings.save(tmp_path / "r.npz", made)
    again = recordings.load(tmp_path / "r.npz")
    assert again.town.road is not None
    assert again.town.road is not own.road
    assert again.town.name == again.town.road.name == own.road.name
    assert scenery.__wrapped__(again.town).mesh.triangles.shape == scenery(made.town).mesh.triangles.shape
    np.testing.assert_array_equal(again.photograph, made.photograph)
    recordings.save(tmp_path / "again.npz", again)
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "r.npz").read_bytes()


def test_the_fallback_renderer_shows_the_photograph(made: Recording) -> None:
    small = Recording(**{**vars(made), "camera": made.camera.resized((160, 90)), "photograph": None})
    view = make_renderer("pybullet", small).render(0)
    assert small.photograph is not None
    empty = ~(cv2.dilate((view.ids > 0).astype(np.uint8), np.ones((31, 31))) > 0)
    assert np.abs(view.rgb.astype(int) - small.photograph)[empty].mean() < 4


def request(own: OwnSite, preset: str = "demo", **values: object) -> DatasetRequest:
    return from_preset(preset, seed=0, renderer="gl", driver="", rules=Rules(), user_site=own, **values)


def test_recordings_of_a_site_are_for_training_but_one(own: OwnSite) -> None:
    plans = request(own, "paper").plans()
    assert [plan.site.split for plan in plans] == ["train"] * 9 + ["test"]
    assert {plan.site.time_of_day for plan in plans} == {"noon"}  # the photograph's
    assert plans[0].size == (1280, 720)
    with pytest.raises(UserError, match="--size"):
        request(own, size="640x480")
    with pytest.raises(UserError, match="k1"):
        request(own, settings={"k1": (-0.1, 0.0)})


@pytest.mark.parametrize("flags", [["--fov", "60"], ["--sites", "t01_mill_corner"]])
def test_a_site_file_rules_out_what_it_says_itself(
    flags: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*command(tmp_path / "d"), *flags) == 2
    assert "site.toml" in capsys.readouterr().err
    assert not (tmp_path / "d").exists()


def test_lanes_are_drawn_over_the_photograph(tmp_path: Path, capsys: pytest.CaptureFixture[str], own: OwnSite) -> None:
    assert run("gen", "sites", "--site", str(EXAMPLE / "site.toml"), "--out", str(tmp_path)) == 0
    assert "7.6 m over the road" in capsys.readouterr().out
    drawn = cv2.imread(str(tmp_path / "site.png"))[..., ::-1]
    lane = RoadGraph.of(own.site.town).net.getLane("-10#0_0")
    a, b = (np.array(point) for point in lane.getShape3D()[:2])
    across = np.array([a[1] - b[1], b[0] - a[0], 0]) / np.linalg.norm(b - a) * lane.getWidth() / 2
    for edge in (a + 0.3 * (b - a) + side * across for side in (-1, 1)):
        column, row = own.road.camera.project(edge)[0].astype(int)
        red, _, blue = drawn[row, column].tolist()
        assert red > 200
        assert blue < 120


# ------------------------------------------------------------------------------------------------- without a photograph


NEEDS_NETCONVERT = pytest.mark.skipif(netconvert.program() is None, reason="netconvert is not installed")


@NEEDS_NETCONVERT
def test_maps_are_converted_around_their_origin() -> None:
    drawn = read_generation_site(EXAMPLE / "drawn.toml")
    nodes = {node.getID(): node.getCoord() for node in RoadGraph.of(drawn.site.town).net.getNodes()}
    assert nodes["3"] == pytest.approx((0, 0), abs=0.02)
    assert nodes["1"] == pytest.approx((-170, -4), abs=0.02)
    assert drawn.road.network == (EXAMPLE / "junction.net.xml").read_bytes()
    plans = request(drawn).plans()
    assert [plan.site.split for plan in plans] == ["train", "train", "test"]
    assert len({plan.site.time_of_day for plan in plans}) > 1
    assert plans[0].site.conditions.keys() == {"sun_elevation_deg", "sun_azimuth_deg"}
    assert not plans[2].site.conditions


def test_maps_need_netconvert(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(netconvert, "program", lambda: None)
    with pytest.raises(UserError, match=r"drawn\.toml: network: .*junction\.osm.*pip install 'skope\[maps\]'"):
        read_generation_site(EXAMPLE / "drawn.toml")


@NEEDS_NETCONVERT
def test_opendrive_comes_in_too(tmp_path: Path) -> None:
    road, program = tmp_path / "road.xodr", str(netconvert.program())
    options = [f"--sumo-net-file={EXAMPLE / 'junction.net.xml'}", f"--opendrive-output={road}"]
    subprocess.run([program, *options], check=True, capture_output=True)
    text = netconvert.from_map(road, "opendrive", None, lefthand=False)
    assert "<edge id=" in text


# ------------------------------------------------------------------------------------------------------------- mistakes


BASE = {
    "network": "junction.net.xml",
    "vehicles_per_hour": 600,
    "camera": {"position": [24.0, -8.6, 7.6], "look_at": [-4.0, 2.5, 0.0], "fov_deg": 78.0, "size": [640, 360]},
}


def toml(values: dict) -> str:
    return "\n".join(f"{key} = {inline(value)}" for key, value in values.items())


def inline(value: object) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {inline(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(inline, value)) + "]"
    return json.dumps(value)


def raised(shape: re.Match[str]) -> str:
    """A shape in a network, 115 m higher."""
    return shape[1] + " ".join(f"{point},115.00" for point in shape[2].split())


def camera(**change: object) -> dict:
    values = {**BASE["camera"], **change}  # type: ignore[dict-item]
    return {"camera": {key: value for key, value in values.items() if value is not None}}


POLE = {"polygon": [[10, 10], [20, 10], [15, 300]]}
HUNG = {"position": None, "look_at": None}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"densty": 3}, ["densty", "unknown", "vehicles_per_hour"]),
        ({"vehicles_per_hour": -5}, ["vehicles_per_hour", "-5"]),
        ({"vehicles_per_hour": "many"}, ["vehicles_per_hour", "many"]),
        ({"network": "none.net.xml"}, ["network", "none.net.xml", "no such file"]),
        ({"network": "site.toml"}, ["network", ".net.xml", ".osm"]),
        ({"network": "broken.net.xml"}, ["network", "not a SUMO network"]),
        ({"background": "gone.jpg"}, ["background", "gone.jpg"]),
        ({"background": "junction.osm"}, ["background", "not a readable image"]),
        ({"background": "square.png"}, ["background", "100x100", "640x360"]),
        ({"occluders": [{**POLE, "distance": 9}]}, ["occluders", "background is missing"]),
        ({"background": "wide.png", "occluders": [{**POLE, "foot": [300, 3]}]}, ["occluders.foot", "ground"]),
        ({"background": "wide.png", "occluders": [{**POLE, "distance": 9, "hight": 2}]}, ["hight", "unknown"]),
        ({"background": "wide.png", "shades": [{"polygon": [[1, 1], [9, 1], [9, 9]]}]}, ["shades.polygon", "horizon"]),
        (
            {"background": "wide.png", "shades": [{"polygon": [[300, 300], [400, 340], [300, 340], [400, 300]]}]},
            ["shades.polygon", "cross"],
        ),
        ({"lefthand": True}, ["lefthand", "maps"]),
        ({"network": "high.net.xml"}, ["network", "115 m", "--offset.z -115"]),
        ({"name": "my road"}, ["name", "my road"]),
        ({"splits": []}, ["splits"]),
        ({"flows": "flows.rou.xml"}, ["vehicles_per_hour", "flows"]),
        ({"light": {"weather": "hail"}}, ["light", "hail", "clear"]),
        ({"light": {"when": "noon"}}, ["light.when", "zone"]),
        ({"light": {"hour": 3}}, ["light.hour", "unknown"]),
        ({"conditions": {"noise": 900}}, ["conditions", "noise"]),
        ({"conditions": {"nose": 1}}, ["conditions.nose", "unknown"]),
        (camera(position=[24.0, -8.6, -3.0]), ["camera", "-3.00 m", "road"]),
        (camera(look_at=[60.0, -90.0, 30.0]), ["camera", "no lane"]),
        (camera(position=[9e3, 0.0, 8.0]), ["network", "no lane", "x -170 to 175"]),
        (camera(fov_deg=None), ["camera", "K, fov_deg and file"]),
        (camera(fov_deg=190), ["camera.fov_deg", "190"]),
        (camera(fov_deg=None, K=[[0, 0, 0]] * 3), ["camera", "K"]),
        (camera(fov_deg=None, K=[[1, 2], [3, 4]]), ["camera.K", "3 rows"]),
        (camera(K=[[500, 0, 320], [0, 500, 180], [0, 0, 1]]), ["camera", "one of"]),
        (camera(look_at=None), ["camera", "pose is missing"]),
        (camera(yaw_deg=3), ["camera", "twice"]),
        (camera(**HUNG, R=[[2, 0, 0], [0, 1, 0], [0, 0, 1]], t=[0, 0, 0]), ["camera", "rigid"]),
        (camera(**HUNG, points=[[1, 2, 3, 4, 5]] * 3), ["camera", "4 or more"]),
        (camera(**HUNG, points=3), ["camera.points", "rows"]),
        (camera(size=[640, 0]), ["camera.size"]),
        (camera(file="gone.yml"), ["camera.file", "gone.yml"]),
        (camera(distortion={"model": "brown", "coefficients": [-0.9, 0.0, 0.0, 0.0]}), ["folds"]),
        (camera(distortion={"model": "barrel", "coefficients": [1]}), ["camera", "barrel"]),
        (camera(lens="wide"), ["camera.lens", "unknown"]),
    ],
)  # fmt: skip
def test_a_bad_site_gets_one_line(
    change: dict, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("junction.net.xml", "junction.osm", "flows.rou.xml"):
        shutil.copy(EXAMPLE / name, tmp_path / name)
    (tmp_path / "broken.net.xml").write_text("<net><edge")
    net = (EXAMPLE / "junction.net.xml").read_text()
    (tmp_path / "high.net.xml").write_text(re.sub(r"(shape=\")([^\"]+)", raised, net))
    cv2.imwrite(str(tmp_path / "wide.png"), np.zeros((180, 320, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "square.png"), np.zeros((100, 100, 3), np.uint8))
    (tmp_path / "site.toml").write_text(toml({**BASE, **change}))
    assert (
        run("gen", "--site", str(tmp_path / "site.toml"), "--renderer", "pybullet", "--out", str(tmp_path / "d")) == 2
    )
    error = capsys.readouterr().err
    assert error.count("\n") == 1, error
    assert "site.toml" in error
    assert all(word in error for word in words), error
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize(("text", "word"), [("network = ", "not valid TOML"), (None, "no such file")])
def test_a_site_file_that_is_none(text: str | None, word: str, tmp_path: Path) -> None:
    if text:
        (tmp_path / "site.toml").write_text(text)
    with pytest.raises(UserError, match=word):
        read_generation_site(tmp_path / "site.toml")


def test_cameras_in_all_ways_are_the_same_camera(tmp_path: Path) -> None:
    shutil.copy(EXAMPLE / "junction.net.xml", tmp_path)
    lens = {"model": "brown", "coefficients": [-0.09, 0.012, 0.0005, -0.0003, 0.0]}
    own = Camera.looking(
        [24.0, -8.6, 7.6], yaw=math.radians(160), pitch_down=math.radians(14), roll=0.01, size=(1280, 720),
        fov=math.radians(78), distortion=Distortion("brown", (-0.09, 0.012, 0.0005, -0.0003, 0.0)),
    )  # fmt: skip
    K, T = own.K.tolist(), own.T_camera_world.tolist()
    ground = np.array([[10, 0, 0], [-30, 8, 0], [-12, -9, 0], [0, 12, 0], [-60, 2, 0], [5, 5, 1.0]])
    points = np.column_stack([own.project(ground)[0], ground]).tolist()
    angles = {"position": [24.0, -8.6, 7.6], "yaw_deg": 160.0, "pitch_deg": 14.0, "roll_deg": math.degrees(0.01)}
    ways = [
        {"K": K, "T_camera_world": T},
        {"fov_deg": 78.0, "R": [row[:3] for row in T[:3]], "t": [row[3] for row in T[:3]]},
        {"fov_deg": 78.0, **angles},
        {"K": K, "points": points},
        {"points": points},
    ]
    for way in ways:
        values = {**BASE, "camera": {"size": [1280, 720], "distortion": lens, **way}}
        (tmp_path / "site.toml").write_text(toml(values))
        read = read_generation_site(tmp_path / "site.toml")
        np.testing.assert_allclose(read.road.camera.project(ground)[0], own.project(ground)[0], atol=0.01)
        assert bool(read.messages) == ("points" in way)


def test_what_evaluating_needs_of_a_site_file_does_generating_no_harm(tmp_path: Path) -> None:
    shutil.copy(EXAMPLE / "junction.net.xml", tmp_path)
    camera = {**BASE["camera"], "covariance": {"of": ["z"], "matrix": [[0.01]]}, "calibrated": {"from": "6 points"}}
    gate = {"name": "north", "line": [[0, 0], [8, 0]], "colour": "red"}
    shared = {"gates": [gate], "calibration": {"points": [{"pixel": [1, 2], "place": [3, 4]}]}, "time_zone": "UTC"}
    shared["world"] = {"origin": {"longitude": 8.4, "latitude": 49.0}}
    shared["plan"] = {"file": "not_there.png", "metres_per_pixel": 0.1, "origin": [0, 0]}
    (tmp_path / "site.toml").write_text(toml({**BASE, **shared, "camera": camera}))
    read = read_generation_site(tmp_path / "site.toml")
    assert read.messages == ("site.toml: gates[1].colour: unknown; not used",)
    (tmp_path / "site.toml").write_text(toml({**BASE, "gates": [{**gate, "line": [[0, 0]]}]}))
    with pytest.raises(UserError, match=r"site.toml: gates\[1\].line: expected two or more"):
        read_generation_site(tmp_path / "site.toml")


def calibrated(folder: Path, size: list[int] | None) -> Camera:
    """The example's camera from its calibration file, at a [camera] size of its own."""
    for name in ("junction.net.xml", "camera.yml"):
        shutil.copy(EXAMPLE / name, folder)
    table = {"file": "camera.yml", **({"size": size} if size else {})}
    (folder / "site.toml").write_text(toml({**BASE, "camera": table}))
    return read_generation_site(folder / "site.toml").road.camera


def test_a_calibration_is_scaled_to_the_cameras_size(tmp_path: Path) -> None:
    whole, half = calibrated(tmp_path, None), calibrated(tmp_path, [640, 360])
    assert (whole.width, half.width) == (1280, 640)
    ground = np.array([[10, 0, 0], [-30, 8, 0], [-12, -9, 0], [0, 12, 0], [5, 5, 1.0]])
    np.testing.assert_allclose(half.project(ground)[0], whole.project(ground)[0] / 2, atol=1e-9)
    assert half.distortion == whole.distortion
    rounded = calibrated(tmp_path, [853, 480])  # 1280x720 has no 853 exactly
    np.testing.assert_allclose(rounded.project(ground)[0], whole.project(ground)[0] * [853 / 1280, 2 / 3], atol=1e-9)


@pytest.mark.parametrize("size", [[640, 480], [720, 1280], [1280, 722]])
def test_a_size_of_another_shape_than_the_calibrations_is_refused(tmp_path: Path, size: list[int]) -> None:
    with pytest.raises(UserError, match=r"site\.toml: camera\.size: .* 1280x720 .*camera\.yml") as raised:
        calibrated(tmp_path, size)
    assert "\n" not in str(raised.value)


# ---------------------------------------------------------------------------------------------------- left-hand traffic


@pytest.fixture(scope="module")
def both() -> tuple[OwnRoad, OwnRoad]:
    """Town 01 as it is, and in the mirror: there people drive on the left."""
    net, style = Town("town01").network.read_bytes(), (town_folder("town01") / "town.toml").read_text(encoding="utf-8")
    left = mirrored_town(net).replace(b"<net ", b'<net lefthand="true" ', 1)
    corner, out = site("t01_mill_corner"), []
    for data, side in ((net, 1.0), (left, -1.0)):
        hung = Camera.looking(
            np.array(corner.position) * [1, side, 1], yaw=side * math.radians(corner.yaw_deg), pitch_down=0.3
        )
        out.append(OwnRoad(title="corner", network=data, style=style, camera=hung))
    return out[0], out[1]


def test_the_mirror_turns_round_and_back() -> None:
    net = Town("town01").network.read_bytes()
    assert not is_lefthand(net)
    assert is_lefthand(b'<net version="1.20" lefthand="true">')
    assert mirrored_town(mirrored_town(net)) == mirrored_town(mirrored_town(mirrored_town(mirrored_town(net))))


def test_what_stands_beside_a_left_hand_road_is_on_the_other_side(both: tuple[OwnRoad, OwnRoad]) -> None:
    right, left = (RoadGraph.of(Town.of(one)) for one in both)
    assert left.mirrored
    assert right.ground_road.symmetric_difference(left.ground_road).area < 1e-3
    painted = [unary_union([*markings(graph), *zebra_stripes(graph)]) for graph in (right, left)]
    assert painted[0].symmetric_difference(painted[1]).area < 1e-3
    signals = [scenery(Town.of(one)).signals for one in both]
    assert len(signals[0]) == len(signals[1]) > 3
    for a, b in zip(*signals, strict=True):
        np.testing.assert_allclose(a.lamps * FLIP, b.lamps, atol=1e-6)
        np.testing.assert_allclose(a.facing * FLIP, b.facing, atol=1e-6)
    paths = [sidewalks(Town.of(one), one.camera.position[:2], 60.0) for one in both]
    assert len(paths[0]) == len(paths[1]) > 2
    for a, b in zip(*paths, strict=True):
        np.testing.assert_allclose(a * FLIP, b, atol=1e-6)


def test_left_hand_traffic_drives_on_the_left(both: tuple[OwnRoad, OwnRoad]) -> None:
    left = both[1]
    own = site_of(left, split="train", vehicles_per_hour=2500, weather="clear", time_of_day="noon")
    recording = simulate(RecordingPlan(site=own, index=0, frames=12, interval=1.0, size=(640, 360), fov_deg=0, seed=2))
    graph, seen = RoadGraph.of(Town.of(left)), 0
    lanes = [LineString(graph.world(lane.getShape())) for edge in graph.edges for lane in driven(edge)]
    tree = shapely.STRtree(lanes)
    ends = [[graph.world(node.getCoord()) for node in (e.getFromNode(), e.getToNode())] for e in graph.edges]
    middle = unary_union([LineString(pair) for pair in ends])
    for frame in range(len(recording)):
        moment = recording.moment(frame).labelled()
        for vehicle, T, velocity in zip(moment.vehicles, moment.T_world_chassis, moment.velocity, strict=True):
            at, ahead = shapely.Point(T[:2, 3]), T[:2, 0]
            lane = lanes[int(tree.nearest(at))]
            if vehicle.parked or np.linalg.norm(velocity) < 4 or at.distance(shapely.Point(0, 0)) < 40:
                continue
            s = lane.project(at)
            a, b = (np.array(lane.interpolate(t).coords[0]) for t in (s - 1, s + 1))
            assert at.distance(lane) < 1.5
            assert ahead @ (b - a) / np.linalg.norm(b - a) > 0.95
            # The road's middle is to the right.
            foot = np.array(shapely.ops.nearest_points(middle, at)[0].coords[0]) - T[:2, 3]
            seen += 1
            assert ahead[0] * foot[1] - ahead[1] * foot[0] < 0.5
    assert seen > 30


# ---------------------------------------------------------------------------------------------------------------- flows


def routed(body: str) -> str:
    return f"<routes>{body}</routes>"


def test_flows_become_trips_of_the_fleet() -> None:
    text = (EXAMPLE / "flows.rou.xml").read_text()
    rng = np.random.default_rng(1)
    planned = list(scheduled(text, EXAMPLE / "junction.net.xml", fleet(), duration=1200, rng=rng))
    times = [trip.depart for trip in planned]
    assert times == sorted(times)
    assert 0 <= times[0] <= times[-1] < 1200
    of = {edges: sum(trip.edges == edges for trip in planned) for edges in {trip.edges for trip in planned}}
    assert of["10#0", "10#1"] == pytest.approx(150, abs=1)
    assert of["10#0", "11"] == pytest.approx(72, abs=25)
    lorries = [trip for trip in planned if trip.edges == ("-10#1", "-10#0")]
    kinds = {fleet()[trip.model].vehicle.vehicle_type for trip in lorries}
    assert kinds & {"truck", "box_truck"}
    assert not kinds & {"bus", "van"}


def test_density_is_that_of_ways_that_pass() -> None:
    net, rng = EXAMPLE / "junction.net.xml", np.random.default_rng(1)
    passing = frozenset({"11"})
    through = list(trips(net, fleet(), vehicles_per_hour=900, duration=400, rng=rng, passing=passing))
    assert 70 < len(through) < 130
    assert {trip.edges[-1] for trip in through} == {"11"}


def test_single_vehicles_and_named_routes() -> None:
    text = routed(
        '<vType id="b" vClass="bicycle"/><route id="east" edges="10#0 10#1"/>'
        '<vehicle id="a" type="b" depart="5" route="east"/>'
        '<vehicle id="c" depart="7.5"><route edges="-11 -10#0"/></vehicle><trip id="d" depart="9" from="10#0" to="11"/>'
    )
    planned = list(scheduled(text, EXAMPLE / "junction.net.xml", fleet(), duration=60, rng=np.random.default_rng(0)))
    assert [trip.depart for trip in planned] == [0, 2.5, 4]
    assert [trip.edges for trip in planned] == [("10#0", "10#1"), ("-11", "-10#0"), ("10#0", "11")]
    assert planned[0].model == "cyclist"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("<routes", "not XML"),
        (routed(""), "expected at least one vehicle"),
        (routed('<trip id="a" depart="0" from="x" to="11"/>'), "no edge x"),
        (routed('<trip id="a" depart="0" from="11" to="10#0"/>'), "no route from 11 to 10#0"),
        (routed('<flow id="f" from="10#0" to="11" vehsPerHour="-3"/>'), "flow 'f': vehsPerHour"),
        (routed('<flow id="f" from="10#0" to="11"/>'), "period"),
        (routed('<vehicle id="a" depart="soon" route="r"/>'), "depart"),
        (routed('<vehicle id="a" depart="1" route="r"/>'), "route"),
        *(
            (routed(f'<flow id="f" from="10#0" to="11" period="exp({rate})"/>'), "flow 'f': period: expected exp")
            for rate in ("0", "-1", "nan", "inf", "often")
        ),
        (routed('<flow id="f" from="10#0" to="11" vehsPerHour="1e12"/>'), "flow 'f': more than 100000 vehicles per"),
        (routed('<flow id="f" from="10#0" to="11" end="10" number="1000000000"/>'), "flow 'f': more than 100000"),
        (routed('<flow id="f" from="10#0" to="11" period="exp(1e9)"/>'), "flow 'f': more than 100000 vehicles per"),
        ('<!DOCTYPE r [<!ENTITY e SYSTEM "secret.txt">]>' + routed("&e;"), "DOCTYPE"),
        ('<!DOCTYPE routes SYSTEM "routes.dtd">' + routed('<trip id="a" from="10#0" to="11"/>'), "DOCTYPE"),
        (
            routed('<vehicle id="a" depart="1"><route edges="10#0 -10#1"/></vehicle>'),
            "'a': the network has no connection from 10#0 to -10#1",
        ),
        (
            routed('<route id="r" edges="10#0 -11"/><flow id="f" route="r" period="9"/>'),
            "flow 'f': the network has no connection from 10#0 to -11",
        ),
    ],
)
def test_bad_flows_are_named(text: str, word: str) -> None:
    with pytest.raises(UserError, match=word):
        streams(text, EXAMPLE / "junction.net.xml")


def test_bad_flows_of_a_site_get_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(EXAMPLE / "junction.net.xml", tmp_path)
    values = {key: value for key, value in BASE.items() if key != "vehicles_per_hour"}
    (tmp_path / "site.toml").write_text(toml({"flows": "flows.rou.xml", **values}))
    for text in (
        routed('<flow id="f" from="10#0" to="11" period="exp(0)"/>'),
        routed('<flow id="f" from="10#0" to="11" vehsPerHour="1e12"/>'),
        '<!DOCTYPE r [<!ENTITY e SYSTEM "site.toml">]>' + routed("&e;"),
        routed('<vehicle id="a" depart="1"><route edges="10#0 -10#1"/></vehicle>'),
    ):
        (tmp_path / "flows.rou.xml").write_text(text)
        assert run("gen", "--site", str(tmp_path / "site.toml"), "--out", str(tmp_path / "d")) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1, error
        assert all(word in error for word in ("site.toml: flows: ", "flows.rou.xml: ")), error
        assert not (tmp_path / "d").exists()


# ------------------------------------------------------------------------------------------------------------------ sun


def test_the_sun_stands_where_almanacs_have_it() -> None:
    # At an equinox the sun is in the zenith of the equator at noon; days are 90 degrees of azimuth apart from it.
    elevation, _ = sun_direction(datetime(2026, 3, 20, 12, 7, tzinfo=UTC), 0.0, 0.0)
    assert elevation == pytest.approx(90, abs=0.3)
    # Summer solstice, Greenwich: 90 - 51.48 + 23.44 degrees in the south (270 counter-clockwise from east).
    elevation, azimuth = sun_direction(datetime(2026, 6, 21, 12, 2, tzinfo=UTC), 51.48, 0.0)
    assert (elevation, azimuth) == pytest.approx((61.96, 270), abs=0.3)
    elevation, azimuth = sun_direction(datetime(2026, 3, 20, 6, 7, tzinfo=UTC), 0.0, 0.0)
    assert elevation == pytest.approx(0, abs=0.3)
    assert min(azimuth, 360 - azimuth) == pytest.approx(0, abs=0.3)
    assert [time_of_day(*at) for at in ((50, 200), (20, 150), (5, 10), (5, 170), (-3, 0))] == [
        *("noon", "low_sun", "dawn", "dusk", "night")
    ]
