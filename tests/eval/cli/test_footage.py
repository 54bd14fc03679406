"""Footage in, vehicles in metres out: the commands `predict`, `pose`, `track` and `camera`."""

import csv
import itertools
import json
import math
import re
import struct
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import sumolib
from numpy.typing import NDArray

from skope.camera.fit import fit_camera
from skope.camera.fit.bundle_adjustment import VehicleViews
from skope.camera.ground_plane import Ground, intersect_ground
from skope.camera.model import Camera
from skope.camera.motion.camera_motion import turned_camera
from skope.camera.uncertain_camera import UncertainCamera
from skope.dataset import coco
from skope.dataset.camera_of_file import read_camera
from skope.dataset.folder import CHANGES_KEY
from skope.errors import UserError
from skope.files.json_files import write_json
from skope.files.progress import Progress
from skope.footage.overlays import blurred
from skope.pose import pose_footage
from skope.pose.keypoint_views import Scene, read_scene
from skope.pose.shape_model import fleet_shapes
from skope.schema import Annotation, AnnotationFile, Box3D, Result
from skope.traffic.observation import read_observation
from skope.video import live
from skope.video.footage import FOOTAGE_LIMITS, FrameRange, open_footage
from tests.footage import streams
from tests.pose.test_estimate_pose import drawn
from tests.sightings import CAMERA, drive, scene
from tests.waiting import HANG_S


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def numbered_video(path: Path, count: int, codec: str = "mp4v") -> Path:
    """A video whose frame i has brightness 8 i."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10, (96, 64))
    for i in range(count):
        writer.write(np.full((64, 96, 3), 8 * i, dtype=np.uint8))
    writer.release()
    return path


def with_pixel_width(video: bytes, width: int, height: int) -> bytes:
    """An mp4 file whose box `pasp` says how wide and high a pixel is to be shown."""
    out, begin, around = bytearray(video), 0, []
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"mp4v"):
        while out[begin + 4 : begin + 8] != name:
            begin += int.from_bytes(out[begin : begin + 4], "big")
        around.append(begin)
        begin += 16 if name == b"stsd" else 8
    end = around[-1] + int.from_bytes(out[around[-1] : around[-1] + 4], "big")
    out[end:end] = struct.pack(">I4sII", 16, b"pasp", width, height)
    for at in around:
        out[at : at + 4] = (int.from_bytes(out[at : at + 4], "big") + 16).to_bytes(4, "big")
    return bytes(out)


# -------------------------------------------------------------------------------------------------------------- footage


def test_frames_of_a_folder_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for i in (1, 2, 9, 10, 11, 100):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((8, 8, 3), i, np.uint8))
    (tmp_path / "._1.png").write_bytes(b"\0")
    for source in (tmp_path, tmp_path / "*.png"):
        seen = [int(pixels[0, 0, 0]) for _, pixels in open_footage(str(source)).frames()]
        assert seen == [1, 2, 9, 10, 11, 100]


def test_pixels_that_are_not_square_are_said_and_make_no_camera(skope: Any, random_run: Path, tmp_path: Path) -> None:
    square = numbered_video(tmp_path / "square.mp4", 4)
    wide = tmp_path / "wide.mp4"
    wide.write_bytes(with_pixel_width(square.read_bytes(), 16, 11))
    call = ("eval", "predict", "--checkpoint", random_run, "--min-size", 64)
    code, out, error = skope(*call, square, "--out", tmp_path / "a")
    assert (code, "as wide as high" in out + error) == (0, False)
    assert "pixel_width" not in json.loads((tmp_path / "a" / "frames.json").read_text())["info"]
    code, out, error = skope(*call, wide, "--out", tmp_path / "b")
    assert code == 0, error
    assert "wide: the video states that a pixel is 1.45 times as wide as high" in error
    assert json.loads((tmp_path / "b" / "frames.json").read_text())["info"]["pixel_width"] == 1.4545
    code, _, error = skope("eval", "camera", tmp_path / "b", "--out", tmp_path / "camera.json")
    assert code == 2
    assert "info.pixel_width: a pixel of the video is 1.4545 times as wide as high" in error


def test_a_cut_takes_the_frames_it_says(tmp_path: Path) -> None:
    footage = open_footage(str(numbered_video(tmp_path / "v.mp4", 30)), FrameRange(every=4, start_s=0.5, end_s=2.6))
    frames = list(footage.frames())
    assert [image.frame_index for image, _ in frames] == [5, 9, 13, 17, 21, 25]
    assert len(footage) == 6
    assert np.allclose([pixels.mean() / 8 for _, pixels in frames], [5, 9, 13, 17, 21, 25], atol=0.5)
    assert [image.time_s for image, _ in frames] == pytest.approx([0.5, 0.9, 1.3, 1.7, 2.1, 2.5])
    later = list(footage.frames(first=2))
    assert [(i.id, i.frame_index) for i, _ in later] == [(i.id, i.frame_index) for i, _ in frames[2:]]


def test_a_camera_on_the_network_is_read_until_it_hangs_up(
    skope: Any, random_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "LIVE_LIMITS", replace(live.LIVE_LIMITS, return_s=0.5))
    with streams.rtsp(numbered_video(tmp_path / "v.ts", 30), times=2) as address:  # it is looked at, then read
        begun = time.monotonic()
        code, _, err = skope("eval", "predict", address, "--checkpoint", random_run, "--every", 3, "--out", "p")
        lasted = time.monotonic() - begun
        assert code == 1
        assert "broke off after" in err
        assert re.search(r"\d+ frames received, \d+ analysed, \d+ passed over", err)
    with streams.rtsp(tmp_path / "v.ts") as address:
        assert skope("eval", "predict", address, "--checkpoint", random_run, "--overlay", "--out", "o")[0] == 2
    images = coco.read(Path("p/frames.json")).images
    assert images
    for image in images:
        assert image.frame_index is not None
        assert image.frame_index % 3 == 0
    times = [image.time_s or 0.0 for image in images]
    assert times == sorted(set(times))
    assert times[-1] < lasted  # sent faster than it was recorded: arrival counts


def test_a_slow_reader_of_a_live_stream_gets_the_newest_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "LIVE_LIMITS", replace(live.LIVE_LIMITS, return_s=0.5))
    with streams.mjpeg(24, 20, times=2) as address:
        footage = open_footage(address, FrameRange())
        assert footage.live
        taken = []
        for image, pixels in footage.frames():
            taken.append((image, pixels.mean() / 8))
            time.sleep(0.25)
    indices = [image.frame_index for image, _ in taken]
    assert 3 <= len(taken) <= 12
    assert indices == [round(brightness) for _, brightness in taken]
    assert indices[-1] == 23
    times = [image.time_s or 0.0 for image, _ in taken]
    assert times == sorted(set(times))


def test_a_stream_that_breaks_off_in_the_midst_of_a_frame_is_opened_again() -> None:
    with streams.mjpeg(6, 20, times=4) as address:
        begun = time.monotonic()
        footage = open_footage(address, FrameRange(end_s=0.7))
        images = [image for image, _ in footage.frames()]
        lasted = time.monotonic() - begun
    assert not footage.skipped  # three openings hold enough
    assert len(images) >= 7  # more than one opening holds
    times = [image.time_s or 0.0 for image in images]
    assert times == sorted(set(times))
    assert times[-1] < lasted


def test_times_are_those_of_the_frames_however_long_each_lasts(tmp_path: Path) -> None:
    path = numbered_video(tmp_path / "v.mp4", 30)
    shown = streams.vary(path, [1 + 7 * i % 5 for i in range(30)])
    whole = list(open_footage(str(path)).frames())
    assert [image.time_s for image, _ in whole] == pytest.approx(shown, abs=1e-3)
    assert np.allclose([pixels.mean() / 8 for _, pixels in whole], range(30), atol=0.5)
    for start, end, every in ((0.05, 3.0, 1), (4.0, 7.1, 3), (8.05, 100.0, 2)):
        footage = open_footage(str(path), FrameRange(start_s=start, end_s=end, every=every))
        wanted = [i for i, at in enumerate(shown) if start <= at < end][::every]
        frames = list(footage.frames())
        assert [image.frame_index for image, _ in frames] == wanted
        assert len(footage) == len(wanted)
        assert np.allclose([pixels.mean() / 8 for _, pixels in frames], wanted, atol=0.5)
        later = [(image.id, image.time_s) for image, _ in footage.frames(first=2)]
        assert later == [(image.id, image.time_s) for image, _ in frames[2:]]


@pytest.mark.parametrize("varied", [False, True])
def test_jumping_into_a_long_video_lands_on_the_frame_that_is_meant(
    varied: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = numbered_video(tmp_path / "v.mp4", 30)
    if varied:
        streams.vary(path, [1] * 15 + [9] * 15)
    monkeypatch.setattr("skope.video.footage.FOOTAGE_LIMITS", replace(FOOTAGE_LIMITS, seek_frames=3))
    for first in range(30):
        image, pixels = next(open_footage(str(path)).frames(first))
        assert image.frame_index == first
        assert pixels.mean() / 8 == pytest.approx(first, abs=0.5)


def test_a_truncated_video_names_the_frames_that_are_lost(tmp_path: Path) -> None:
    path = numbered_video(tmp_path / "v.avi", 30, "MJPG")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    footage = open_footage(str(path))
    got = len(list(footage.frames()))
    assert 3 <= got < 30
    assert any(re.search(rf"ends after \d+ of 30 frames|frame {got} of", line) for line in footage.skipped)


def test_a_live_stream_that_nobody_wants_any_more_is_left() -> None:
    before = set(threading.enumerate())
    with streams.mjpeg(1000, 50) as address:
        frames = open_footage(address, FrameRange(end_s=0.3)).frames()
        assert 1 <= len(list(frames)) < 30
    left = set(threading.enumerate()) - before
    for thread in left:
        thread.join(timeout=HANG_S)
    assert not any(thread.is_alive() for thread in left)


def test_images_of_every_kind_are_predicted_and_broken_ones_named(skope: Any, random_run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    rng = np.random.default_rng(0)
    shapes = {"portrait": (120, 40, 3), "tiny": (3, 5, 3), "grey": (50, 70), "wide": (20, 900, 3)}
    for name, shape in shapes.items():
        cv2.imwrite(str(folder / f"{name}.png"), rng.integers(0, 255, shape, dtype=np.uint8))
    cv2.imwrite(str(folder / "deep.png"), rng.integers(0, 65535, (50, 60, 3), dtype=np.uint16))
    (folder / "broken.jpg").write_bytes(b"\xff\xd8 no picture")
    code, _, err = skope(
        "eval", "predict", folder, "--checkpoint", random_run, "--out", "p", "--score", 0.2, "--overlay", "--strict"
    )
    assert code == 1
    assert "broken.jpg" in err
    images = coco.read(Path("p/frames.json")).images
    assert {i.file_name for i in images} == {f"{name}.png" for name in (*shapes, "deep")}
    results = coco.read_results(Path("p/predictions.json"))
    assert {r.image_id for r in results} <= {i.id for i in images}
    assert len(list(Path("p/overlays").iterdir())) == 5


def test_a_stopped_run_goes_on_and_ends_as_if_never_stopped(
    skope: Any, random_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stops_after: Any
) -> None:
    from skope.detector.predictor import Predictor

    def brightness(self: Predictor, batch: Any) -> Iterator[tuple[Any, list[Result]]]:
        """One result an image, by what its pixels are: a detector that takes no time."""
        for image, pixels in batch:
            box = np.array([0, 0, pixels.mean(), 9])
            yield image, [Result(image_id=image.id, score=0.9, bbox=box, keypoints=np.ones((33, 3)))]

    monkeypatch.setattr(Predictor, "_found", brightness)
    video = numbered_video(tmp_path / "v.mp4", 12)
    call = ("eval", "predict", video, "--checkpoint", random_run, "--every", 2, "--every-frame")
    assert skope(*call, "--out", "whole")[0] == 0
    with stops_after(3):
        assert skope(*call, "--out", "parts")[0] == 130
    assert not Path("parts/predictions.json").exists()
    code, out, _ = skope(*call, "--out", "parts")
    assert code == 0
    assert "resuming after frame 3" in out
    for name in ("predictions.json", "frames.json"):
        assert Path("parts", name).read_bytes() == Path("whole", name).read_bytes()
    assert {p.name for p in Path("parts").iterdir()} == {"predictions.json", "frames.json", "work.json"}


def test_stopped_at_any_frame_between_key_frames_it_ends_as_if_never_stopped(
    skope: Any, random_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from skope.detector.predictor import Predictor

    seen: list[int] = []

    def moving(self: Predictor, batch: Any) -> Iterator[tuple[Any, list[Result]]]:
        for image, _ in batch:
            seen.append(image.id)
            points = np.column_stack([10.0 + image.id + 20 * np.random.default_rng(0).random((33, 2)), np.ones(33)])
            box = np.array([10.0 + image.id, 10, 20, 20])
            yield image, [Result(image_id=image.id, score=0.9, bbox=box, keypoints=points)]

    monkeypatch.setattr(Predictor, "_found", moving)
    video = numbered_video(tmp_path / "v.mp4", 13)  # at 10 frames a second
    call = ("eval", "predict", video, "--checkpoint", random_run)
    assert skope(*call, "--out", "whole")[0] == 0
    assert seen == [1, 6, 11, 13]
    rows = json.loads(Path("whole/predictions.json").read_text())
    assert [row["image_id"] for row in rows] == list(range(1, 14))
    assert [row["image_id"] for row in rows if not row.get("interpolated")] == seen
    assert [row["bbox"][0] for row in rows] == pytest.approx([10.0 + row["image_id"] for row in rows], abs=0.02)
    add = Progress.add
    for count in (1, 3, 6, 8, 12):
        left = iter(range(count))

        def stops(self: Progress, row: Any, left: Any = left) -> None:
            if next(left, None) is None:
                raise KeyboardInterrupt
            add(self, row)

        with monkeypatch.context() as patch:
            patch.setattr(Progress, "add", stops)
            assert skope(*call, "--out", f"parts{count}")[0] == 130
        code, out, _ = skope(*call, "--out", f"parts{count}")
        assert code == 0
        assert f"resuming after frame {count}" in out
        for name in ("predictions.json", "frames.json"):
            assert Path(f"parts{count}", name).read_bytes() == Path("whole", name).read_bytes()


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        ("nothing.mp4", (), "nothing.mp4: no such file"),
        (".", (), "no images in it"),
        ("*.png", (), "matches no file"),
        ("text.txt", (), "text.txt: neither an image nor a video"),
        ("rtsp://127.0.0.1:9/no", (), "neither an image nor a video"),
        ("text.txt", ("--every", 0), "--every: expected a whole number from 1"),
        ("text.txt", ("--start", 5, "--end", 2), "--start, --end"),
    ],
)
def test_what_is_no_footage_gets_one_line(skope: Any, source: str, options: tuple[Any, ...], message: str) -> None:
    Path("text.txt").write_text("text")
    code, _, err = skope("eval", "predict", source, *options)
    assert code == 2
    assert message in err.splitlines()[-1]
    assert not Path("runs").exists()


def test_blur_levels_glass_and_plates_and_nothing_else() -> None:
    shown = drive(1, 5).annotations[0]
    found = Result(
        image_id=1, score=0.9, bbox=shown.bbox, keypoints=np.column_stack([shown.keypoints[:, :2], np.ones(33)])
    )
    noise = np.random.default_rng(0).integers(0, 255, (1080, 1920, 3), dtype=np.uint8)
    out = blurred(noise, [found])
    x, y, w, h = shown.bbox
    changed = (out != noise).any(axis=-1)
    ys, xs = np.nonzero(changed)
    assert changed.sum() > 0.05 * w * h
    assert out[changed].std() < 0.4 * noise.std()
    assert xs.min() >= x - 0.1 * w - 1
    assert xs.max() <= x + 1.1 * w + 1
    assert ys.min() >= y - 0.1 * h - 1
    assert ys.max() <= y + 1.1 * h + 1


# ---------------------------------------------------------------------------------------------------------- pose, track


def test_pose_writes_what_it_measures(skope: Any) -> None:
    file = drive(1, 5, speeds=(8.0, 0.0))
    coco.write(Path("road.json"), file)
    code, out, _ = skope("eval", "pose", "--annotations", "road.json", "--noise", "0,2", "--out", "p", "-q")
    assert code == 0
    assert "labels with 2 px of noise" in out
    rows = [json.loads(line) for line in Path("p/poses.jsonl").read_text().splitlines()]
    table = rows_of(Path("p/poses.csv"))
    assert len(rows) == len(table) == len(file.annotations)
    for row, cells, truth in zip(rows, table, file.annotations, strict=True):
        assert truth.box_3d is not None
        assert row["refused"] is None
        assert np.linalg.norm(np.array(row["position"][:2]) - truth.box_3d.center[:2]) < 0.15
        assert np.abs(np.mean(row["box_3d"], axis=0) - truth.box_3d.center).max() < 0.15
        assert float(cells["x"]) == row["position"][0]
        seen, _, _ = CAMERA.project(np.array(row["wheels"]))
        camera = np.array(row["wheels_camera"])
        assert np.allclose(seen, camera[:, :2] / camera[:, 2:] * CAMERA.K[0, 0] + CAMERA.K[:2, 2], atol=0.1)
    told = json.loads(Path("p/pose_errors.json").read_text())
    assert (
        told["labels with 0 px of noise"]["all"]["position"]["50"]
        < told["labels with 2 px of noise"]["all"]["position"]["50"]
    )
    assert told["labels with 0 px of noise"]["all"]["iou"] > 0.85


def tilted(file: AnnotationFile, T: Any) -> AnnotationFile:
    """The same scene in a world that `T` (4, 4) brings it to."""

    def turned(a: Annotation) -> Annotation:
        assert a.box_3d is not None
        R = T[:3, :3] @ a.box_3d.R
        center = T[:3, :3] @ a.box_3d.center + T[:3, 3]
        return replace(a, box_3d=replace(a.box_3d, center=center, R=R, yaw=math.atan2(R[1, 0], R[0, 0])))

    camera = replace(CAMERA, T_camera_world=CAMERA.T_camera_world @ np.linalg.inv(T))
    images = tuple(replace(image, camera=camera) for image in file.images)
    return replace(file, images=images, annotations=tuple(turned(a) for a in file.annotations))


def test_a_sloping_road_that_is_known_costs_nothing() -> None:
    ground = Ground(height=3.0, slope=(0.05, -0.03), about=(12.0, 4.0))
    T = ground.T_world_level
    assert T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3))
    for x, y in ((0, 0), (7, -2)):
        point = T[:3, :3] @ [x, y, 0] + T[:3, 3]
        assert point[2] == pytest.approx(3 + 0.05 * (point[0] - 12) - 0.03 * (point[1] - 4))
    file = drive(1, 5, speeds=(8.0, 0.0))
    level, sloping = Scene(file, None, None, Ground()), Scene(tilted(file, T), None, None, ground)
    a, b = pose_footage.measure_poses(level, noise=1), pose_footage.measure_poses(sloping, noise=1)
    assert b.position == pytest.approx(a.position, abs=2e-3)
    assert b.heading == pytest.approx(a.heading, abs=0.1)


@pytest.mark.parametrize(("asked", "height", "slope"), [("auto", -5.0, (0.0, 0.0)), ("fit", 2.0, (0.04, -0.03))])
def test_a_road_elsewhere_is_found_from_its_vehicles(
    skope: Any, asked: str, height: float, slope: tuple[float, float]
) -> None:
    T = Ground(height=height, slope=slope).T_world_level
    coco.write(Path("slope.json"), tilted(drive(2, 4, speeds=(9.0, 3.0, -6.0)), T))
    told = {}
    for ground in ("0", asked):
        call = ("eval", "pose", "--annotations", "slope.json", "--noise", 1, "--ground", ground, "--out", ground, "-q")
        code, out, err = skope(*call)
        assert code == 0, err
        assert ("contradict a level road" in out) == (ground == "auto")
        told[ground] = json.loads(Path(ground, "pose_errors.json").read_text())["labels with 1 px of noise"]["all"]
    assert told[asked]["position"]["90"] < 0.8
    assert told["0"]["refused"] > 10 or told["0"]["position"]["50"] > 2.0


def test_each_camera_of_a_file_has_a_road_of_its_own(skope: Any) -> None:
    """One over a level road, one over a road 5 m lower, one that shows a single vehicle on another one."""
    seen = (drive(2, 4, speeds=(9.0, 3.0, -6.0)), drive(3, 4, speeds=(9.0, 3.0, -6.0)), drive(4, 2, speeds=(5.0,)))
    heights = (0.0, -5.0, -4.0)
    parts = [tilted(file, Ground(height=z).T_world_level) for file, z in zip(seen, heights, strict=True)]
    coco.write(Path("three.json"), joined(parts))
    code, out, err = skope("eval", "pose", "--annotations", "three.json", "--noise", 1, "--out", "p", "-q")
    assert code == 0, err
    assert "of 1 of 3 cameras contradict a level road" in out
    assert f"{len(seen[2].images)} images of others have too few vehicles" in out
    rows = [json.loads(line) for line in Path("p/poses.jsonl").read_text().splitlines()]
    of_part = {image.id: k for k, file in enumerate(numbered(parts)) for image in file.images}
    for k, z in enumerate(heights):
        found = [row for row in rows if of_part[row["image_id"]] == k and not row["refused"]]
        assert found
        error = np.abs([row["position"][2] - z for row in found])
        if k < 2:
            assert error.max() < 0.5
        else:  # not told, and so not sure
            assert (error < 3 * np.array([row["sigma_position"][2] for row in found])).all()


def numbered(files: list[AnnotationFile]) -> list[AnnotationFile]:
    """The files with ids and names that differ."""
    out = []
    for k, file in enumerate(files):
        images = tuple(replace(i, id=i.id + 1000 * k, file_name=f"{k}_{i.file_name}") for i in file.images)
        vehicles = tuple(replace(a, id=a.id + 1000 * k, image_id=a.image_id + 1000 * k) for a in file.annotations)
        out.append(replace(file, images=images, annotations=vehicles))
    return out


def joined(files: list[AnnotationFile]) -> AnnotationFile:
    parts = numbered(files)
    images, vehicles = ([one for file in parts for one in getattr(file, name)] for name in ("images", "annotations"))
    return replace(parts[0], images=tuple(images), annotations=tuple(vehicles))


def test_a_level_road_stays_where_it_is_said_to_be(skope: Any) -> None:
    coco.write(Path("road.json"), drive(2, 5, speeds=(9.0, 3.0, -6.0)))
    call = ("eval", "pose", "--annotations", "road.json", "--noise", 2, "-q")
    for ground in ("0", "auto"):
        assert skope(*call, "--ground", ground, "--out", ground)[0] == 0
    assert Path("0/poses.jsonl").read_bytes() == Path("auto/poses.jsonl").read_bytes()


def test_overlap_of_boxes_is_what_can_be_worked_out() -> None:
    def box(x: float, yaw: float, length: float = 4.0) -> Box3D:
        c, s = math.cos(yaw), math.sin(yaw)
        R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        return Box3D(center=np.array([x, 0, 1]), size_lwh=np.array([length, 2, 2]), yaw=yaw, R=R)

    assert pose_footage.iou_3d(box(0, 0.3), box(0, 0.3)) == pytest.approx(1)
    assert pose_footage.iou_3d(box(0, 0), box(2, 0)) == pytest.approx(1 / 3)
    assert pose_footage.iou_3d(box(0, 0), box(0, math.pi / 2)) == pytest.approx(1 / 3)
    assert pose_footage.iou_3d(box(0, 0), box(9, 0)) == 0


def test_predictions_are_measured_against_the_vehicles_they_match(skope: Any) -> None:
    file = drive(1, 5, speeds=(8.0, 0.0))
    coco.write(Path("road.json"), file)
    found = [
        Result(
            image_id=a.image_id,
            bbox=a.bbox,
            score=0.9 - 0.01 * i,
            keypoints=np.column_stack([a.keypoints[:, :2], a.keypoints[:, 2] / 2]),
        )
        for i, a in enumerate(reversed(file.annotations))
    ]
    coco.write_results(Path("found.json"), found)
    skope("eval", "pose", "--annotations", "road.json", "--predictions", "found.json", "--out", "p", "-q")
    told = json.loads(Path("p/pose_errors.json").read_text())["predictions"]["all"]
    assert told["vehicles"] == len(found)
    assert told["position"]["99"] < 0.2
    code, out, _ = skope(
        "eval", "track", "--annotations", "road.json", "--predictions", "found.json", "--out", "t", "-q"
    )
    assert code == 0
    assert "speed: " in out


def test_tracks_have_the_speeds_that_were_driven(skope: Any) -> None:
    file = drive(3, 25, speeds=(12.0, 0.0, 6.0))
    coco.write(Path("road.json"), file)
    code, out, _ = skope("eval", "track", "--annotations", "road.json", "--noise", 1, "--out", "t", "--video", "-q")
    assert code == 0
    assert "3 tracks over 3.0 s" in out
    rows = rows_of(Path("t/tracks.csv"))
    for speed in (12.0, 0.0, 6.0):
        own = [r for r in rows if abs(float(r["speed"]) - speed) < 1.5]
        assert len({r["track"] for r in own}) == 1
        middle = [float(r["speed"]) for r in own]
        assert np.median(middle) == pytest.approx(speed, abs=0.4)
        turn = np.array([float(r["heading_deg"]) for r in own]) - math.degrees(CAMERA.angles[0]) - 90
        assert np.abs((turn + 180) % 360 - 180).max() < 5

    # SUMO's own reader; a vehicle's position there is the middle of its front bumper, its angle that of a compass.
    steps = list(sumolib.xml.parse("t/fcd.xml", "timestep"))
    assert [float(step.time) for step in steps[:3]] == [0, 0.04, 0.08]
    vehicle = steps[20].vehicle[0]
    row = next(r for r in rows if r["track"] == vehicle.id and r["frame"] == "20")
    angle = math.radians(float(vehicle.angle))
    back = np.array([float(vehicle.x), float(vehicle.y)]) - float(row["length"]) / 2 * np.array(
        [math.sin(angle), math.cos(angle)]
    )
    assert np.allclose(back, [float(row["x"]), float(row["y"])], atol=0.02)

    mot, truth = (np.loadtxt(f"t/{name}.txt", delimiter=",") for name in ("mot", "mot_truth"))
    # TrackEval reads the eighth column as a class; 1 is the only one that it measures.
    assert mot.shape[1] == 10
    assert (mot[:, 7:] == -1).all()
    assert truth.shape[1] == 9
    assert (truth[:, 6:] == 1).all()
    assert mot[:, 0].min() == 1
    pairs = {(a[1], b[1]) for a in mot for b in truth if a[0] == b[0] and np.allclose(a[2:6], b[2:6], atol=0.02)}
    assert len(pairs) == 3
    capture = cv2.VideoCapture("t/birdseye.mp4")
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 75
    assert ET.parse("t/fcd.xml").getroot().tag == "fcd-export"
    assert Path("t/birdseye.png").stat().st_size > 10_000


def test_a_vehicle_that_is_hidden_for_a_while_rolls_on(skope: Any) -> None:
    file = drive(4, 25, speeds=(8.0,))
    seen = tuple(a for a in file.annotations if not 40 <= a.image_id < 75)
    coco.write(Path("road.json"), replace(file, annotations=seen))
    code, _, _ = skope("eval", "track", "--annotations", "road.json", "--noise", 1, "--out", "t", "-q")
    assert code == 0
    rows = rows_of(Path("t/tracks.csv"))
    assert {r["track"] for r in rows} == {"1"}
    hidden = [float(r["speed"]) for r in rows if 40 <= int(r["frame"]) + 1 < 75]
    assert len(hidden) == 35
    assert hidden == pytest.approx([8.0] * 35, abs=0.6)
    assert {r["detected"] for r in rows if 40 <= int(r["frame"]) + 1 < 75} == {"0"}


def test_a_camera_file_of_another_image_size_is_scaled_or_rejected(skope: Any, random_run: Path) -> None:
    """By `predict` before anything is detected, by `pose` and `track` of images, each with one line."""
    numbered_video(Path("v.mp4"), 4)
    for name, size in (("double", (192, 128)), ("square", (96, 96))):
        camera = Camera.looking([0, 0, 6], yaw=0.4, pitch_down=0.3, size=size)
        write_json(Path(f"{name}.json"), {"width": size[0], "height": size[1], **camera.to_dict()})
    call = ("eval", "predict", "v.mp4", "--checkpoint", random_run, "--min-size", 64, "--out", "seen")
    code, _, err = skope(*call, "--camera", "square.json")
    assert (code, err.count("\n"), Path("seen").exists()) == (2, 1, False)
    assert "square.json: image size: expected the aspect ratio of v, 96x64, got 96x96" in err
    code, out, err = skope(*call, "--camera", "double.json")
    assert code == 0, err
    assert "double.json: camera of 192x128, scaled to the 96x64 of v" in out
    (own,) = {image.camera.width for image in coco.read(Path("seen/frames.json")).images if image.camera}
    assert own == 96
    file = drive(0.4, 5)
    coco.write(Path("road.json"), file)
    for name, camera in (("large", CAMERA.resized((3840, 2160))), ("wide", CAMERA.resized((1920, 800)))):
        write_json(Path(f"{name}.json"), {"width": camera.width, "height": camera.height, **camera.to_dict()})
    for command in ("pose", "track"):
        words = ("eval", command, "--annotations", "road.json", "--out", command)
        code, _, err = skope(*words, "--camera", "wide.json")
        assert (code, err.count("\n"), Path(command).exists()) == (2, 1, False)
        assert "wide.json: image size: expected the aspect ratio of " in err
        code, out, err = skope(*words, "--camera", "large.json")
        assert code == 0, err
        assert out.count("large.json: camera of 3840x2160, scaled to the ") == 1


def test_frames_say_what_could_not_be_read(skope: Any, random_run: Path) -> None:
    Path("images").mkdir()
    cv2.imwrite("images/a.png", np.zeros((64, 96, 3), np.uint8))
    Path("images/b.png").write_bytes(b"no picture")
    call = ("eval", "predict", "images", "--checkpoint", random_run, "--min-size", 64)
    for more, expected in (((), 0), (("--strict",), 1)):
        code, _, err = skope(*call, *more, "--out", f"seen{expected}")
        assert (code, "skope: skipped: images/b.png" in err) == (expected, True)
    Path("seen0").rename("seen")
    (line,) = coco.read(Path("seen/frames.json")).info["skipped"]
    assert line.startswith("images/b.png")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "give either the folder"),
        (("nowhere",), "nowhere: no such folder"),
        (("--annotations", "bare.json"), "has no camera; give one with --camera"),
        (("--annotations", "road.json", "--ground", "low"), "--ground: expected numbers"),
        (("--annotations", "road.json", "--camera", "k.json"), "k.json: "),
        (("--annotations", "road.json", "--score", 2), "--score: expected a number from 0 to 1"),
    ],
)
@pytest.mark.parametrize("command", ["pose", "track"])
def test_what_cannot_be_placed_gets_one_line(skope: Any, command: str, options: tuple[Any, ...], message: str) -> None:
    file = drive(0.4, 5)
    coco.write(Path("road.json"), file)
    bare = json.loads(Path("road.json").read_text())
    for image in bare["images"]:
        del image["camera"]
    write_json(Path("bare.json"), bare)
    write_json(Path("k.json"), {"T_camera_world": [1, 2], "width": 5, "height": 5, "K": [[1]]})
    code, _, err = skope("eval", command, *options, "-q")
    assert code == 2
    assert message in err
    assert len(err.splitlines()) == 1
    assert not Path("runs").exists()


# --------------------------------------------------------------------------------------------------------------- camera


def test_a_camera_is_found_from_vehicles() -> None:
    real = Camera.looking([0, 0, 8.5], yaw=0.3, pitch_down=math.radians(20), fov=math.radians(70))
    seen = scene(drawn(16, 3), np.random.default_rng(4), noise=1, far=35, camera=real)
    count = len(seen.found)
    fit = fit_camera.fit_camera_to_vehicles(
        VehicleViews(
            seen.found, np.ones(count), np.arange(count, dtype=np.intp), (real.width, real.height), fleet_shapes()
        )
    )
    focal = abs(fit.camera.K[0, 0] - real.K[0, 0])
    assert focal < max(0.05 * real.K[0, 0], 2 * fit.sigma_focal)
    assert focal < 0.1 * real.K[0, 0]
    assert abs(fit.camera.angles[1] - real.angles[1]) < math.radians(1)
    assert abs(fit.camera.position[2] - 8.5) < max(0.4, 2 * fit.sigma_height)


def test_a_camera_from_marked_points_is_written_and_read(skope: Any) -> None:
    ground = np.array([[10, -3, 0], [12, 5, 0], [20, -6, 0], [25, 8, 0], [35, 0, 0], [15, 1, 1.0]]) + [3, -2, 0]
    pixels, _, _ = CAMERA.project(ground)
    # As exactly as six digits are: what cameras at roads are like then says nothing.
    lines = [",".join(f"{v:.6f}" for v in (*uv, *xyz, *[1e-4] * 3)) for uv, xyz in zip(pixels, ground, strict=True)]
    Path("p.csv").write_text("column,row,x,y,z,sigma_px,sigma_m,sigma_z_m\n" + "\n".join(lines) + "\n")
    code, _, _ = skope("eval", "camera", "--points", "p.csv", "--size", "1920x1080", "--out", "c.json")
    assert code == 0
    camera, posed = read_camera(Path("c.json"))
    assert posed
    assert np.allclose(camera.T_camera_world, CAMERA.T_camera_world, atol=1e-3)
    assert camera.K[0, 0] == pytest.approx(CAMERA.K[0, 0], rel=1e-4)
    Path("p.csv").write_text("column,row,x,y\n1,2,3,4\n")
    code, _, err = skope("eval", "camera", "--points", "p.csv", "--size", "1920x1080")
    assert code == 2
    assert "p.csv: column z: missing" in err
    assert not Path("runs").exists()


def test_marked_points_that_are_off_are_named(skope: Any) -> None:
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(8, 40, 12), rng.uniform(-8, 8, 12), np.zeros(12)]) + [3, -2, 0]
    pixels, _, _ = CAMERA.project(ground)
    pixels[4] += [12, -9]
    lines = [",".join(f"{v:.6f}" for v in (*uv, *xyz)) for uv, xyz in zip(pixels, ground, strict=True)]
    Path("p.csv").write_text("column,row,x,y,z\n" + "\n".join(lines) + "\n")
    code, out, _ = skope("eval", "camera", "--points", "p.csv", "--size", "1920x1080", "--out", "c.json")
    assert code == 0
    told = [line for line in out.splitlines() if line.startswith("point ")]
    off = [float(line.rsplit(": ", 1)[1].split(" px")[0]) for line in told]
    assert len(told) == 12
    assert int(np.argmax(off)) == 4
    assert [line.endswith("; wrong?") for line in told].index(True) == 4
    assert sum(line.endswith("; wrong?") for line in told) == 1
    fitted, _ = read_camera(Path("c.json"))
    assert off == pytest.approx(np.linalg.norm(fitted.project(ground)[0] - pixels, axis=1), abs=0.006)


def test_a_camera_without_a_pose_is_its_own_world(skope: Any) -> None:
    """Then there is no ground, and positions are the camera's."""
    file = drive(0.4, 5)
    coco.write(Path("road.json"), file)
    storage = cv2.FileStorage("k.yml", cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", CAMERA.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    storage.write("image_width", CAMERA.width)
    storage.write("image_height", CAMERA.height)
    storage.release()
    code, _, _ = skope("eval", "pose", "--annotations", "road.json", "--camera", "k.yml", "--out", "p", "-q")
    assert code == 0
    rows = [json.loads(line) for line in Path("p/poses.jsonl").read_text().splitlines()]
    for row, truth in zip(rows, file.annotations, strict=True):
        assert truth.box_3d is not None
        assert row["position"] == row["position_camera"]
        real = CAMERA.to_camera(truth.box_3d.center - [0, 0, truth.box_3d.size_lwh[2] / 2])
        assert np.linalg.norm(np.array(row["position"]) - real) < 0.1 * np.linalg.norm(real)


def test_too_few_vehicles_are_no_camera(skope: Any) -> None:
    coco.write(Path("road.json"), drive(0.4, 5))
    code, _, err = skope("eval", "camera", "--annotations", "road.json")
    assert code == 2
    assert "road: 2 vehicles show 8 keypoints" in err
    assert "5 are needed" in err


def test_other_footage_is_refused_in_a_folder_of_its_own(skope: Any, random_run: Path, tmp_path: Path) -> None:
    video = numbered_video(tmp_path / "site.mp4", 3)
    call = ("eval", "predict", video, "--checkpoint", random_run, "--quiet")
    assert skope(*call, "--every", 2)[0] == 0
    out = Path("runs/predict/site")  # named after its source
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    code, _, err = skope(*call, "--every", 3)
    assert (code, err.count("\n")) == (2, 1)
    assert f"{out} holds the output of another run (every = 2, now 3)" in err
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert skope(*call, "--every", 2, "--overlay")[0] == 0  # the same work, with more to look at
    assert (out / "overlay.mp4").is_file()


def test_the_frames_themselves_say_what_footage_it_is(skope: Any, random_run: Path, tmp_path: Path) -> None:
    for folder, shade in (("a", 0), ("b", 90)):
        (tmp_path / folder / "imgs").mkdir(parents=True)
        cv2.imwrite(str(tmp_path / folder / "imgs" / "1.png"), np.full((48, 64, 3), shade, np.uint8))
    call = ("--checkpoint", random_run, "--out", tmp_path / "out", "--quiet")
    assert skope("eval", "predict", "a/imgs", *call)[0] == 0
    assert skope("eval", "predict", tmp_path / "a" / "imgs", *call)[0] == 0  # the same, named otherwise
    (tmp_path / "b" / "imgs").rename(tmp_path / "imgs")
    (tmp_path / "a" / "imgs").rename(tmp_path / "others")
    (tmp_path / "imgs").rename(tmp_path / "a" / "imgs")  # others under the same name
    code, _, err = skope("eval", "predict", "a/imgs", *call)
    assert (code, err.count("\n")) == (2, 1)
    assert "holds the output of another run (source = " in err


@pytest.mark.parametrize("left", [b"\xff\xfe garbage", b"123\n", b'{"image": {"id": 1}}\n', b'{"image"'])
def test_damaged_progress_is_begun_anew(left: bytes, skope: Any, random_run: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "1.png"), np.zeros((48, 64, 3), np.uint8))
    call = ("eval", "predict", tmp_path / "1.png", "--checkpoint", random_run, "--out", "out", "--quiet")
    assert skope(*call)[0] == 0
    before = Path("out/predictions.json").read_bytes()
    Path("out/.predict.jsonl").write_bytes(left)
    assert skope(*call)[0] == 0
    assert Path("out/predictions.json").read_bytes() == before
    assert not Path("out/.predict.jsonl").exists()


