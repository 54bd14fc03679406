"""`detector.video`: frames, detections and tracks of a video, the same as those of the commands."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import skope as door
from skope.camera.model import Camera
from skope.dataset import coco
from skope.detections import Detections
from skope.schema import AnnotationFile
from tests.sightings import drive
from tests.train.conftest import shrink

CAMERA = Camera.looking([3, -2, 7], yaw=0.4, pitch_down=0.26, size=(640, 360))
FRAMES, FPS = 30, 10
ROAD = drive(FRAMES / FPS, FPS, speeds=(4.0, 0.0), camera=CAMERA)
LEVELS = 8
"""By so much the frames' brightness rises from one to the next."""


def detections_of(road: AnnotationFile, frame: int, least: float) -> Detections:
    """What a perfect detector finds in a frame, and a ghost in one of them that only a careless one reports."""
    own = [a for a in road.annotations if a.image_id == frame + 1]
    corners = [[*a.bbox[:2], *(a.bbox[:2] + a.bbox[2:])] for a in own]
    points = [np.where([1, 1, 0.5], a.keypoints, 0) * [1, 1, 0.5] for a in own]
    scores = [0.95] * len(own)
    if frame == 10 and least < 0.8:
        corners, points, scores = [*corners, [5, 5, 90, 70]], [*points, np.zeros((33, 3))], [*scores, 0.8]
    return Detections(
        np.array(corners).reshape(-1, 4), np.array(scores), np.array(points).reshape(-1, 33, 3), (640, 360)
    )


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a video in which two sedans drive, its camera, and a site with a gate."""
    folder = tmp_path_factory.mktemp("seen")
    writer = cv2.VideoWriter(str(folder / "v.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), FPS, (640, 360))
    for i in range(FRAMES):
        writer.write(np.full((360, 640, 3), LEVELS * i, dtype=np.uint8))
    writer.release()
    (folder / "camera.json").write_text(json.dumps({"width": 640, "height": 360, **CAMERA.to_dict()}))
    mover = [a for a in ROAD.annotations if a.track_id == 1]
    middle = mover[len(mover) // 2]
    assert middle.velocity is not None
    assert middle.box_3d is not None
    across = np.array([middle.velocity[1], -middle.velocity[0]])
    ends = [(middle.box_3d.center[:2] + sign * across).tolist() for sign in (1, -1)]
    (folder / "site.toml").write_text(f'[[gates]]\nname = "gate"\nline = {ends}\n')
    return folder


@pytest.fixture(scope="module")
def detector(random_weights: Path) -> Iterator[door.Detector]:
    """A detector that sees everything, also in commands that are run meanwhile."""

    def detect(
        model: Any, images: Sequence[np.ndarray], device: Any, *, min_score: float, **_: Any
    ) -> list[Detections]:
        return [detections_of(ROAD, round(float(image.mean()) / LEVELS), min_score) for image in images]

    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        patch.setattr("skope.detector.predictor.detect", detect)
        patch.setattr("skope.detector.network_settings.FASTEST_BACKEND", "torch")
        yield door.load_detector(random_weights, device="cpu")


def test_frames_come_with_what_is_found_in_them(detector: door.Detector, seen: Path) -> None:
    frames = list(detector.video(seen / "v.mp4", every_frame=True))
    assert [frame.index for frame in frames] == list(range(FRAMES))
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(FRAMES) / FPS, atol=1e-6)
    assert {len(frame.detections) for frame in frames} == {2, 3}
    for i, frame in enumerate(frames):
        assert abs(float(frame.image.mean()) - LEVELS * i) < LEVELS
        assert frame.tracks == ()
    assert (frames[3].draw() != frames[3].image).any()
    assert {len(frame.detections) for frame in detector.video(seen / "v.mp4", every_frame=True, score=0.9)} == {2}


def test_between_key_frames_vehicles_are_followed(detector: door.Detector, seen: Path) -> None:
    frames = list(detector.video(seen / "v.mp4"))
    found = [frame.detections for frame in frames]
    assert [bool(one.interpolated.any()) for one in found] == [i % 5 > 0 and i < 29 for i in range(FRAMES)]
    assert {tuple(sorted(one.numbers.tolist())[:2]) for one in found} == {(1, 2)}
    part = list(detector.video(seen / "v.mp4", start_s=0.95, end_s=2.05, every=2))
    assert [frame.name for frame in part] == [f"v/{i:06d}" for i in range(10, 21, 2)]


@pytest.mark.parametrize("every_frame", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_tracks_are_those_of_the_commands(
    skope: Callable[..., Any], detector: door.Detector, seen: Path, random_weights: Path, every_frame: bool
) -> None:
    often = ["--every-frame"] * every_frame
    words = ["--camera", seen / "camera.json", "--checkpoint", random_weights, "--device", "cpu"]
    assert skope("eval", "predict", seen / "v.mp4", "--out", "out", *words, *often)[0] == 0
    assert skope("eval", "track", "out", "--out", "tracks")[0] == 0
    tracks = detector.video(seen / "v.mp4", camera=seen / "camera.json", every_frame=every_frame).tracks()
    tracks.to_csv("mine.csv")
    assert len(tracks) == 2
    assert Path("mine.csv").read_bytes() == Path("tracks/tracks.csv").read_bytes()
    command, mine = (door.measure_traffic(given, seen / "site.toml") for given in ("tracks", tracks))
    assert [(c.gate, c.class_name, c.direction, c.count) for c in mine.counts] == [
        (c.gate, c.class_name, c.direction, c.count) for c in command.counts
    ]
    assert max(c.count or 0 for c in door.count(tracks, seen / "site.toml")) == 1


def test_with_a_camera_frames_have_tracks_and_no_ghosts(detector: door.Detector, seen: Path) -> None:
    video = detector.video(seen / "v.mp4", camera=CAMERA, every_frame=True)
    frames = list(video)
    assert [len(frame.detections) for frame in frames] == [2] * FRAMES
    vehicles = [frame.tracks for frame in frames]
    assert {tuple(sorted(one.number for one in present)) for present in vehicles} == {(1, 2)}
    for present in vehicles[5:-5]:
        assert sorted(round(one.speed) for one in present) == [0, 4]
        for one in present:
            assert one.position.shape == one.size_lwh.shape == (3,)
            assert np.isfinite(one.box_xyxy).all()
    assert (frames[9].draw() != frames[9].image).any()
    again: Iterator[door.VideoFrame] = iter(video)
    assert next(again).index == 0


def test_a_camera_of_another_image_size_is_scaled_with_a_warning(detector: door.Detector, seen: Path) -> None:
    with pytest.warns(UserWarning, match="camera: camera of 1280x720, scaled to the 640x360 of v"):
        video = detector.video(seen / "v.mp4", camera=CAMERA.resized((1280, 720)), every_frame=True)
    assert sorted(round(one.speed) for one in list(video)[15].tracks) == [0, 4]
    with pytest.raises(
        door.UserError, match="camera: image size: expected the aspect ratio of v, 640x360, got 640x480"
    ):
        detector.video(seen / "v.mp4", camera=CAMERA.resized((640, 480)))


def test_the_camera_is_told_by_vehicles_or_not(detector: door.Detector, seen: Path) -> None:
    with pytest.raises(door.UserError, match="5 are needed"):
        detector.video(seen / "v.mp4").find_camera()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"score": 1.5}, r"score: expected a number from 0 to 1, got 1\.5"),
        ({"fps": 0}, r"fps: expected a number from 0\.001 to 1000, got 0"),
        ({"every": 0}, "every: expected a number from 1, got 0"),
        ({"end_s": 0.0}, "end_s: expected a time after start_s, 0, got 0"),
        ({"ground": "level"}, "ground: expected metres"),
        ({"camera": "none.json"}, "none.json"),
    ],
)
def test_what_is_wrong_is_said(detector: door.Detector, seen: Path, arguments: dict[str, Any], told: str) -> None:
    with pytest.raises(door.UserError, match=told):
        detector.video(seen / "v.mp4", **arguments)


def test_image_files_need_to_be_told_their_times(detector: door.Detector, tmp_path: Path) -> None:
    for i in range(0, FRAMES, 3):
        door.draw.write(tmp_path / f"{i}.png", np.full((360, 640, 3), LEVELS * i, dtype=np.uint8))
    with pytest.raises(door.UserError, match="carry no times"):
        detector.video(tmp_path, camera=CAMERA).tracks()
    video = detector.video(tmp_path, camera=CAMERA, fps=FPS / 3)
    assert sorted(round(float(np.median(track.speed))) for track in video.tracks()) == [0, 4]
    assert [frame.time_s for frame in video] == [k / (FPS / 3) for k in range(FRAMES // 3)]


def test_a_given_rate_replaces_the_times_of_a_video(detector: door.Detector, seen: Path) -> None:
    video = detector.video(seen / "v.mp4", fps=2 * FPS, every_frame=True)
    assert video.fps == pytest.approx(2 * FPS)
    assert [frame.time_s for frame in video] == pytest.approx([k / (2 * FPS) for k in range(FRAMES)])


def test_without_a_camera_there_are_no_tracks(detector: door.Detector, seen: Path) -> None:
    with pytest.raises(door.UserError, match=r"tracks need a camera: video\(source, camera=\.\.\.\)"):
        detector.video(seen / "v.mp4").tracks()
    with pytest.raises(door.UserError, match="no such file or folder"):
        detector.video("nothing.mp4")


def some(count: int = 4) -> Detections:
    rng = np.random.default_rng(0)
    corners = rng.uniform(0, 40, (count, 2))
    return Detections(
        np.concatenate([corners, corners + 20], axis=1),
        np.linspace(0.9, 0.3, count),
        rng.random((count, 33, 3)),
        (96, 64),
    )


def test_detections_are_chosen_as_arrays_are() -> None:
    found = replace(some(), numbers=np.arange(4), interpolated=np.zeros(4, dtype=bool))
    for chosen in (slice(1, 3), [1, 2], np.array([False, True, True, False]), [False, True, True, False]):
        part = found[chosen]
        np.testing.assert_array_equal(part.keypoints, found.keypoints[1:3])
        assert part.numbers.tolist() == [1, 2]
    assert len(found[-1]) == len(found[np.int64(2)]) == 1
    assert len(found[[]]) == len(found[found.scores > 2]) == 0
    assert [one.scores.tolist() for one in found] == [[score] for score in found.scores]
    assert found.above(0.4).scores.tolist() == found[found.scores > 0.4].scores.tolist()
    with pytest.raises(IndexError, match=r"expected \(4,\)"):
        found[[True, False]]
    with pytest.raises(IndexError):
        found[4]


def test_detections_are_drawn_and_saved(tmp_path: Path) -> None:
    found, image = some(), np.zeros((64, 96, 3), dtype=np.uint8)
    assert found.draw(image, scale=2).shape == (128, 192, 3)
    assert not image.any()
    with pytest.raises(ValueError, match=r"expected \(64, 96, 3\)"):
        found.draw(image[:10])
    found.save(tmp_path / "found.json", image_id=3)
    back = coco.read_results(tmp_path / "found.json")
    assert [one.image_id for one in back] == [3] * 4
    np.testing.assert_allclose(back[0].keypoints, found.keypoints[0], atol=0.01)
    with pytest.raises(door.UserError, match=r"found\.jpg: detections are saved as \.json"):
        found.save(tmp_path / "found.jpg")
