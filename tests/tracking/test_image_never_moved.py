"""Tracks in the image: what never moved, and which boxes are of one vehicle."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skope.dataset import coco
from skope.dataset.folder import FRAMES_FILE, PREDICTIONS_FILE
from skope.schema import AnnotationFile, Result, RoadUserResult
from skope.tracking.image_trajectories import read_image_trajectories
from skope.tracks.track import is_in_traffic
from tests.sightings import drive

BICYCLE = 2


def seen_folder(folder: Path, of_vehicles: dict[int, np.ndarray], of_bicycles: dict[int, np.ndarray]) -> Path:
    """Write boxes (M, 4) by number, 10 frames a second, as `skope eval predict` does."""
    file = drive(5.0, 1.0, speeds=(0.0,))
    count = max(map(len, (*of_vehicles.values(), *of_bicycles.values())))
    images = tuple(replace(file.images[0], id=k + 1, time_s=k / 10, frame_index=k) for k in range(count))
    rows: list[Result | RoadUserResult] = []
    for k, image in enumerate(images):
        rows += [
            Result(image_id=image.id, score=0.9, bbox=own[k], keypoints=np.zeros((33, 3)), track_id=number)
            for number, own in of_vehicles.items()
            if k < len(own)
        ]
        rows += [
            RoadUserResult(image_id=image.id, score=0.9, bbox=own[k], category_id=BICYCLE, track_id=number)
            for number, own in of_bicycles.items()
            if k < len(own)
        ]
    folder.mkdir()
    bare = AnnotationFile(images=images, annotations=(), info={"source": "a.mp4"}, name="a.mp4", scheme=file.scheme)
    coco.write(folder / FRAMES_FILE, bare)
    coco.write_results(folder / PREDICTIONS_FILE, rows)
    return folder


def boxes(x: np.ndarray, y: float, width: float, height: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([x, np.full(len(x), y), np.full(len(x), width), np.full(len(x), height)]) + rng.normal(
        0, 0.5, (len(x), 4)
    )


@pytest.fixture(autouse=True)
def _in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_what_never_moves_is_not_in_traffic_whatever_its_category() -> None:
    still, waits = np.full(90, 100.0), 300 + 4.0 * np.maximum(0, np.arange(90) - 70)
    vehicles = {1: boxes(still, 100, 60, 40), 2: boxes(waits, 200, 60, 40)}
    bicycles = {1: boxes(still + 100, 100, 20, 30), 2: boxes(waits, 300, 20, 30)}
    tracks, *_ = read_image_trajectories(seen_folder(Path("seen"), vehicles, bicycles))
    assert sorted((one.category, int(one.position[0, 0]) > 250, is_in_traffic(one)) for one in tracks) == [
        ("bicycle", False, False), ("bicycle", True, True), ("vehicle", False, False), ("vehicle", True, True)
    ]  # fmt: skip


def test_a_car_that_passes_along_a_lorry_is_not_the_lorry() -> None:
    """Its box lies in that of the lorry for two seconds, and it is followed for longer."""
    at = np.arange(60)
    lorry = boxes(100 + 2.0 * at[:25], 100, 160, 140)
    car = boxes(90 + 6.0 * at, 190, 70, 50)
    tracks, *_ = read_image_trajectories(seen_folder(Path("passing"), {1: lorry, 2: car}, {}))
    assert len(tracks) == 2


def test_a_vehicle_that_is_seen_as_its_front_and_as_a_whole_is_one() -> None:
    at = np.arange(60)
    whole, front = boxes(100 + 4.0 * at, 100, 160, 140), boxes(180 + 4.0 * at, 150, 80, 88)
    tracks, *_ = read_image_trajectories(seen_folder(Path("twice"), {1: whole, 2: front}, {}))
    assert len(tracks) == 1