@pytest.mark.parametrize("away", [(500_000.0, 5_000_000.0, 0.0), (-33_000_000.0, 120.0, 800.0)])
def test_coordinates_may_be_of_any_size(skope: Any, away: tuple[float, float, float]) -> None:
    """UTM's eastings and northings, say: the same scene far from the origin gives the same, moved."""
    T = np.eye(4)
    T[:3, 3] = away
    near = drive(2, 5, speeds=(9.0, 3.0, -6.0))
    found = {}
    for name, file in (("near", near), ("far", tilted(near, T))):
        coco.write(Path(f"{name}.json"), file)
        ground = "0" if name == "near" else str(away[2])
        call = ("--annotations", f"{name}.json", "--noise", 1, "--ground", ground, "-q")
        for command in ("pose", "track"):
            code, _, error = skope("eval", command, *call, "--out", f"{name}_{command}")
            assert code == 0, error
        poses = [json.loads(line) for line in Path(f"{name}_pose/poses.jsonl").read_text().splitlines()]
        tracks = list(csv.DictReader(Path(f"{name}_track/tracks.csv").read_text().splitlines()))
        found[name] = (poses, tracks)
    for one, other in zip(found["near"][0], found["far"][0], strict=True):
        assert other["refused"] == one["refused"]
        assert other["position"] == pytest.approx(np.add(one["position"], away), abs=2e-3)
        assert other["position_camera"] == pytest.approx(one["position_camera"], abs=2e-3)
        assert other["heading_deg"] == pytest.approx(one["heading_deg"], abs=0.02)
        assert other["sigma_position"] == pytest.approx(one["sigma_position"], rel=1e-2)
    assert len(found["near"][1]) == len(found["far"][1]) > 20
    for one, other in zip(found["near"][1], found["far"][1], strict=True):
        for axis, shift in zip("xyz", away, strict=True):
            assert float(other[axis]) == pytest.approx(float(one[axis]) + shift, abs=3e-3)
        assert float(other["speed"]) == pytest.approx(float(one["speed"]), abs=3e-3)


