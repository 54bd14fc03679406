"""Which images are learnt from and validated on, and which vehicles are ignored."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from skope.dataset import coco
from skope.errors import UserError
from skope.schema import AnnotationFile
from skope.train import splits
from skope.train.splits import TrainingSource
from tests import samples


def read(root: Path, **options: Any) -> TrainingSource:
    return splits.read(root, **{"exclude_types": (), "val_fraction": 0.0, "max_images": None, **options})


def recordings(root: Path, frames: int, *, timed: bool = True, sites: int = 1, each: int = 1) -> Path:
    """Recordings of sites, their frames interleaved and backwards in the file; a vehicle drives by for five frames."""
    samples.make_dataset(root, images=1, splits=("train",))
    all_of_them = [(f"s{site}", f"{number:02d}") for site in range(sites) for number in range(each)]
    images, vehicles = [], []
    for i in reversed(range(frames)):
        for site, name in all_of_them:
            image = samples.make_image(len(images) + 1)
            time_s = 0.5 * i if timed else None
            images.append(replace(image, site=site, recording=name, frame_index=15 * i, time_s=time_s))
            vehicle = samples.make_annotation(image.id, image.id, (10, 20, 60, 40))
            vehicles.append(replace(vehicle, track_id=1 + i // 5))
    file = AnnotationFile(images=tuple(images), annotations=tuple(vehicles), name="train")
    coco.write(root / "annotations" / "train.json", file)
    return root


@pytest.mark.parametrize(("timed", "gap"), [(True, 1), (False, 1)])
def test_of_an_only_recording_the_last_part_is_validated_after_a_gap(tmp_path: Path, timed: bool, gap: int) -> None:
    source = read(recordings(tmp_path, 10, timed=timed, sites=2), val_fraction=0.2)
    for site in ("s0", "s1"):
        learnt = sorted(i.frame_index // 15 for i in source.learnt.images if i.site == site)
        validated = sorted(i.frame_index // 15 for i in source.validated.images if i.site == site)
        assert validated == [8, 9]
        assert learnt == list(range(8 - gap))
    assert {a.image_id for a in source.validated.annotations} == {i.id for i in source.validated.images}
    assert {a.image_id for a in source.learnt.annotations} == {i.id for i in source.learnt.images}
    everything = read(tmp_path)
    assert (len(everything.learnt.images), len(everything.validated.images)) == (20, 0)


@pytest.mark.parametrize(("sites", "each", "held"), [(1, 10, 1), (3, 10, 3), (7, 2, 1), (10, 2, 2), (2, 3, 1)])
def test_of_several_recordings_whole_ones_are_validated(tmp_path: Path, sites: int, each: int, held: int) -> None:
    source = read(recordings(tmp_path, 6, sites=sites, each=each), val_fraction=0.1)
    learnt, validated = (
        {(image.site, image.recording) for image in part.images} for part in (source.learnt, source.validated)
    )
    assert len(validated) == held
    assert not learnt & validated
    assert len(learnt) == sites * each - held
    assert len({site for site, _ in learnt}) == sites
    assert len(source.validated.images) == 6 * held
    assert not any(a.ignored for a in source.validated.annotations)


def test_vehicles_that_are_learnt_from_are_not_validated(tmp_path: Path) -> None:
    """Of an only recording, cut in the middle of a vehicle's way: it is in both parts, the next one is not."""
    source = read(recordings(tmp_path, 18), val_fraction=0.25)
    validated = {a.track_id: a.ignored for a in source.validated.annotations}
    assert validated == {3: True, 4: False}
    assert {a.track_id for a in source.learnt.annotations} == {1, 2, 3}
    assert not any(a.ignored for a in source.learnt.annotations)


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
    file, paths = splits.validation_images(parts, 5)
    assert [image.id for image in file.images] == [1, 2, 3, 4, 5]
    assert sorted(a.id for a in file.annotations) == list(range(1, 11))
    assert all(path.is_file() for path in paths)
    assert {path.relative_to(tmp_path).parts[0] for path in paths} == {"a", "b"}
    assert splits.validation_images([read(tmp_path / "a")], 5)[1] == []
