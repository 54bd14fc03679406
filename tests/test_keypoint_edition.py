"""Files of skope name the edition of the keypoints' definition: those that name none or another one are refused."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from skope import keypoints
from skope.dataset import coco
from skope.dataset.folder import open_dataset
from skope.detector import weights
from skope.detector.build import DetectorConfig
from skope.detector.checkpoint import HEADER_FIELD, load_weights
from skope.errors import UserError
from skope.files.json_files import read_json, write_json
from skope.keypoints import SKOPE33
from tests.samples import make_dataset

WRONG = [(None, "nothing"), (1, "1"), (3, "3"), ("two", "'two'")]


def with_edition(values: dict[str, Any], edition: object) -> dict[str, Any]:
    """The fields of a file with another edition, or with none."""
    told = {name: value for name, value in values.items() if name != "keypoint_edition"}
    return told if edition is None else {**told, "keypoint_edition": edition}


@pytest.mark.parametrize(("edition", "said"), WRONG)
def test_our_annotation_files_and_cards_name_it(skope: Any, tmp_path: Path, edition: object, said: str) -> None:
    root = make_dataset(tmp_path / "data", splits=("train",))
    path, card = root / "annotations" / "train.json", root / "dataset.json"
    document, told = read_json(path), read_json(card)
    assert document["info"]["keypoint_edition"] == told["keypoint_edition"] == 2
    assert coco.read(path).scheme is SKOPE33
    write_json(path, {**document, "info": with_edition(document["info"], edition)})
    expected = f"{path}: info.keypoint_edition: expected 2, got {said}"
    with pytest.raises(UserError) as caught:
        open_dataset(root).read("train")
    assert str(caught.value) == expected
    for command in (("gen", "convert", path, "out", "--from", "coco"), ("eval", "pose", "--annotations", path)):
        assert skope(*command, "-q") == (2, "", f"skope: {expected}\n")
    write_json(card, with_edition(told, edition))
    with pytest.raises(UserError) as caught:
        open_dataset(root)
    assert str(caught.value) == f"{card}: keypoint_edition: expected 2, got {said}"


@pytest.mark.parametrize(("edition", "said"), WRONG)
def test_our_checkpoints_name_it(skope: Any, tmp_path: Path, edition: object, said: str) -> None:
    config = DetectorConfig(norm="frozen", norm_eps=0.0, min_size=64, max_size=96)
    assert config.to_dict()["keypoint_edition"] == 2
    assert DetectorConfig.from_dict(config.to_dict()) == config
    path = tmp_path / "a.safetensors"
    header = {"version": 1, "scheme": "skope33", "num_keypoints": 33, "metadata": {}}
    header["config"] = with_edition(config.to_dict(), edition)
    save_file({"x": torch.zeros(1)}, path, {HEADER_FIELD: json.dumps(header)})
    expected = f"{path}: keypoint_edition: expected 2, got {said}"
    with pytest.raises(UserError) as caught:
        load_weights(path, "cpu")
    assert str(caught.value) == expected
    data = make_dataset(tmp_path / "data", splits=("train",))
    assert skope("train", "--data", data, "--init", path, "--out", "run", "-q") == (2, "", f"skope: {expected}\n")


@pytest.mark.parametrize("name", weights.names())
def test_shipped_weights_load(name: str) -> None:
    _, config, _ = load_weights(weights.path(name), "cpu")
    assert config.keypoint_scheme is SKOPE33


def test_files_of_others_do_not_name_it(skope: Any, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", splits=("train",))
    path = root / "annotations" / "train.json"
    document = read_json(path)
    del document["info"]
    write_json(path, document)
    assert coco.read(path).scheme is SKOPE33
    code, _, error = skope("gen", "convert", path, "out", "--from", "coco", "-q")
    assert code == 0, error
    assert read_json(Path("out/dataset.json"))["keypoint_edition"] == keypoints.EDITION