def test_a_calibration_ends_where_the_camera_moves(skope: Any) -> None:
    """It is one of the view with which the footage begins, unless it says of which seconds it is."""
    file = drive(4, 5, speeds=(8.0, 3.0))
    changes = [{"time_s": 2.5, "cut": True, "shift": 0.0}]
    coco.write(Path("road.json"), replace(file, info={**file.info, CHANGES_KEY: changes}))
    code, out, error = skope("eval", "track", "--annotations", "road.json", "--noise", 1, "--out", "t")
    assert code == 0, error
    told = "road: the view changes (1 time): the camera's calibration holds from 0.0 s to 2.5 s; 7 other images have no"
    assert told in out
    assert "14 camera_moved" in out
    rows = list(csv.DictReader(Path("t/tracks.csv").read_text().splitlines()))
    measured = [float(row["time_s"]) for row in rows if row["located"] in ("1", "True", "true")]
    assert max(measured) == pytest.approx(2.4)
    footage = json.loads(Path("t/footage.json").read_text())
    assert max(footage["times_s"]) == pytest.approx(2.4)
    assert footage["moved_times_s"] == pytest.approx([image.time_s for image in file.images[-7:]])
    code, _, error = skope("eval", "pose", "--annotations", "road.json", "--noise", 1, "--out", "p")
    assert code == 0, error
    poses = [json.loads(line) for line in Path("p/poses.jsonl").read_text().splitlines()]
    assert {pose["refused"] for pose in poses if pose["time_s"] >= 2.5} == {"camera_moved"}
    assert all(pose["refused"] is None for pose in poses if pose["time_s"] < 2.5)
    later = {"source": None, "seconds": [2.6, 3.8]}
    camera = {"width": CAMERA.width, "height": CAMERA.height, **CAMERA.to_dict(), "calibrated": later}
    Path("later.json").write_text(json.dumps(camera))
    call = ("--annotations", "road.json", "--noise", 1, "--camera", "later.json", "--out", "l")
    code, out, error = skope("eval", "pose", *call)
    assert code == 0, error
    assert "holds from 2.5 s on; 13 other images" in out
    poses = [json.loads(line) for line in Path("l/poses.jsonl").read_text().splitlines()]
    assert {pose["refused"] for pose in poses if pose["time_s"] < 2.5} == {"camera_moved"}
    coco.write(Path("bad.json"), replace(file, info={**file.info, CHANGES_KEY: [{"cut": True}]}))
    code, _, error = skope("eval", "track", "--annotations", "bad.json", "--out", "u")
    assert (code, error.count("\n")) == (2, 1)
    assert error.startswith("skope: bad: info.view_changes: expected objects with time_s")


