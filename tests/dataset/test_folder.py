import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from skope.dataset.folder import open_dataset, read_image
from skope.errors import UserError
from skope.keypoints import SKOPE33
from tests.samples import make_dataset


def test_a_folder_is_read(tmp_path: Path) -> None:
    data = open_dataset(make_dataset(tmp_path / "data", images=2))
    assert data.splits == ("easy", "train")
    file = data.read("train")
    assert (len(file.images), len(file.annotations), file.name) == (2, 4, "train")
    pixels = data.image(file.images[0])
    assert pixels.shape == (120, 160, 3)
    x, y, _, _ = file.annotations[0].bbox.astype(int)
    assert pixels[y + 1, x + 1].tolist() == [40, 60, 150]  # RGB, as drawn
    assert data.depth(file.images[0]) is None


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such dataset folder; `skope gen"):
        open_dataset(tmp_path / "nowhere")
    with pytest.raises(UserError, match=r"no dataset\.json in it"):
        open_dataset(tmp_path)
    root = make_dataset(tmp_path / "data", images=1)
    data = open_dataset(root)
    with pytest.raises(UserError, match="no split 'hard'; there are: easy, train"):
        data.read("hard")
    image = data.read("easy").images[0]
    (root / image.file_name).unlink()
    with pytest.raises(UserError, match=f"{image.file_name}: no such file"):
        data.image(image)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("version", 99, "version: expected 1, got 99"),
        ("version", [1], r"version: expected 1, got \[1\]"),
        ("version", True, "version: expected 1, got True"),
        ("counts", 3, "counts: expected an object, got 3"),
        ("takes", {}, "takes: expected a list, got {}"),
        ("takes", [["t01_main_west", "00", "train"]], r"takes\[0\]: expected site, name, split and frames"),
        ("takes", [["t01_main_west", "00", "train", True]], r"takes\[0\]: expected site, name, split and frames"),
        ("licence", None, "licence: expected text, got None"),
        ("parameters", "x" * 999, "parameters: expected an object, got 'xxx"),
    ],
)
def test_a_broken_card_names_its_field(tmp_path: Path, field: str, value: object, words: str) -> None:
    (tmp_path / "dataset.json").write_text(json.dumps({**SKOPE33.fields(), field: value}))
    with pytest.raises(UserError, match=words) as caught:
        open_dataset(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / 'dataset.json'}: ")
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("card", [{"keypoint_scheme": "apollo24"}, {}, []])
def test_a_card_of_another_scheme_is_refused(tmp_path: Path, card: object) -> None:
    root = make_dataset(tmp_path / "data", images=1)
    (root / "dataset.json").write_text(json.dumps(card))
    with pytest.raises(UserError, match=r"keypoint_scheme: .* is not one of skope33, skope3d"):
        open_dataset(root)


@pytest.mark.parametrize("share", [0.3, 0.9, 0.999])
def test_a_truncated_jpeg_is_refused(tmp_path: Path, share: float) -> None:
    path = tmp_path / "a.jpg"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (90, 120, 3), dtype=np.uint8))
    whole = path.read_bytes()
    assert read_image(path, size=(120, 90)).shape == (90, 120, 3)
    path.write_bytes(whole[: int(len(whole) * share)])
    with pytest.raises(UserError, match="truncated JPEG"):
        read_image(path)


@pytest.mark.parametrize("data", [b"", b"GIF89a", b"\x89PNG\r\n\x1a\n broken"])
def test_a_file_that_is_no_image_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "a.jpg"
    path.write_bytes(data)
    with pytest.raises(UserError, match="not an image that can be decoded"):
        read_image(path)


def test_an_image_of_another_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.zeros((3, 4, 3), np.uint8))
    with pytest.raises(UserError, match=r"a\.png: is 4x3, its annotation says 4x4"):
        read_image(path, size=(4, 4))
