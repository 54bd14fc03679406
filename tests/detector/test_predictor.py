"""A detector with random weights, from the checkpoint to the metrics."""

import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from skope.dataset import coco
from skope.detector.backends import bfloat16
from skope.detector.checkpoint import find_checkpoint, load_weights
from skope.detector.network_settings import Settings
from skope.detector.predictor import Predictor, _batches, _decoded, default_batch_size
from skope.errors import UserError
from skope.schema import AnnotationFile, Image, Result
from skope.terminal.console import Console
from tests.conftest import files_of
from tests.samples import make_annotation, make_dataset, make_image


def test_a_checkpoint_is_evaluated_on_all_test_splits(skope: Any, random_run: Path, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=1, splits=("train", "hard", "easy"))
    run = shutil.copytree(random_run, tmp_path / "run")
    code, out, err = skope("eval", "--data", root, "--checkpoint", run, "--score", "0.999", "--device", "cpu")
    assert code == 0, err
    lines = out.splitlines()
    assert any(line.endswith("for 1 images") and line.startswith("easy: about") for line in lines)
    assert lines[-1].startswith("Wrote metrics.json, tallies.json, predictions_{easy,hard}.json, overlays/ to ")
    assert lines[-1].endswith(f"open {run}/eval/report.html")
    assert any("No detection scores above 0.999 in easy, hard" in line for line in lines)
    assert any("--recipe scratch" in line and "--init coco" in line for line in lines)
    assert list(json.loads((run / "eval" / "metrics.json").read_text())["splits"]) == ["easy", "hard"]
    once = files_of(run / "eval")
    assert 0 < len(json.loads(once["predictions_easy.json"])) < 60
    assert set(once) >= {"predictions_easy.json", "predictions_hard.json", "overlays/easy_1.jpg", "overlays/hard_1.jpg"}

    skope("eval", "--data", root, "--checkpoint", run, "--score", "0.999", "--device", "cpu", "--out", "again")
    assert files_of(Path("again")) == once

    predictions = ("--predictions", run / "eval" / "predictions_easy.json", "--score", "0.999", "--out", "read")
    skope("eval", "--data", root, "--split", "easy", *predictions)
    read = json.loads(Path("read/metrics.json").read_text())["splits"]["easy"]
    assert read == json.loads(once["metrics.json"])["splits"]["easy"]


def test_given_boxes_put_keypoints_on_every_ground_truth_vehicle(random_run: Path, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=1, splits=("easy",))
    file = coco.read(root / "annotations" / "easy.json")
    first, second = file.annotations
    ignored = make_annotation(9, first.image_id, (5, 5, 20, 20), iscrowd=1)
    file = AnnotationFile(images=file.images, annotations=(second, ignored, first), name="easy")
    found = Predictor.load(random_run, Settings(device="cpu", given=True), Console(quiet=True)).split(file, root)
    assert [result.score for result in found] == [1.0, 1.0]
    for result, vehicle in zip(found, (first, second), strict=True):
        assert np.array_equal(result.bbox, vehicle.bbox)
        low, size = vehicle.bbox[:2], vehicle.bbox[2:]
        inside = (result.keypoints[:, :2] >= low - 1) & (result.keypoints[:, :2] <= low + size + 1)
        assert inside.all()


def test_given_boxes_match_all_vehicles(skope: Any, random_run: Path, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=1, splits=("easy",))
    skope("eval", "--data", root, "--checkpoint", random_run, "--boxes", "given", "--out", "out", "--quiet")
    entry = json.loads(Path("out/metrics.json").read_text())["splits"]["easy"]["iou"]["0.9"]
    assert entry["matched"] == 2
    assert entry["box_precision"] == entry["box_recall"] == {"paper": 1.0, "pooled": 1.0}


def test_a_split_without_images_has_no_results(random_run: Path, tmp_path: Path) -> None:
    predictor = Predictor.load(random_run, Settings(device="cpu"), Console(quiet=True))
    assert predictor.split(AnnotationFile(images=(), annotations=()), tmp_path) == ()
    file = AnnotationFile(images=(make_image(1),), annotations=())
    with pytest.raises(ValueError, match="no such file"):
        predictor.split(file, tmp_path)


def predict(run: Path, file: AnnotationFile, root: Path, **settings: Any) -> tuple[Any, ...]:
    return Predictor.load(run, Settings(device="cpu", **settings), Console(quiet=True)).split(file, root)


def test_fast_finds_what_scores_high_just_as_well(skope: Any, random_run: Path, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=1, splits=("easy",))
    file = coco.read(root / "annotations" / "easy.json")
    every = predict(random_run, file, root)
    score = float(np.median([r.score for r in every]))
    common = (
        "--data",
        root,
        "--checkpoint",
        random_run,
        "--device",
        "cpu",
        "--out",
        "fast",
        "--score",
        score,
        "--fast",
    )
    code, out, err = skope("eval", *common)
    assert code == 0, err
    fast, slow = coco.read_results(Path("fast/predictions_easy.json")), [r for r in every if r.score > score]
    assert len(fast) == len(slow) > 3
    for a, b in zip(fast, slow, strict=True):
        assert a.score == pytest.approx(b.score, abs=1e-5)
        assert a.bbox == pytest.approx(b.bbox, abs=0.02)
        # Which of two equal heights of a flat heat map is the highest is up to rounding.
        assert np.median(np.abs(a.keypoints - b.keypoints)) < 0.02
    split = json.loads(Path("fast/metrics.json").read_text())["splits"]["easy"]
    assert set(split["coco"].values()) == {None}
    assert split["detections"] == len(fast)
    assert "AP is not available, and the curves stop at that threshold" in Path("fast/report.html").read_text()
    assert "      -" in out
    assert skope("eval", "--data", root, "--predictions", "x.json", "--split", "easy", "--fast")[0] == 2


