"""A dataset of another keypoint scheme through training and evaluation, and what must not be mixed with it."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from skope import keypoints
from skope.dataset import coco
from skope.dataset.folder import open_dataset
from skope.detector.build import DetectorConfig
from skope.detector.checkpoint import read_checkpoint
from skope.errors import UserError
from skope.files.json_files import read_json, write_json
from skope.keypoints import PUBLISHED, SKOPE33
from skope.schema import AnnotationFile, Result
from skope.train import configure, init_weights, splits
from tests.samples import make_annotation, make_dataset, make_image
from tests.train.conftest import shrink
from tests.train.test_cli import TINY, new

LICENCE = "CC BY-NC-SA 4.0"


@pytest.fixture
def published(tmp_path: Path) -> Path:
    root = make_dataset(tmp_path / "published", scheme=PUBLISHED)
    write_json(root / "dataset.json", {**read_json(root / "dataset.json"), "licence": LICENCE})
    return root


def test_the_schemes() -> None:
    assert PUBLISHED.names[:2] == ("skope3d_00", "skope3d_01")
    assert PUBLISHED.names[32] == "skope3d_32"
    assert set(PUBLISHED.skeleton) == {(0, 1), (1, 3), (3, 2), (2, 0)}
    assert PUBLISHED.flip is None
    assert (SKOPE33.names, SKOPE33.flip) == (keypoints.NAMES, keypoints.FLIP)


def test_a_file_names_its_scheme(published: Path) -> None:
    path = published / "annotations" / "train.json"
    file = coco.read(path)
    assert file.scheme is PUBLISHED
    document = read_json(path)
    assert document["categories"][0]["keypoints"] == list(PUBLISHED.names)
    assert document["info"]["keypoint_scheme"] == "skope3d"
    # Without the field the names tell.
    del document["info"]
    write_json(path, document)
    assert coco.read(path).scheme is PUBLISHED
    document["info"] = SKOPE33.fields()
    write_json(path, document)
    with pytest.raises(UserError, match=r"keypoints\[0\]: 'skope3d_00' is not scheme skope33's 'roof_front_right'"):
        coco.read(path)
    document["info"] = {"keypoint_scheme": "coco17"}
    write_json(path, document)
    with pytest.raises(UserError, match="keypoint_scheme: 'coco17' is not one of skope33, skope3d"):
        coco.read(path)


def test_card_and_annotations_agree(published: Path) -> None:
    write_json(published / "dataset.json", {"version": 1, **SKOPE33.fields()})
    with pytest.raises(UserError, match=r"train\.json: has keypoint scheme skope3d, the dataset's card skope33"):
        open_dataset(published).read("train")


def test_trains_and_evaluates(skope: Any, published: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shrink(monkeypatch)
    config = replace(new(), data=(str(published),), recipe=replace(TINY, epochs=1))
    assert config.recipe.augment.flip == 0.5
    monkeypatch.setattr(configure, "new", lambda *_, **__: config)
    code, out, err = skope("train", "--data", published, "--device", "cpu", "--out", "run")
    assert (code, err[-200:]) == (0, err[-200:])
    assert "images are not mirrored: of scheme skope3d no mirror partners are known" in out
    header, _ = read_checkpoint(Path("run/epoch_001.safetensors"))
    assert header["scheme"] == header["config"]["scheme"] == "skope3d"
    assert header["metadata"]["run"]["licences"] == [LICENCE]
    assert header["metadata"]["run"]["recipe"]["augment"]["flip"] == 0.0
    assert f"| {LICENCE} |" in Path("run/README.md").read_text()
    assert "`skope3d`" in Path("run/README.md").read_text()

    code, out, err = skope("eval", "--data", published, "--checkpoint", "run", "--score", 0, "--out", "figures", "-q")
    assert code == 0, err
    metrics = read_json(Path("figures/metrics.json"))
    assert metrics["scheme"] == "skope3d"
    assert set(metrics["splits"]["easy"]["by"]["keypoint"]) == set(PUBLISHED.names)

    make_dataset(Path("ours"))
    code, _, err = skope("eval", "--data", "ours", "--checkpoint", "run", "--out", "other", "-q")
    assert (code, err.count("\n")) == (2, 1)
    assert "has keypoint scheme skope3d, ours has skope33" in err
    assert not Path("other").exists()
    size = {"min_size": 64, "max_size": 96, "norm": "given", "trainable_layers": 3, "seed": 0}
    with pytest.raises(UserError, match="has keypoint scheme skope3d, the dataset has skope33"):
        init_weights.initialise("run", **size)
    assert init_weights.initialise("run", **size, scheme=PUBLISHED)[1].scheme == "skope3d"


def test_schemes_are_not_learnt_together(published: Path, tmp_path: Path) -> None:
    ours = make_dataset(tmp_path / "ours")
    parts = [splits.read(root, exclude_types=(), val_fraction=0, max_images=None) for root in (ours, published, ours)]
    assert splits.common_scheme(parts[::2]) is SKOPE33
    with pytest.raises(UserError, match=r"published: has keypoint scheme skope3d, .*ours has skope33"):
        splits.common_scheme(parts)


def test_results_of_the_same_scheme_are_scored_point_by_point(skope: Any, tmp_path: Path) -> None:
    vehicle = make_annotation(1, 1, (10, 10, 60, 40))
    file = AnnotationFile(images=(make_image(1),), annotations=(vehicle,), scheme=PUBLISHED)
    coco.write(Path("truth.json"), file)
    coco.write_results(
        Path("found.json"), [Result(image_id=1, score=1.0, bbox=vehicle.bbox, keypoints=vehicle.keypoints)]
    )
    arguments = ("eval", "--annotations", "truth.json", "--predictions", "found.json", "--out", "o", "-q")
    assert skope(*arguments)[0] == 0
    metrics = json.loads(Path("o/metrics.json").read_text())
    figures = metrics["splits"]["truth"]
    assert (metrics["scheme"], figures["iou"]["0.6"]["correct"]) == ("skope3d", 33)
    assert figures["coco"]["keypoint_ap"] == pytest.approx(1)
    assert "skope3d_07" in Path("o/report.html").read_text()
    code, _, err = skope(*arguments, "--scheme", "skope33")
    assert (code, "--scheme: 'skope33' is not one of skope3d" in err) == (2, True)
    code, _, err = skope("eval", "pose", "--annotations", "truth.json", "-q")
    assert (code, "has keypoint scheme skope3d: poses need skope33" in err) == (2, True)


def test_checkpoints_name_their_scheme() -> None:
    values = DetectorConfig(norm="batch", norm_eps=1e-5, min_size=64, max_size=96, scheme="skope3d").to_dict()
    assert DetectorConfig.from_dict(values).keypoint_scheme is PUBLISHED
    with pytest.raises(UserError, match="scheme: 'coco17' is not one of"):
        DetectorConfig.from_dict({**values, "scheme": "coco17"})
