"""Which images are learnt from and validated on, and which vehicles are ignored."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from skope import coco
from skope.errors import UserError
from skope.schema import AnnotationFile
from skope.train import sources
from skope.train.sources import Source
from tests import samples


def read(root: Path, **options: Any) -> Source:
    return sources.read(root, **{"exclude_types": (), "val_fraction": 0.0, "max_images": None, **options})


def recordings(root: Path, frames: int, *, timed: bool = True) -> Path:
    """Two recordings, their frames interleaved and backwards in the file."""
    samples.make_dataset(root, images=1, splits=("train",))
    images = [
        replace(
            samples.make_image(2 * i + j + 1), recording=f"{j}", frame_index=15 * i, time_s=0.5 * i if timed else None
        )
        for i in reversed(range(frames))
        for j in range(2)
    ]
    vehicles = [samples.make_annotation(image.id, image.id, (10, 20, 60, 40)) for image in images]
    file = AnnotationFile(images=tuple(images), annotations=tuple(vehicles), name="train")
    coco.write(root / "annotations" / "train.json", file)
    return root


@pytest.mark.parametrize(("timed", "gap"), [(True, 1), (False, 1)])
def test_validation_is_the_last_part_of_each_recording_after_a_gap(tmp_path: Path, timed: bool, gap: int) -> None:
    source = read(recordings(tmp_path, 10, timed=timed), val_fraction=0.2)
    for recording in ("0", "1"):
        learnt = sorted(i.frame_index // 15 for i in source.learnt.images if i.recording == recording)
        validated = sorted(i.frame_index // 15 for i in source.validated.images if i.recording == recording)
        assert validated == [8, 9]
        assert learnt == list(range(8 - gap))
    assert {a.image_id for a in source.validated.annotations} == {i.id for i in source.validated.images}
    assert {a.image_id for a in source.learnt.annotations} == {i.id for i in source.learnt.images}
    everything = read(tmp_path)
    assert (len(everything.learnt.images), len(everything.validated.images)) == (20, 0)


def test_max_images_takes_images_with_vehicles_evenly_spread(tmp_path: Path) -> None:
    root = samples.make_dataset(tmp_path, images=10, splits=("train",))
    path = root / "annotations" / "train.json"
    file = coco.read(path)
    empty = tuple(a for a in file.annotations if a.image_id != 1)
    coco.write(path, replace(file, annotations=tuple(replace(a, iscrowd=int(a.image_id == 3)) for a in empty)))
    assert [image.id for image in read(root, max_images=4).learnt.images] == [2, 5, 7, 9]
    assert len(read(root, max_images=99).learnt.images) == 8
    assert len(read(root).learnt.images) == 10


def test_excluded_types_are_ignored_everywhere(tmp_path: Path) -> None:
    root = samples.make_dataset(tmp_path, images=4, splits=("train",))
    path = root / "annotations" / "train.json"
    file = coco.read(path)
    kinds = tuple(replace(a, vehicle_type="pickup" if a.id % 2 else "sedan") for a in file.annotations)
    coco.write(path, replace(file, annotations=kinds))
    source = read(root, exclude_types=("pickup",), val_fraction=0.25)
    for part in (source.learnt, source.validated):
        assert part.annotations
        assert all(a.ignored == (a.vehicle_type == "pickup") for a in part.annotations)
    vehicles = source.vehicles()[0]
    assert (len(vehicles.boxes_xyxy), len(vehicles.ignored_xyxy)) == (1, 1)
    with pytest.raises(UserError, match="nothing to train on"):
        read(root, exclude_types=("pickup", "sedan"))


def test_validation_of_several_datasets_is_numbered_anew(tmp_path: Path) -> None:
    parts = [read(samples.make_dataset(tmp_path / name, images=8), val_fraction=0.5) for name in "ab"]
    file, paths = sources.for_validation(parts, 5)
    assert [image.id for image in file.images] == [1, 2, 3, 4, 5]
    assert sorted(a.id for a in file.annotations) == list(range(1, 11))
    assert all(path.is_file() for path in paths)
    assert {path.relative_to(tmp_path).parts[0] for path in paths} == {"a", "b"}
    assert sources.for_validation([read(tmp_path / "a")], 5)[1] == []