def test_a_batch_finds_what_single_images_do(random_run: Path, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=3, splits=("easy",))
    file = coco.read(root / "annotations" / "easy.json")
    one, two = (predict(random_run, file, root, batch_size=n, min_score=0.06) for n in (1, 2))
    assert [r.image_id for r in one] == [r.image_id for r in two]
    assert len({r.image_id for r in one}) == 3
    for a, b in zip(one, two, strict=True):
        assert a.score == pytest.approx(b.score, abs=1e-4)
        assert a.bbox == pytest.approx(b.bbox, abs=0.05)


@pytest.mark.parametrize(("gigabytes", "images"), [(8, 8), (24, 16), (141, 16)])
def test_a_large_gpu_takes_more_images_at_a_time(gigabytes: int, images: int, monkeypatch: pytest.MonkeyPatch) -> None:
    card = SimpleNamespace(total_memory=gigabytes * 10**9)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: card)
    assert default_batch_size(torch.device("cuda:0")) == images
    assert default_batch_size(torch.device("cpu")) == 1


def test_too_little_memory_is_said_in_a_line(random_run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    predictor = Predictor.load(random_run, Settings(device="cpu", batch_size=4), Console(quiet=True))
    monkeypatch.setattr("skope.detector.predictor.detect", full)
    with pytest.raises(UserError, match=r"^cpu: out of memory with 3 images .* lower --batch-size or --min-size$"):
        predictor.detections([np.zeros((48, 64, 3), dtype=np.uint8)] * 3)


def test_only_neighbours_of_equal_size_share_a_batch() -> None:
    shapes = [(4, 6), (4, 6), (4, 6), (6, 4), (4, 6)]
    stream = ((make_image(i), np.zeros((*shape, 3), dtype=np.uint8)) for i, shape in enumerate(shapes, start=1))
    assert [[image.id for image, _ in batch] for batch in _batches(stream, 2)] == [[1, 2], [3], [4], [5]]


def test_images_are_decoded_in_order_and_not_too_far_ahead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []

    def slow_first(path: Path, size: tuple[int, int]) -> Any:
        if path.name == "00_000001.png":
            time.sleep(0.05)
        read.append(path.name)
        return np.zeros((1, 1, 3), dtype=np.uint8)

    monkeypatch.setattr("skope.detector.predictor.read_image", slow_first)
    stream = _decoded([make_image(i) for i in range(1, 31)], tmp_path, ahead=4)
    assert next(stream)[0].id == 1
    stream_ids = [next(stream)[0].id for _ in range(3)]
    assert stream_ids == [2, 3, 4]
    assert len(read) <= 4 + 4
    stream.close()


def test_bfloat16_rounds_products_and_leaves_coordinates_alone(random_run: Path) -> None:
    path = find_checkpoint(random_run)
    model, low = (load_weights(path, "cpu")[0] for _ in range(2))
    bfloat16.convert(low)
    image = torch.rand((1, 3, 64, 96), generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        exact, rounded = model.backbone(image), low.backbone(image)
    assert list(exact) == list(rounded)
    for name, features in exact.items():
        assert rounded[name].dtype == torch.float32
        error = (rounded[name] - features).norm() / features.norm()
        assert 1e-5 < error < 0.05
    assert low.backbone.body.conv1.weight.dtype == low.roi_heads.box_head.inner.fc6.weight.dtype == torch.bfloat16
    keypoint_predictor = low.roi_heads.keypoint_predictor
    assert next(keypoint_predictor.parameters()).dtype == torch.float32


def test_bfloat16_finds_the_same_vehicles(random_run: Path, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=1, splits=("easy",))
    file = coco.read(root / "annotations" / "easy.json")
    exact, rounded = (predict(random_run, file, root, precision=p, min_score=0.06) for p in ("float32", "bfloat16"))
    top = exact[0]
    near = [r for r in rounded if np.abs(r.bbox - top.bbox).max() < 2]
    assert near
    assert near[0].score == pytest.approx(top.score, abs=0.02)


def test_images_are_looked_for_first_and_what_was_predicted_is_kept(
    skope: Any, random_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []

    def quick(self: Predictor, batch: Any) -> Iterator[tuple[Image, list[Result]]]:
        for image, _ in batch:
            seen.append(image.id)
            found = Result(image_id=image.id, score=0.95, bbox=np.array([0, 0, 9, 9]), keypoints=np.ones((33, 3)))
            yield image, [found]

    monkeypatch.setattr(Predictor, "_found", quick)
    root = make_dataset(tmp_path / "data", images=3)
    images = coco.read(root / "annotations" / "easy.json").images
    last = root / images[-1].file_name
    call = ("eval", "--data", root, "--checkpoint", random_run, "--split", "easy", "--device", "cpu", "--out", "o")
    sound = last.read_bytes()
    last.unlink()
    code, _, err = skope(*call)
    assert (code, seen, Path("o").exists()) == (2, [], False)
    assert f"{last}: no such file; split easy lacks 1 of {len(images)} images" in err
    last.write_bytes(sound[:50])
    code, _, err = skope(*call)
    assert code == 2
    assert str(last) in err
    assert seen == [image.id for image in images[:-1]]
    last.write_bytes(sound)
    assert skope(*call)[0] == 0
    assert seen == [image.id for image in images]  # each once
    assert [result.image_id for result in coco.read_results(Path("o/predictions_easy.json"))] == seen
    assert not list(Path("o").glob(".*"))
