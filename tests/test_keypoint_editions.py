"""Two editions of where keypoints lie: files say which they hold, they are not mixed, poses use the right shapes."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope import keypoints
from skope.camera.model import Camera
from skope.dataset import coco
from skope.dataset.folder import open_dataset
from skope.detector import weights
from skope.detector.build import DetectorConfig
from skope.detector.checkpoint import read_checkpoint
from skope.errors import UserError
from skope.files.json_files import read_json, write_json
from skope.keypoints import SKOPE33, scheme_of
from skope.pose.estimate_pose import locate
from skope.pose.keypoint_views import read_scene
from skope.pose.shape_model import fleet_shapes
from skope.schema import AnnotationFile, Result
from tests import hostile
from tests.samples import make_annotation, make_dataset, make_image
from tests.sightings import CAMERA, scene

FIRST = scheme_of("skope33", 1)


def file_of(scheme: keypoints.Scheme) -> AnnotationFile:
    return AnnotationFile(
        images=(make_image(1),), annotations=(make_annotation(1, 1, (8, 12, 64, 44)),), name="some", scheme=scheme
    )


@pytest.mark.parametrize("scheme", [FIRST, SKOPE33])
def test_a_file_comes_back_with_its_edition(tmp_path: Path, scheme: keypoints.Scheme) -> None:
    coco.write(tmp_path / "some.json", file_of(scheme))
    assert coco.read(tmp_path / "some.json").scheme is scheme
    # What skope wrote before said nothing of editions.
    said = read_json(tmp_path / "some.json")["info"].get("keypoint_edition")
    assert said == (None if scheme is FIRST else 2)


def test_files_of_others_mark_what_people_see(tmp_path: Path) -> None:
    coco.write(tmp_path / "some.json", file_of(FIRST))
    document = read_json(tmp_path / "some.json")
    del document["info"]
    write_json(tmp_path / "some.json", document)
    assert coco.read(tmp_path / "some.json").scheme is SKOPE33


@pytest.mark.parametrize("scheme", [FIRST, SKOPE33])
def test_imports_keep_the_edition_that_a_file_states(skope: Any, tmp_path: Path, scheme: keypoints.Scheme) -> None:
    root = make_dataset(tmp_path / "ours", scheme=scheme)
    code, _, error = skope("gen", "convert", root, tmp_path / "cvat", "--to", "cvat", "-q")
    assert code == 0, error
    code, _, error = skope("gen", "convert", tmp_path / "cvat", tmp_path / "back", "--from", "cvat", "-q")
    assert code == 0, error
    assert open_dataset(tmp_path / "back").read("train").scheme is scheme
    # What a detector of that edition found, as labels to be corrected.
    seen = tmp_path / "seen"
    file = open_dataset(root).read("train")
    coco.write(seen / "frames.json", replace(file, annotations=()))
    coco.write_results(
        seen / "predictions.json",
        [
            Result(image_id=a.image_id, bbox=a.bbox, score=0.9, keypoints=a.keypoints / [1, 1, 2])
            for a in file.annotations
        ],
    )
    for image in file.images:
        (seen / image.file_name).parent.mkdir(parents=True, exist_ok=True)
        (seen / image.file_name).write_bytes((root / image.file_name).read_bytes())
    code, _, error = skope("gen", "convert", seen, tmp_path / "found", "--from", "coco", "-q")
    assert code == 0, error
    assert open_dataset(tmp_path / "found").read("train").scheme is scheme


def test_shards_of_an_earlier_dataset_become_a_folder_of_its_edition(
    skope: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("skope.gen.pipeline.workers.make_renderer", hostile.FlatRenderer)
    root = hostile.complete(tmp_path / "d")
    card = read_json(root / "dataset.json")
    del card["keypoint_edition"], card["parameters"]["keypoint_edition"]
    write_json(root / "dataset.json", card)
    for path in (root / "annotations").glob("*.json"):
        coco.write(path, replace(coco.read(path), scheme=FIRST))
    for source, target, form in (("d", "tars", "shards"), ("tars", "back", "folder")):
        code, _, error = skope("gen", "convert", tmp_path / source, tmp_path / target, "--to", form, "-q")
        assert code == 0, error
        dataset = open_dataset(tmp_path / target)
        assert {dataset.read(split).scheme for split in dataset.splits} == {FIRST}


def test_a_later_edition_is_refused(tmp_path: Path) -> None:
    coco.write(tmp_path / "some.json", file_of(SKOPE33))
    document = read_json(tmp_path / "some.json")
    document["info"]["keypoint_edition"] = 3
    write_json(tmp_path / "some.json", document)
    with pytest.raises(UserError, match=r"some\.json: info\.keypoint_edition: skope33 has no edition 3"):
        coco.read(tmp_path / "some.json")
    root = make_dataset(tmp_path / "data")
    write_json(root / "dataset.json", {**read_json(root / "dataset.json"), "keypoint_edition": "two"})
    with pytest.raises(UserError, match=r"dataset\.json: keypoint_edition: skope33 has no edition 'two'"):
        open_dataset(root)


def test_editions_are_not_mixed(skope: Any, tmp_path: Path) -> None:
    for name, scheme, seed in (("old", FIRST, 0), ("new", SKOPE33, 1)):
        make_dataset(Path(name), scheme=scheme, seed=seed)
    code, _, error = skope("gen", "merge", "old", "new", "both")
    assert (code, error) == (
        2,
        "skope: new: has keypoint scheme skope33 (edition 2), old has skope33\n",
    )
    code, _, error = skope("train", "--data", "old", "--data", "new", "--init", "random", "--out", "run")
    assert code == 2
    assert "new: has keypoint scheme skope33 (edition 2), old has skope33: datasets of different schemes" in error
    for name in ("old", "new"):
        assert skope("gen", "convert", name, f"{name}_cvat", "--to", "cvat", "-q")[0] == 0
    code, _, error = skope("gen", "convert", "old_cvat", "new_cvat", "mixed", "--from", "cvat", "-q")
    assert (code, "the others of skope33 (editions 2 and 1)" in error) == (2, True)
    coco.write(Path("new/annotations/train.json"), replace(open_dataset(Path("new")).read("train"), scheme=FIRST))
    with pytest.raises(UserError, match=r"has keypoint scheme skope33, the dataset's card skope33 \(edition 2\)"):
        open_dataset(Path("new")).read("train")


def test_checkpoints_hold_what_they_have_learnt() -> None:
    header, _ = read_checkpoint(weights.path(weights.DEFAULT))
    assert DetectorConfig.from_dict(header["config"]).keypoint_scheme is SKOPE33
    older = {name: value for name, value in header["config"].items() if name != "keypoint_edition"}
    assert DetectorConfig.from_dict(older).keypoint_scheme is FIRST, "what was trained before says nothing"
    config = DetectorConfig(norm="frozen", norm_eps=0.0, min_size=640, max_size=1138, keypoint_edition=2)
    assert DetectorConfig.from_dict(config.to_dict()).keypoint_scheme is SKOPE33
    assert "keypoint_edition" not in replace(config, keypoint_edition=1).to_dict()


def test_each_edition_has_its_shapes() -> None:
    first, now = fleet_shapes(1), fleet_shapes()
    assert (first.edition, now.edition) == (1, 2)
    corner = keypoints.INDEX["bumper_front_left"]
    # Farther out and higher, by a few centimetres to a decimetre and more, on cars.
    cars = ("sedan", "suv", "hatchback")
    after, before = (
        np.stack([shapes.mean[shapes.types.index(name), corner] for name in cars]) for shapes in (now, first)
    )
    apart = after - before
    assert (apart[:, 1] > 0.05).all()
    assert (apart[:, 2] > 0.05).all()
    for edition, shapes in ((1, first), (2, now)):
        road = scene([shapes.mean[k, :-1] for k in range(len(shapes.types))], np.random.default_rng(edition), noise=0.0)
        right, wrong = (
            np.median(np.nan_to_num(locate(CAMERA, road.found, shapes=space).rms_px, nan=9.0))
            for space in (shapes, fleet_shapes(3 - edition))
        )
        assert right < 0.5 * wrong


def test_a_scene_takes_the_edition_of_its_keypoints(skope: Any, tmp_path: Path) -> None:
    camera = Camera.looking([0, 0, 8], yaw=0, pitch_down=0.3, size=(160, 120))
    for scheme in (FIRST, SKOPE33):
        file = replace(file_of(scheme), images=(replace(make_image(1), camera=camera),))
        coco.write(tmp_path / f"{scheme.edition}.json", file)
        assert read_scene(None, tmp_path / f"{scheme.edition}.json", None, None, 0.0).shapes.edition == scheme.edition
    found = [Result(image_id=1, bbox=np.array([8.0, 12, 64, 44]), score=0.9, keypoints=np.ones((33, 3)))]
    coco.write_results(tmp_path / "found.json", found)
    call = ("eval", "pose", "--annotations", tmp_path / "2.json", "--predictions", tmp_path / "found.json")
    code, out, error = skope(*call, "--out", "guessed")
    assert code == 0, error
    assert "taken to hold keypoints of edition 2, as 2 does; --keypoint-edition says another" in out + error
    code, out, error = skope(*call, "--keypoint-edition", 1, "--out", "said")
    assert code == 0, error
    assert "taken to hold" not in out + error
