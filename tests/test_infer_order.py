"""What the script proposes for keypoints whose order was shuffled: most names, and no wrong one."""

import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from skope import keypoints
from skope.boxes import xyxy_to_xywh
from skope.camera.model import Camera
from skope.dataset import coco
from skope.errors import UserError
from skope.files.json_files import read_json, write_json
from skope.gen.formats.skope3d import ARCHIVE_CORNERS
from skope.gen.formats.skope3d_scenes import ArchiveVehicle
from skope.gen.vehicles.fleet import fleet
from skope.keypoints import PUBLISHED, SKOPE3D, K
from skope.schema import Annotation, AnnotationFile, Box3D, Image
from tests.samples import load_script

SCRIPT = Path(__file__).parents[1] / "scripts" / "infer_order.py"
CAMERA = Camera.looking([0, 0, 7.0], yaw=0, pitch_down=0.3, size=(320, 180))
ORDER = np.array([*range(4), *np.random.default_rng(5).permutation(np.arange(4, 32)), 32])
"""The shuffled files' keypoint i is our keypoint `ORDER[i]`."""


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_script("infer_order")


@pytest.fixture(scope="module")
def annotations() -> list[Annotation]:
    """Vehicles of the whole fleet in turn, at random places before the camera; points on the far side are hidden."""
    rng = np.random.default_rng(1)
    entries = list(fleet(further=False).values())
    out: list[Annotation] = []
    while len(out) < 240:
        vehicle = entries[len(out) % len(entries)].vehicle
        size, yaw = np.array(vehicle.size_lwh), rng.uniform(-np.pi, np.pi)
        R = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        at = np.array([rng.uniform(14, 30), rng.uniform(-9, 9), 0.0])
        world = vehicle.points @ R.T + at
        box = Box3D(center=at + [0, 0, size[2] / 2], size_lwh=size, yaw=yaw, R=R)
        pixels, _, valid = CAMERA.project(world)
        corners, _, in_front = CAMERA.project(ARCHIVE_CORNERS * size @ R.T + box.center)
        if not (valid.all() and in_front.all() and (corners > 1).all() and (corners < [319, 179]).all()):
            continue
        outward = (vehicle.points - [0, 0, size[2] / 2]) @ R.T
        facing = (outward * (CAMERA.position - world)).sum(axis=1) > 0
        low, high = corners.min(axis=0), corners.max(axis=0)
        number = len(out) + 1
        out.append(
            Annotation(
                id=number,
                image_id=1 + len(out) // 4,
                bbox=xyxy_to_xywh(np.concatenate([low, high])),
                keypoints=np.column_stack([pixels, 1.0 + facing])[ORDER],
                area=float((high - low).prod()),
                track_id=number,
                model="model",
                box_3d=box,
            )
        )
    return out


@pytest.fixture(scope="module")
def vehicles(annotations: list[Annotation]) -> list[ArchiveVehicle]:
    """As the files have them."""
    out = []
    for a in annotations:
        assert a.box_3d is not None
        corners, _, _ = CAMERA.project(ARCHIVE_CORNERS * a.box_3d.size_lwh @ a.box_3d.R.T + a.box_3d.center)
        points = np.column_stack([a.keypoints[:, :2], a.keypoints[:, 2] == 2])
        out.append(ArchiveVehicle(a.bbox, points.round(2), a.id, "model", corners.round(2)))
    return out


def wrong(table: dict[int, int]) -> list[int]:
    return [k for k, name in table.items() if ORDER[k] != name]


def proposals(script: ModuleType, vehicles: list[ArchiveVehicle], margin: float = 0.05) -> tuple[dict[int, int], str]:
    ours = script.fleet_places()
    found, order = script.places(vehicles)
    rows = script.propose(script.turned(found, ours), ours, margin)
    return {k: name for k, name, _, _ in rows if name is not None}, order


