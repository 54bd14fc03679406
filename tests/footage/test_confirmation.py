"""Which detections of a video its frames confirm, on made-up traffic whose truth is known."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.dataset import coco
from skope.detector.predictor import Predictor
from skope.footage.confirmation import Confirmation, ExpectedSizes
from skope.schema import Result
from tests.eval.cli.test_footage import numbered_video

Box = tuple[float, float, float, float]


def result(box: Box, score: float = 0.95) -> Result:
    return Result(image_id=1, bbox=np.array(box), score=score, keypoints=np.zeros((33, 3)))


def confirmed(frames: Sequence[Sequence[Result]], fps: float = 10.0, score: float = 0.5) -> list[list[bool]]:
    confirmation = Confirmation(score)
    for i, found in enumerate(frames):
        confirmation.add(i / fps, found)
    return [[number >= 0 for number in numbers.tolist()] for numbers in confirmation.confirmed()]


def driving(lane: int, frame: int, *, begin: int = 0, pace: float = 12.0) -> Box:
    """A car that comes nearer along a lane: its size grows with its row, as on a plane seen by a camera."""
    bottom = 120 + 25 * lane + pace * (frame - begin)
    size = 0.25 * (bottom - 60)
    return (200.0 * lane + 0.3 * bottom, bottom - size, size, size)


def traffic(frames: int = 30) -> list[list[Result]]:
    return [[result(driving(lane, i, begin=3 * lane)) for lane in range(6) if i >= 3 * lane] for i in range(frames)]


def test_what_every_frame_shows_stays() -> None:
    assert all(all(frame) for frame in confirmed(traffic()))
    assert confirmed([]) == []
    assert confirmed([[], []]) == [[], []]


@pytest.mark.parametrize("often", [1, 2])
def test_what_shows_up_once_or_twice_is_left_out(often: int) -> None:
    frames = traffic()
    for i in range(often):
        frames[10 + i].append(result((900.0, 300.0, 60.0, 60.0), 0.99))
    kept = confirmed(frames)
    assert [sum(frame) for frame in kept] == [len(found) for found in traffic()]
    assert not any(kept[10 + i][-1] for i in range(often))


def test_frames_that_the_detector_has_not_seen_confirm_nothing() -> None:
    """With key frames each half second a phantom of one of them is interpolated around it, a vehicle is seen twice."""

    def kept(key_frames: Sequence[int]) -> list[bool]:
        confirmation = Confirmation(0.5, every=5)
        for i in range(11):
            here = replace(result(driving(2, i)), interpolated=i not in key_frames)
            confirmation.add(i / 10, [here])
        return [frame[0] >= 0 for frame in confirmation.confirmed()]

    assert kept([0, 5, 10]) == [True] * 11
    assert kept([0, 5]) == [True] * 11
    assert kept([5]) == [False] * 11


def test_weak_detections_stay_where_the_vehicle_is_else_sure() -> None:
    frames = [[result(driving(0, i), 0.3 if i in (9, 14) else 0.9)] for i in range(20)]
    assert all(kept == [True] for kept in confirmed(frames))
    frames = [[result(driving(0, i), 0.9 if i % 4 == 0 else 0.3)] for i in range(20)]
    assert [kept for (kept,) in confirmed(frames)] == [i % 4 == 0 for i in range(20)]
    assert not any(kept for (kept,) in confirmed([[result(driving(0, i), 0.3)] for i in range(20)]))


def test_a_vehicle_that_is_missed_for_some_frames_stays_one() -> None:
    frames = traffic()
    for i in (8, 9, 10, 15):
        frames[i] = []
    assert all(all(frame) for frame in confirmed(frames))


def test_one_that_comes_back_too_late_is_another_one() -> None:
    at = (300.0, 200.0, 50.0, 50.0)
    twice = [[result(at)] if i in (0, 1, 14, 15) else [] for i in range(20)]
    assert not any(any(frame) for frame in confirmed(twice, fps=10))
    assert all(all(frame) for frame in confirmed(twice, fps=20))


def test_what_stands_needs_the_size_of_a_vehicle() -> None:
    parked, sign = driving(2, 5), (700.0, 20.0, 45.0, 30.0)
    frames = [[*found, result(parked), result(sign)] for found in traffic()]
    for (*rest, car, poster), found in zip(confirmed(frames), frames, strict=True):
        assert all(rest)
        assert car
        assert not poster
        assert len(rest) == len(found) - 2


def test_without_traffic_all_that_stands_stays() -> None:
    frames = [[result(driving(2, 5)), result((700.0, 20.0, 45.0, 30.0))] for _ in range(20)]
    assert all(frame == [True, True] for frame in confirmed(frames))


def test_neighbours_in_a_queue_are_told_apart() -> None:
    rng = np.random.default_rng(0)
    queue = [(100.0 + 55 * k, 200.0, 50.0, 40.0) for k in range(8)]
    frames = [[result(tuple(np.array(box) + rng.normal(0, 1.5, 4))) for box in queue] for _ in range(25)]
    confirmation = Confirmation(0.5)
    for i, found in enumerate(frames):
        confirmation.add(i / 10, [found[k] for k in rng.permutation(len(found))])
    assert len(confirmation._vehicles) == len(queue)


def test_what_was_lost_takes_no_memory() -> None:
    rng = np.random.default_rng(1)
    confirmation = Confirmation(0.5)
    for i in range(600):
        confirmation.add(i / 10, [result((*rng.uniform(0, 1500, 2), 20.0, 20.0)) for _ in range(5)])
    assert len(confirmation._vehicles) < 100


def test_sizes_are_those_of_a_camera_over_a_plane() -> None:
    """A camera 6 m over a plane, tilted 20 degrees and rolled 4: vehicles 4 m in size, by projection."""
    pitch, roll, f = np.radians(20), np.radians(4), 900.0
    rng = np.random.default_rng(2)

    def seen(x: float, y: float, size_m: float) -> tuple[float, float, float]:
        depth = y * np.cos(pitch) + 6 * np.sin(pitch)
        u, v = f * x / depth, f * (6 * np.cos(pitch) - y * np.sin(pitch)) / depth
        cos, sin = np.cos(roll), np.sin(roll)
        return 640 + cos * u - sin * v, 360 + sin * u + cos * v, f * size_m / depth

    vehicles = [
        [seen(x + 0.1 * y, y, 4 * kind) for y in np.arange(10, 60, 4.0)]
        for x, kind in zip(rng.uniform(-8, 8, 12), rng.lognormal(0, 0.15, 12), strict=True)
    ]
    sizes = ExpectedSizes(vehicles)
    for x, y in rng.uniform((-10, 8), (10, 80), (200, 2)):
        assert sizes.allow(seen(x, y, 4.0))
        assert not sizes.allow(seen(x, y, 12.0))
        assert not sizes.allow(seen(x, y, 1.2))
    assert ExpectedSizes(vehicles[:3]).allow((0.0, 0.0, 1e6)), "three vehicles tell nothing"


# ------------------------------------------------------------------------------------------------------ the command


@pytest.fixture
def call(skope: Any, random_run: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """`skope eval predict` of a video of 20 frames with a car in it, and something else in the eighth frame alone."""

    def found(self: Predictor, batch: Any) -> Any:
        for image, _ in batch:
            once = [result((5.0, 5.0, 20.0, 20.0))] if image.frame_index == 8 else []
            weak = result(driving(0, image.frame_index), 0.3 if image.frame_index == 5 else 0.9)
            lowest = self._settings.min_score or 0.0
            yield image, [replace(one, image_id=image.id) for one in (weak, *once) if one.score > lowest]

    monkeypatch.setattr(Predictor, "_found", found)

    def run(*words: Any) -> list[int]:
        code, _, error = skope("eval", "predict", *words, "--checkpoint", random_run, "--device", "cpu", "-q")
        assert code == 0, error
        out = Path(words[words.index("--out") + 1])
        results = coco.read_results(out / "predictions.json")
        return [sum(r.image_id == image.id for r in results) for image in coco.read(out / "frames.json").images]

    return run


def test_frames_of_a_video_are_held_against_each_other(call: Any, tmp_path: Path) -> None:
    video = numbered_video(tmp_path / "v.mp4", 20)
    assert call(video, "--out", "seen", "--overlay", "--every-frame") == [1] * 20
    assert Path("seen/overlay.mp4").is_file()
    alone = [1] * 5 + [0, 1, 1, 2] + [1] * 11
    assert call(video, "--out", "all", "--unconfirmed", "--every-frame") == alone
    assert call(video, "--out", "sparse", "--every", 4) == [1, 1, 2, 1, 1], "0.4 s apart"
