"""`skope eval camera --points`: a camera from points, reference points and site files, with its uncertainty."""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.camera.calibration_files import read_uncertain_camera
from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera, Distortion

SIZE = (1280, 720)
CAMERA = Camera.looking(
    [3, -2, 7.0],
    yaw=0.7,
    pitch_down=0.3,
    size=SIZE,
    fov=math.radians(55),
    distortion=Distortion("brown", (-0.05, 0.0, 0.0, 0.0)),
)
PIXELS = np.array([[200, 300], [1100, 330], [640, 420], [150, 650], [1150, 600], [600, 690], [900, 280], [420, 500.0]])


def places(rng: np.random.Generator) -> np.ndarray:
    return intersect_ground(CAMERA, PIXELS) + rng.normal(0, [0.1, 0.1, 0.0], (len(PIXELS), 3))


def camera_command(*arguments: str) -> tuple[str, ...]:
    return ("eval", "camera", "--points", *arguments, "--out", "c.json")


def test_a_site_file_is_calibrated_by_all_that_it_has(skope: Any) -> None:
    rng = np.random.default_rng(0)
    marks = PIXELS + rng.normal(0, 1.0, PIXELS.shape)
    ends = intersect_ground(CAMERA, np.array([[500.0, 600.0], [800.0, 450.0]]))
    rows = [
        f"  {{ pixel = {uv.tolist()}, place = {xyz.tolist()}, name = 'p{k}' }},"
        for k, (uv, xyz) in enumerate(zip(marks, places(rng), strict=True))
    ]
    Path("site.toml").write_text(
        "[calibration]\nsize = [1280, 720]\nwhen = 2026-11-25T10:00:00+01:00\npoints = [\n"
        + "\n".join(rows)
        + f"\n]\nlengths = [{{ pixels = [[500, 600], [800, 450]], metres = {np.linalg.norm(ends[1] - ends[0])} }}]\n"
        "fov_deg = [55, 3]\n[world]\norigin = { longitude = 13.4, latitude = 52.5 }\naxes = 'east, north'\n"
    )
    code, out, error = skope(*camera_command("site.toml"))
    assert code == 0
    document = json.loads(Path("c.json").read_text())
    assert document["calibrated"] == {
        "when": "2026-11-25T10:00:00+01:00",
        "from": "site.toml: 8 points, 1 length, field of view",
    }
    assert document["world"] == {"origin": {"longitude": 13.4, "latitude": 52.5}, "axes": "east, north"}
    assert "unknown" not in out + error
    known = read_uncertain_camera(Path("c.json"))
    assert known is not None
    assert known.parameters == ("focal", "k1", "x", "y", "z", "pitch", "roll", "yaw")
    at = np.array([[640.0, 600.0], [300.0, 400.0], [1000.0, 350.0]])
    error = np.linalg.norm((known.places(at) - intersect_ground(CAMERA, at))[:, :2], axis=1)
    assert (error < 2 * known.place_error(at)).all()
    row = document["marked_points"][0]
    assert set(row["left_out"]) == {"error_m", "stated_m"}
    assert "position errors on the road (90%)" in out
    assert "length 1: " in out
    # The same again leaves the file as it is.
    assert skope(*camera_command("site.toml"))[0] == 0


def test_reference_points_make_a_camera_near_its_own_origin(skope: Any) -> None:
    rng = np.random.default_rng(1)
    origin = np.array([850000.0, 5500000.0])
    rows = {
        str(k): {
            "x_px": round(uv[0]),
            "y_px": round(uv[1]),
            "hemisphere": "N",
            "zone_utm": 31,
            "lon_utm": round(origin[0] + xyz[0], 2),
            "lat_utm": round(origin[1] + xyz[1], 2),
        }
        for k, (uv, xyz) in enumerate(zip(PIXELS, places(rng), strict=True))
    }
    Path("a.otrfpts").write_text(json.dumps(rows))
    os.utime("a.otrfpts", (1_800_000_000, 1_800_000_000))
    code, out, _ = skope(*camera_command("a.otrfpts", "--size", "1280x720"))
    assert code == 0
    document = json.loads(Path("c.json").read_text())
    assert document["world"]["utm_zone"] == "31N"
    assert document["calibrated"] == {"when": "2027-01-15T08:00:00+00:00", "from": "a.otrfpts: 8 points"}
    known = read_uncertain_camera(Path("c.json"))
    assert known is not None
    shift = origin - [document["world"]["origin"]["easting"], document["world"]["origin"]["northing"]]
    at = np.array([[640.0, 600.0], [1000.0, 400.0]])
    error = np.linalg.norm(known.places(at)[:, :2] - intersect_ground(CAMERA, at)[:, :2] - shift, axis=1)
    assert (error < 2 * known.place_error(at)).all()
    assert "warning: UTM zone 31N" in out


def test_a_wrong_point_is_named_in_what_is_said_and_written(skope: Any) -> None:
    rng = np.random.default_rng(2)
    world = places(rng)
    world[2] += [4.0, -3.0, 0.0]
    lines = [",".join(map(str, (*uv, *xyz))) for uv, xyz in zip(PIXELS, world, strict=True)]
    Path("p.csv").write_text("column,row,x,y,z\n" + "\n".join(lines) + "\n")
    code, out, _ = skope(*camera_command("p.csv", "--size", "1280x720"))
    assert code == 0
    document = json.loads(Path("c.json").read_text())
    assert document["outliers"] == ["3"]
    assert document["marked_points"][2]["outlier"] is True
    assert document["marked_points"][2]["left_out"]["error_m"] == pytest.approx(5.0, abs=0.6)
    assert next(line for line in out.splitlines() if line.endswith("wrong?")).startswith("point 3: ")


@pytest.mark.parametrize(
    ("name", "text", "size", "said"),
    [
        (
            "s.toml",
            "[calibration]\npoints = [{ pixel = [1] }]\n",
            [],
            "s.toml: calibration.points[1].pixel: expected column and row",
        ),
        ("s.toml", "time_zone = 'UTC'\n", [], "s.toml: calibration: missing"),
        ("s.toml", "[calibration]\nheight_m = [5, 0.1]\n", [], "s.toml: calibration.size: missing"),
        ("s.toml", "[calibration]\nsize = [640, 480]\n", [], "s.toml: calibration: the scale is unknown"),
        (
            "s.toml",
            "[calibration]\nsize = [640, 480]\n",
            ["--size", "1280x720"],
            "size: marks are in 640x480",
        ),
        ("a.otrfpts", "{}", [], "--size: needed"),
        ("a.otrfpts", "{}", ["--size", "0x5"], "--size: expected WIDTHxHEIGHT"),
        ("a.otrfpts", "{}", ["--size", "12²x5"], "--size: expected WIDTHxHEIGHT"),
        ("a.otrfpts", "{}", ["--size", "640x480"], "a.otrfpts: expected a JSON object of points"),
    ],
)
def test_what_is_wrong_is_one_line(skope: Any, name: str, text: str, size: list[str], said: str) -> None:
    Path(name).write_text(text)
    code, _, err = skope(*camera_command(name, *size))
    assert code == 2
    assert said in err
    assert len(err.splitlines()) == 1
    assert not Path("c.json").exists()
