"""Numbers of a dataset, against ones counted by hand."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from skope import keypoints
from skope.cli import app
from skope.dataset import coco
from skope.dataset.folder import open_dataset
from skope.files.json_files import write_json
from skope.gen.inspect.stats import rows, split_stats
from skope.schema import AnnotationFile
from tests.samples import make_annotation, make_dataset, make_image


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Two images, grey 40 and 80, with two views of one vehicle, one of another, and an ignored one."""
    images = tuple(make_image(i, split="easy") for i in (1, 2))
    for image, level in zip(images, (40, 80), strict=True):
        path = tmp_path / image.file_name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.full((120, 160, 3), level, dtype=np.uint8))
    rows = (
        replace(make_annotation(1, 1, (0, 0, 40, 10), hidden=22), distance=10.0, occlusion=0.0, track_id=7),
        replace(make_annotation(2, 2, (0, 0, 40, 20), hidden=11), distance=20.0, occlusion=0.3, track_id=7),
        replace(make_annotation(3, 2, (50, 0, 40, 30), hidden=33, vehicle_type="bus"), distance=30.0, occlusion=0.0),
        replace(make_annotation(4, 2, (50, 50, 40, 50), iscrowd=1), distance=99.0, occlusion=0.9),
    )
    path = tmp_path / "annotations/easy.json"
    path.parent.mkdir()
    coco.write(path, AnnotationFile(images=images, annotations=rows, info={}, name="easy"))
    write_json(tmp_path / "dataset.json", {"version": 1, **keypoints.SKOPE33.fields()})
    return tmp_path


def test_numbers_are_those_counted_by_hand(dataset: Path) -> None:
    folder = open_dataset(dataset)
    found = split_stats(folder, folder.read("easy"))
    assert (found.images, found.sites, found.vehicles, found.ignored, found.tracks) == (2, 1, 3, 1, 2)
    assert found.per_image == 1.5
    assert found.distance_m == (15, 20, 25)
    assert found.box_height_px == (15, 20, 25)
    assert found.occluded == pytest.approx(0.1)
    assert found.crowded == pytest.approx(1 / 3)
    assert found.visible_points == pytest.approx((11 + 22 + 0) / 99)
    assert found.brightness == pytest.approx(60, abs=1)
    assert found.types == {"sedan": 2, "bus": 1}


def test_what_a_file_does_not_say_is_a_dash(tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "theirs", splits=("train",))
    path = root / "annotations" / "train.json"
    file = coco.read(path)
    images = tuple(replace(image, site=None) for image in file.images)
    vehicles = tuple(replace(vehicle, occlusion=None, distance=None) for vehicle in file.annotations)
    coco.write(path, replace(file, images=images, annotations=vehicles))
    said = dict(rows({"train": split_stats(open_dataset(root), coco.read(path))}))
    assert [said[name] for name in ("sites", "distance, m", "hidden share", "more than 10% hidden")] == [
        ["0"], ["-"], ["-"], ["-"]
    ]  # fmt: skip


def test_the_command_prints_a_column_for_each_split(dataset: Path) -> None:
    result = CliRunner().invoke(app, ["gen", "stats", str(dataset)])
    assert result.exit_code == 0, result.output
    lines = {line[:26].strip(): line[26:].split() for line in result.output.splitlines()}
    assert lines[""] == ["easy"]
    assert lines["vehicles per image"] == ["1.50"]
    assert lines["bus"] == ["1"]