def test_our_export_with_shuffled_keypoints(skope: Any, annotations: list[Annotation]) -> None:
    images = tuple(
        Image(id=i, file_name=f"images/s/00_{i}.png", width=320, height=180, site="s", frame_index=i, camera=CAMERA)
        for i in range(1, 61)
    )
    coco.write(Path("ours/annotations/train.json"), AnnotationFile(images=images, annotations=tuple(annotations)))
    write_json(Path("ours/dataset.json"), {"version": 1, **keypoints.SKOPE33.fields()})
    Path("ours/images/s").mkdir(parents=True)
    for image in images:
        cv2.imwrite(f"ours/{image.file_name}", np.full((180, 320, 3), 90, np.uint8))
    assert skope("gen", "convert", "ours", "zips", "--to", "skope3d", "-q")[0] == 0
    run = [sys.executable, str(SCRIPT), "zips", "--out", "map.json"]
    done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    table = {
        PUBLISHED.names.index(theirs): keypoints.INDEX[ours] for theirs, ours in read_json(Path("map.json")).items()
    }
    assert len(table) >= 22
    assert wrong(table) == []
    assert not table.keys() & SKOPE3D.keys()
    assert f"{len(table)} of 28 keypoints" in done.stdout
    assert done.stdout.count("unmapped  ") == 28 - len(table)
    # The import takes the map as it is.
    assert skope("gen", "convert", "zips", "back", "--from", "skope3d", "--map", "map.json", "-q")[0] == 0
    (back,) = (a for a in coco.read(Path("back/annotations/train.json")).annotations if a.track_id == 7)
    for k, name in {**table, **SKOPE3D}.items():
        assert np.abs(back.keypoints[name, :2] - annotations[6].keypoints[k, :2]).max() < 0.011
    assert int((back.keypoints[:, 2] > 0).sum()) == len(table) + len(SKOPE3D)


@pytest.mark.parametrize(
    ("count", "order"),
    [
        (lambda c: c, "nested"),
        (lambda c: c[:, [3, 7, 1, 5, 2, 6, 0, 4]], "nested"),
        # Around the bottom from its front left corner, then around the top.
        (lambda c: c[:, [6, 2, 0, 4, 7, 3, 1, 5]], "in rings"),
    ],
)
def test_corners_may_be_counted_otherwise(
    script: ModuleType, vehicles: list[ArchiveVehicle], count: Any, order: str
) -> None:
    corners = count(np.stack([v.corners for v in vehicles]))
    recounted = [ArchiveVehicle(v.box_xyxy, v.points, 0, "", c) for v, c in zip(vehicles, corners, strict=True)]
    table, said = proposals(script, recounted)
    assert (said, wrong(table), len(table) >= 22) == (order, [], True)


def test_the_margin_decides(script: ModuleType, vehicles: list[ArchiveVehicle]) -> None:
    counts = [len(proposals(script, vehicles, margin)[0]) for margin in (0.0, 0.1, 0.3, 5.0)]
    assert counts[0] == 28
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == 0


@pytest.mark.parametrize(("astray", "within"), [(0.0, 1e-6), (0.1, 0.1)])
def test_places_in_the_cube_are_those_of_the_points(script: ModuleType, astray: float, within: float) -> None:
    """One rigid body seen from many sides: its points are found where they are, also where some are put badly."""
    rng = np.random.default_rng(3)
    body = rng.uniform(-1, 1, (K, 3))
    half = np.array([2.2, 0.9, 0.8])
    out = []
    for yaw in np.linspace(0, 6, 40):
        R = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
        at = [rng.uniform(14, 24), rng.uniform(-6, 6), 0.8]
        points, _, _ = CAMERA.project(body * half @ R.T + at)
        corners, _, _ = CAMERA.project(ARCHIVE_CORNERS * 2 * half @ R.T + at)
        seen = np.column_stack([points, np.ones(K)])
        seen[rng.random(K) < astray] += [9, -7, 0]
        out.append(ArchiveVehicle(np.zeros(4), seen, 0, "", corners))
    found, _ = script.places(out)
    assert np.abs(found - body).max() < within
    for vehicle in out:
        vehicle.points[5, 2] = 0
    assert np.isnan(script.places(out)[0][5]).all()


def test_corners_in_no_order_are_told(script: ModuleType, vehicles: list[ArchiveVehicle]) -> None:
    rng = np.random.default_rng(2)
    jumbled = [ArchiveVehicle(v.box_xyxy, v.points, 0, "", rng.permutation(v.corners)) for v in vehicles]
    with pytest.raises(UserError, match="not in a known order"):
        script.places(jumbled)


def test_a_margin_below_zero_is_told(
    script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["infer_order.py", "scene_1.zip", "--margin", "-1"])
    with pytest.raises(SystemExit) as ended:
        script.main()
    assert ended.value.code == 2
    assert capsys.readouterr().err == "infer_order: --margin: expected 0 or more metres, got -1.0\n"