def turned_file(file: AnnotationFile, begin_s: float, after: Camera) -> AnnotationFile:
    """The labelled keypoints and boxes of images from a time on as a turned camera sees them."""

    def seen(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        rays, _ = CAMERA.rays(pixels)
        return after.project(rays @ CAMERA.T_camera_world[:3, :3] + CAMERA.position)[0]

    later = {image.id for image in file.images if image.time_s is not None and image.time_s >= begin_s}
    annotations = []
    for one in file.annotations:
        if one.image_id in later:
            points = one.keypoints.copy()
            points[:, :2] = np.where(points[:, 2:] > 0, seen(points[:, :2]), 0.0)
            low, high = (seen(corner) for corner in (one.bbox[:2], one.bbox[:2] + one.bbox[2:]))
            one = replace(one, keypoints=points, bbox=np.concatenate([low, high - low]))
        annotations.append(one)
    return replace(file, annotations=tuple(annotations))


def test_a_turned_camera_goes_on_to_give_metres(skope: Any) -> None:
    """Positions and speeds after a turn are those of a camera that was not turned, by the homography of both views."""
    file = drive(4, 5, speeds=(8.0, 3.0))
    after = turned_camera(CAMERA, 40.0, 8.0, 0.03)
    at = np.random.default_rng(0).uniform([0, 0], [CAMERA.width, CAMERA.height], (200, 2))
    rays, _ = CAMERA.rays(at)
    there = after.project(rays @ CAMERA.T_camera_world[:3, :3] + CAMERA.position)[0]
    matrix = cv2.findHomography(at, there, 0)[0]
    change = {"time_s": 1.8, "cut": False, "shift": 0.03}
    followed = {"settled_s": 2.1, "homography": matrix.tolist(), "residual_px": 0.1, "corner_error_px": 0.2}
    covariance = {"of": ["z"], "matrix": [[1e-4]]}
    camera = {"width": CAMERA.width, "height": CAMERA.height, **CAMERA.to_dict(), "covariance": covariance}
    Path("camera.json").write_text(json.dumps(camera))
    files = {
        "still": file,
        "turned": replace(turned_file(file, 2.0, after), info={**file.info, CHANGES_KEY: [change | followed]}),
        "lost": replace(turned_file(file, 2.0, after), info={**file.info, CHANGES_KEY: [change]}),
    }
    rows, watched = {}, {}
    for name, of_name in files.items():
        coco.write(Path(f"{name}.json"), of_name)
        call = ("--annotations", f"{name}.json", "--noise", 0.5, "--camera", "camera.json", "--out", name)
        code, out, error = skope("eval", "track", *call)
        assert code == 0, error
        assert ("from 2.1 s on the camera is turned (0.0" in out) == (name == "turned")
        rows[name] = {(row["track"], row["time_s"]): row for row in rows_of(Path(f"{name}/tracks.csv"))}
        watched[name] = read_observation(Path(name))
    assert watched["turned"].camera_moved_s == pytest.approx([1.8, 2.0])
    assert len(watched["turned"].spans) == 2
    assert watched["lost"].observed_s == pytest.approx(1.8)
    later = {key: row for key, row in rows["still"].items() if float(row["time_s"]) > 2.1}
    assert len(later) > 10
    places = {
        name: np.array([[float(rows[name][key][axis]) for axis in "xy"] for key in later])
        for name in ("still", "turned")
    }
    off = np.linalg.norm(places["turned"] - places["still"], axis=1)
    assert np.median(off) < 0.1
    assert off.max() < 0.4
    # The same footage with a calibration of its second view.
    part = {"source": file.info.get("source"), "seconds": [3.0, 3.5]}
    document = {**camera, **after.to_dict(), "calibrated": part}
    Path("after.json").write_text(json.dumps(document))
    call = ("--annotations", "turned.json", "--noise", 0.5, "--camera", "after.json", "--out", "second")
    code, out, error = skope("eval", "track", *call)
    assert (code, "from 1.8 s on; before that, the camera is turned (0.0" in out) == (0, True), out + error
    second = read_observation(Path("second"))
    assert second.camera is not None
    assert second.camera.T_camera_world == pytest.approx(CAMERA.T_camera_world, abs=1e-4)
    ((from_s, camera_after),) = second.turned
    assert (from_s, camera_after.T_camera_world) == (pytest.approx(2.2), pytest.approx(after.T_camera_world))
    ((from_s, camera_after),) = watched["turned"].turned
    assert from_s == pytest.approx(2.2)
    assert camera_after.T_camera_world == pytest.approx(after.T_camera_world, abs=1e-4)
    assert watched["lost"].turned == ()
    # What is at the image's right edge leaves it by the turn; what is in its middle does not.
    gates = ""
    for gate, column in (("edge", CAMERA.width - 20.0), ("middle", CAMERA.width / 2)):
        line = intersect_ground(CAMERA, np.array([[column, 0.6 * CAMERA.height], [column, 0.9 * CAMERA.height]]))[:, :2]
        gates += f'[[gates]]\nname = "{gate}"\nline = {line.tolist()}\n'
    Path("site.toml").write_text(gates)
    for name in files:
        code, out, error = skope("eval", "traffic", name, "--out", f"{name}_report")
        assert code == 0, error
        assert ("gate 'edge': the camera was turned, and from 2.2 s on 0% of the" in out) == (name == "turned")
        assert "gate 'middle': the camera was turned" not in out
    still, turned = watched["still"].uncertainty, watched["turned"].uncertainty
    assert still is not None
    assert turned is not None
    assert set(turned.parameters) > set(still.parameters)
    place = np.array([CAMERA.width / 2, 0.7 * CAMERA.height])
    assert float(turned.place_error(place)) > float(still.place_error(place))


def test_the_cameras_error_is_carried_once_beside_the_tracks(skope: Any) -> None:
    """All road users share it: no track's covariance holds it, and footage.json has it whole."""
    coco.write(Path("road.json"), drive(2, 5, speeds=(9.0, 3.0, -6.0)))
    camera = {"width": CAMERA.width, "height": CAMERA.height, **CAMERA.to_dict()}
    covariance = {"of": ["z", "pitch"], "matrix": [[0.09, 0.001], [0.001, 1e-4]]}
    for name, known in (("sure", {}), ("unsure", {"covariance": covariance})):
        Path(f"{name}.json").write_text(json.dumps({**camera, **known}))
        call = ("--annotations", "road.json", "--noise", 1, "--camera", f"{name}.json", "--ground", 0, "--out", name)
        code, out, error = skope("eval", "track", *call)
        assert code == 0, error
        assert ("all distances and speeds may be off by" in out) == (name == "unsure")
    assert Path("sure/tracks.csv").read_bytes() == Path("unsure/tracks.csv").read_bytes()
    sure, unsure = (read_observation(Path(name)) for name in ("sure", "unsure"))
    assert sure.uncertainty is None
    assert sure.common_scale_sigma is None
    assert unsure.uncertainty is not None
    assert unsure.uncertainty.covariance_dict() == covariance
    assert unsure.common_scale_sigma == pytest.approx(unsure.uncertainty.distance_sigma())
    for one in (sure, unsure):
        assert one.camera is not None
        assert one.camera.to_dict() == CAMERA.to_dict()
        assert one.ground == Ground()


def test_the_cameras_covariance_goes_on_to_poses_and_frames(skope: Any, random_run: Path, tmp_path: Path) -> None:
    """Places are as uncertain as the camera makes them: what the file says, by its own way of placing pixels."""
    coco.write(Path("road.json"), drive(0.4, 5))
    camera = {"width": CAMERA.width, "height": CAMERA.height, **CAMERA.to_dict()}
    covariance = {"of": ["pitch", "yaw"], "matrix": [[1e-4, 0.0], [0.0, 4e-4]]}
    told = {}
    for name, besides in (("sure", {}), ("unsure", {"covariance": covariance})):
        Path(f"{name}.json").write_text(json.dumps({**camera, **besides}))
        call = ("--annotations", "road.json", "--noise", 1, "--camera", f"{name}.json", "--ground", 0, "--out", name)
        code, out, error = skope("eval", "pose", *call)
        assert code == 0, error
        assert ("all distances and speeds may be off by" in out) == (name == "unsure")
        told[name] = [json.loads(line) for line in Path(f"{name}/poses.jsonl").read_text().splitlines()]
    known = UncertainCamera.from_dict(CAMERA, covariance)
    for one, other in zip(told["sure"], told["unsure"], strict=True):
        added = np.array(other["covariance"]) - np.array(one["covariance"])
        assert added[:2, :2] == pytest.approx(known.covariance_at(one["position"]), rel=0.02, abs=1e-4)
        assert added[2].tolist() == pytest.approx([0] * 4, abs=1e-9)
        # A turned camera turns all headings: 0.02 rad, and a little by the pitch.
        assert 4e-4 * 0.99 <= added[3, 3] < 8e-4
    video = numbered_video(tmp_path / "site.mp4", 2)
    small = Camera.looking([0, 0, 6], yaw=0, pitch_down=0.4, size=(96, 64))
    Path("k.json").write_text(json.dumps({"width": 96, "height": 64, **small.to_dict(), "covariance": covariance}))
    arguments = ("--checkpoint", random_run, "--camera", "k.json", "--out", "seen")
    code, _, error = skope("eval", "predict", video, *arguments)
    assert code == 0, error
    read = read_scene(Path("seen"), None, None, None, 0.0)
    assert read.known is not None
    assert read.known.covariance == pytest.approx(np.array(covariance["matrix"]))
    document = json.loads(Path("seen/frames.json").read_text())
    document["info"]["camera_covariance"] = {"of": ["depth"], "matrix": [[1]]}
    Path("seen/frames.json").write_text(json.dumps(document))
    with pytest.raises(UserError, match=r"frames: info.camera_covariance: "):
        read_scene(Path("seen"), None, None, None, 0.0)


def test_tracks_are_drawn_into_their_footage(skope: Any, random_run: Path, tmp_path: Path) -> None:
    video = numbered_video(tmp_path / "site.mp4", 6)
    camera = Camera.looking([0, 0, 6], yaw=0, pitch_down=0.4, size=(96, 64))
    Path("k.json").write_text(json.dumps({"width": 96, "height": 64, **camera.to_dict()}))
    code, out, error = skope(
        "eval", "predict", video, "--checkpoint", random_run, "--camera", "k.json", "--out", "seen"
    )
    assert code == 0, error
    assert re.search(r"^\d+ vehicles?.* in 6 images$", out, re.MULTILINE)
    code, _, error = skope("eval", "track", "seen", "--overlay", "--out", "t")
    assert code == 0, error
    capture = cv2.VideoCapture("t/overlay.mp4")
    assert capture.get(cv2.CAP_PROP_FRAME_COUNT) == 6
    coco.write(Path("road.json"), drive(1, 5, speeds=(8.0,)))
    code, _, error = skope("eval", "track", "--annotations", "road.json", "--overlay", "--out", "u")
    assert code == 2
    assert "does not name its footage" in error


@pytest.mark.parametrize(
    ("flag", "value", "expected"),
    [
        ("--height", "0.1", "a number from"),
        ("--fov", "190", "a number from"),
        ("--length", "10,20,30,40", "COLUMN,ROW,COLUMN,ROW,METRES"),
        ("--length", "10,20,30,nan,3", "COLUMN,ROW,COLUMN,ROW,METRES"),
        ("--length", "10,20,30,40,-3", "COLUMN,ROW,COLUMN,ROW,METRES with 0.1 to 1000 metres"),
    ],
)
def test_what_cannot_be_of_a_camera_is_refused(skope: Any, flag: str, value: str, expected: str) -> None:
    coco.write(Path("road.json"), drive(1, 5, speeds=(8.0,)))
    code, _, error = skope("eval", "camera", "--annotations", "road.json", flag, value)
    assert (code, error.count("\n")) == (2, 1)
    assert f"{flag}: expected {expected}" in error


def test_a_stopped_run_of_poses_goes_on_to_the_same_bytes(skope: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    coco.write(Path("road.json"), drive(1, 5, speeds=(8.0, 3.0)))
    call = ("eval", "pose", "--annotations", "road.json", "--noise", 1, "-q")
    assert skope(*call, "--out", "whole")[0] == 0
    real = pose_footage.locate_views

    def stops(views: Any, scene: Any) -> Any:
        yield from itertools.islice(real(views, scene), 2)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pose_footage, "locate_views", stops)
        assert skope(*call, "--out", "stopped")[0] != 0
    code, out, error = skope("eval", "pose", "--annotations", "road.json", "--noise", 1, "--out", "stopped")
    assert code == 0, error
    assert "resuming after the poses of 2 images" in out
    for name in ("poses.jsonl", "poses.csv", "pose_errors.json"):
        assert Path("stopped", name).read_bytes() == Path("whole", name).read_bytes()
