"""Training with people on foot and on two wheels: targets, refusals, first weights, and that it learns."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torchvision.models.detection import KeypointRCNN, keypointrcnn_resnet50_fpn

from skope import boxes, schema
from skope.dataset import coco
from skope.dataset.folder import open_dataset, read_image
from skope.detector import int8_ranges
from skope.detector.backbones import BACKBONE_CHOICES
from skope.detector.build import DetectorConfig, KeypointNetwork, build
from skope.detector.checkpoint import load_weights, save_weights
from skope.detector.detect import detect
from skope.detector.network_settings import MIN_SCORE
from skope.errors import UserError
from skope.terminal.console import Console
from skope.train import init_weights, loop, splits
from skope.train.augment import AUGMENT_STEPS, Augment
from skope.train.export import CATEGORIES_OUTPUT, OUTPUT_NAMES, DeployedCategories, export, torchvision_code
from skope.train.loop import CheckpointPolicy
from skope.train.recipe import Recipe
from skope.train.run_config import RunConfig
from skope.train.target_batch import IGNORED_KEY
from skope.train.targets import LEAST_INSIDE, Vehicles
from skope.train.training_samples import DetectionDataset, TrainingSet
from tests import road_users, samples
from tests.train.test_init_weights import COCO_FILE
from tests.train.test_loop import CPU, TINY
from tests.train.test_overfits import BY_HEART, pck

FOUR = DetectorConfig(norm="batch", norm_eps=1e-5, min_size=96, max_size=160, categories=schema.CATEGORY_NAMES)
NOBODY = Vehicles(np.zeros((0, 4)), np.zeros((0, 33, 3)), np.zeros((0, 4)))


pytestmark = pytest.mark.usefixtures("small_detectors")


def train(data: list[Path], out: Path, recipe: Recipe, *, resume: bool = False, **more: Any) -> Path:
    config = RunConfig(recipe=recipe, seed=0, data=tuple(map(str, data)), mix=None, max_images=None, **more)
    console = Console(quiet=True)
    return loop.train(config, out, device=CPU, workers=0, resume=resume, console=console, saving=CheckpointPolicy())


def source(root: Path) -> splits.TrainingSource:
    return splits.read(root, exclude_types=(), val_fraction=0.0, max_images=None)


# ------------------------------------------------------------------------------------------------------------- targets


def test_labels_are_places_among_the_categories(tmp_path: Path) -> None:
    part = source(road_users.make_dataset(tmp_path / "data", images=1, users=("pedestrian", "bicycle")))
    for categories, labels in ((schema.CATEGORY_NAMES, [1, 1, 4, 2]), (("vehicle", "pedestrian"), [1, 1, 2])):
        training_set = TrainingSet(
            [part.of_categories(categories)], seed=0, augment=Augment(flip=0.0), supervise="visible"
        )
        target = training_set[0, 0, 0].target
        assert target["labels"].tolist() == labels
        assert (training_set.vehicles, training_set.road_users) == (2, len(labels) - 2)
        x, y, w, h = road_users.PLACES["pedestrian"]
        assert target["boxes"][2].tolist() == [x, y, x + w, y + h]
        assert (target["keypoints"][:2, :, 2] == 2).all()
        assert not target["keypoints"][2:].any()
    (_, target), *_ = DetectionDataset(part.dataset, "train", "visible")
    assert target["labels"].tolist() == [1, 1, 4, 2]


def test_ignored_road_users_are_ignored_regions(tmp_path: Path) -> None:
    part = source(road_users.make_dataset(tmp_path / "data", images=1, users=("pedestrian",), ignored=True))
    target = TrainingSet([part], seed=0, augment=Augment(flip=0.0), supervise="visible")[0, 0, 0].target
    assert target["labels"].tolist() == [1, 1]
    x, y, w, h = road_users.PLACES["pedestrian"]
    assert target[IGNORED_KEY].tolist() == [[x, y, x + w, y + h]]


@pytest.mark.parametrize("step", ["flip", "crop"])
def test_what_moves_pixels_moves_road_users(step: str) -> None:
    """A bright patch is where the box says that it is, in another place than before."""
    moved = 0
    for seed in range(12):
        pixels = np.zeros((90, 120, 3), np.uint8)
        pixels[30:40, 20:28] = 255
        users = replace(NOBODY, road_users_xyxy=np.array([[20.0, 30, 28, 40]]), road_user_labels=np.array([3]))
        after, there = AUGMENT_STEPS[step](pixels, users, np.random.default_rng(seed))
        if not len(there.road_users_xyxy):
            continue
        assert there.road_user_labels.tolist() == [3]
        rows, columns = np.nonzero(after[..., 0] > 200)
        x0, y0, x1, y1 = there.road_users_xyxy[0]
        found = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
        assert np.abs(np.subtract(found, (x0, y0, x1, y1))).max() <= 2.0
        moved += [x0, y0, x1, y1] != [20, 30, 28, 40]
    assert moved >= 5


def test_what_a_crop_or_an_occluder_leaves_too_little_of_is_ignored() -> None:
    box = np.array([[10.0, 10, 30, 50]])
    users = replace(NOBODY, road_users_xyxy=box, road_user_labels=np.array([2]))
    for share, kept in ((LEAST_INSIDE + 0.05, True), (LEAST_INSIDE - 0.05, False)):
        cropped = users.cropped((30 - 20 * share, 0.0), (1.0, 1.0), 100, 100)
        covered = users.covered(np.array([0.0, 0, 100, 50 - 40 * share]))
        for after in (cropped, covered):
            assert (len(after.road_users_xyxy), len(after.ignored_xyxy)) == ((1, 0) if kept else (0, 1))
            assert len(after.road_user_labels) == len(after.road_users_xyxy)
    assert len(users.cropped((40.0, 0.0), (1.0, 1.0), 100, 100).ignored_xyxy) == 0


# ------------------------------------------------------------------------------------------------------------ datasets


def test_datasets_of_different_categories_are_refused_unless_it_is_said_what_to_learn(tmp_path: Path) -> None:
    many = source(road_users.make_dataset(tmp_path / "many", images=1))
    one = source(samples.make_dataset(tmp_path / "one", images=1))
    assert splits.common_categories([many, many], None) == schema.CATEGORY_NAMES
    assert splits.common_categories([one], None) == ("vehicle",)
    with pytest.raises(UserError, match=r"one: labels vehicle, .*many vehicle, bicycle.*--categories vehicle trains"):
        splits.common_categories([many, one], None)
    assert splits.common_categories([many, one], ("vehicle",)) == ("vehicle",)
    assert splits.common_categories([many], ("pedestrian", "vehicle")) == ("vehicle", "pedestrian")
    with pytest.raises(
        UserError, match=r"--categories vehicle,pedestrian: .*one labels vehicle: unlabelled pedestrian"
    ):
        splits.common_categories([many, one], ("vehicle", "pedestrian"))
    assert not many.of_categories(("vehicle",)).learnt.road_users


def test_validation_keeps_road_users_and_ignores_whom_it_has_learnt(tmp_path: Path) -> None:
    root = road_users.make_dataset(tmp_path / "data", images=8, splits=("train",))
    path = root / "annotations" / "train.json"
    file = coco.read(path)
    # One pedestrian stands there all the time, the others are different people.
    same = tuple(replace(u, track_id=7) if u.category == "pedestrian" else u for u in file.road_users)
    coco.write(path, replace(file, road_users=same))
    part = splits.read(root, exclude_types=(), val_fraction=0.25, max_images=None)
    assert {u.category: u.ignored for u in part.validated.road_users} == {"pedestrian": True, "bicycle": False}
    validation, _ = splits.validation_images([part], 10)
    assert validation.categories == schema.CATEGORY_NAMES
    ids = [label.id for label in (*validation.annotations, *validation.road_users)]
    assert sorted(ids) == list(range(1, 1 + len(ids)))
    assert len(validation.road_users) == 2 * len(validation.images) > 0
    few = splits.read(root, exclude_types=(), val_fraction=0.0, max_images=1)
    assert {u.image_id for u in few.learnt.road_users} == {few.learnt.images[0].id}


# -------------------------------------------------------------------------------------------------------- first weights


def initialise(path: Path, categories: tuple[str, ...], seed: int = 0) -> tuple[torch.nn.Module, DetectorConfig, str]:
    return init_weights.initialise(
        str(path), norm="given", min_size=None, max_size=None, trainable_layers=5, seed=seed, categories=categories
    )


def rows(model: Any, label: int) -> list[torch.Tensor]:
    """What the box predictor has for a label."""
    predictor = model.roi_heads.box_predictor
    boxes_of = [
        each.view(-1, 4, *each.shape[1:])[label] for each in (predictor.bbox_pred.weight, predictor.bbox_pred.bias)
    ]
    return [predictor.cls_score.weight[label], predictor.cls_score.bias[label], *boxes_of]


def alike(one: list[torch.Tensor], other: list[torch.Tensor]) -> bool:
    return all(map(torch.equal, one, other))


def test_weights_of_one_class_begin_a_training_of_several(tmp_path: Path) -> None:
    torch.manual_seed(3)
    config = replace(FOUR, categories=("vehicle",))
    own = build(config)
    save_weights(tmp_path / "one.safetensors", own, config, {})
    torch.save(own.state_dict(), tmp_path / "one.pth")
    for name in ("one.safetensors", "one.pth"):
        model, chosen, words = initialise(tmp_path / name, ("vehicle", "bicycle", "pedestrian"))
        assert chosen.categories == ("vehicle", "bicycle", "pedestrian")
        assert words.endswith(f"{name}; bicycle, pedestrian anew")
        assert model.roi_heads.box_predictor.cls_score.out_features == 4
        assert all(alike(rows(model, label), rows(own, label)) for label in (0, 1))
        again, _, _ = initialise(tmp_path / name, ("vehicle", "bicycle", "pedestrian"))
        other, _, _ = initialise(tmp_path / name, ("vehicle", "bicycle", "pedestrian"), seed=1)
        assert alike(rows(model, 3), rows(again, 3))
        assert not alike(rows(model, 3), rows(other, 3))
        # Vehicles' scores hardly change by classes that nothing is known of yet.
        pixels = np.random.default_rng(0).integers(0, 256, (96, 128, 3), dtype=np.uint8)
        (few,), (many,) = (
            detect(one, [pixels], CPU, min_score=0.1, max_detections=5, categories=names)
            for one, names in ((own, ("vehicle",)), (model, chosen.categories))
        )
        assert few.scores.min() > 0.3
        assert many.scores == pytest.approx(few.scores, rel=0.2)
        theirs = own.state_dict()
        others = [key for key in theirs if "box_predictor" not in key]
        assert all(torch.equal(theirs[key], model.state_dict()[key]) for key in others)


def test_weights_trained_on_coco_begin_a_training_of_several(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From torchvision's cache: COCO's person is taken for the vehicle, as ever, and 17 keypoints make room for 33."""
    torch.manual_seed(5)
    coco_like = build(replace(FOUR, norm="frozen", norm_eps=0.0, categories=("vehicle",)), num_keypoints=17)
    path = tmp_path / "hub" / "checkpoints" / COCO_FILE
    path.parent.mkdir(parents=True)
    torch.save(coco_like.state_dict(), path)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    model, chosen, words = initialise(Path("auto"), schema.CATEGORY_NAMES)
    assert words == "weights trained on COCO; bicycle, motorcycle, pedestrian anew"
    assert (chosen.norm, chosen.norm_eps, chosen.categories) == ("frozen", 0.0, schema.CATEGORY_NAMES)
    assert model.roi_heads.keypoint_predictor.kps_score_lowres.out_channels == 33
    assert all(alike(rows(model, label), rows(coco_like, label)) for label in (0, 1))


def test_weights_of_several_classes_begin_one_of_fewer_or_of_others(tmp_path: Path) -> None:
    torch.manual_seed(4)
    own = build(FOUR)
    save_weights(tmp_path / "four.safetensors", own, FOUR, {})
    model, _, words = initialise(tmp_path / "four.safetensors", ("vehicle", "pedestrian"))
    assert words.endswith("four.safetensors")
    assert all(alike(rows(model, label), rows(own, theirs)) for label, theirs in ((0, 0), (1, 1), (2, 4)))
    torch.save(own.state_dict(), tmp_path / "four.pth")
    model, _, words = initialise(tmp_path / "four.pth", schema.CATEGORY_NAMES)
    assert words.endswith("four.pth")
    assert all(alike(rows(model, label), rows(own, label)) for label in range(5))
    with pytest.raises(UserError, match=r"four\.pth: tensor .*box_predictor"):
        initialise(tmp_path / "four.pth", ("vehicle", "pedestrian"))


# --------------------------------------------------------------------------------------------------------- whole runs


def test_a_run_of_one_class_records_it(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    checkpoint = train([data], tmp_path / "run", replace(TINY, epochs=1))
    assert json.loads((tmp_path / "run" / "recipe.json").read_text())["categories"] == ["vehicle"]
    assert load_weights(checkpoint, "cpu")[1].categories == ("vehicle",)
    assert "one class" in (tmp_path / "run" / "README.md").read_text()


def test_what_is_labelled_and_not_learnt_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = road_users.make_dataset(
        tmp_path / "data", images=1, splits=("train",), categories=("vehicle", "bicycle", "pedestrian")
    )
    config = RunConfig(
        recipe=replace(TINY, epochs=1), seed=0, data=(str(data),), mix=None, max_images=None, categories=("vehicle",)
    )
    run = tmp_path / "run"
    checkpoint = loop.train(
        config, run, device=CPU, workers=0, resume=False, console=Console(), saving=CheckpointPolicy()
    )
    said = "".join(capsys.readouterr())
    assert "bicycle, pedestrian: labelled, and background to this run" in said
    assert load_weights(checkpoint, "cpu")[1].categories == ("vehicle",)


def test_a_run_of_several_categories_records_and_resumes_them(tmp_path: Path) -> None:
    data = road_users.make_dataset(tmp_path / "data", images=4, splits=("train",))
    recipe = replace(TINY, epochs=1, val_fraction=0.25)
    checkpoint = train([data], tmp_path / "run", recipe, categories=("vehicle", "pedestrian"))
    _, config, metadata = load_weights(checkpoint, "cpu")
    assert config.categories == ("vehicle", "pedestrian")
    assert metadata["run"]["categories"] == ["vehicle", "pedestrian"]
    card = (tmp_path / "run" / "README.md").read_text()
    assert "2 classes (vehicle, pedestrian; of vehicles alone keypoints)" in card
    assert "2 road users of the categories pedestrian" in card
    (row,) = map(json.loads, (tmp_path / "run" / "metrics.jsonl").read_text().splitlines())
    assert {"pedestrian_precision", "pedestrian_recall"} <= set(row["validation"])
    assert "bicycle_recall" not in row["validation"]
    recorded = RunConfig.read(tmp_path / "run")
    assert recorded.categories == ("vehicle", "pedestrian")
    again = loop.train(
        replace(recorded, recipe=replace(recorded.recipe, epochs=2)),
        tmp_path / "run",
        device=CPU,
        workers=0,
        resume=True,
        console=Console(quiet=True),
        saving=CheckpointPolicy(),
    )
    assert load_weights(again, "cpu")[1].categories == ("vehicle", "pedestrian")


@pytest.fixture(scope="module")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A dataset of one image with two vehicles, a pedestrian and a bicycle, and a detector that has seen it often."""
    folder = tmp_path_factory.mktemp("categories")
    data = road_users.make_dataset(folder / "data", images=1, splits=("train",))
    # Seen larger than in the other tests of learning by heart: the pedestrian is 18 px wide.
    recipe = replace(BY_HEART, epochs=70, learning_rate=0.02, keypoint_regions=16, min_size=160)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # so that rounding is one processor's, not that of how threads share the work
    try:
        return data, train([data], folder / "run", recipe)
    finally:
        torch.set_num_threads(threads)


def test_overfits_vehicles_with_keypoints_and_others_without(learnt: tuple[Path, Path]) -> None:
    data, checkpoint = learnt
    model, config, _ = load_weights(checkpoint, CPU)
    dataset = open_dataset(data)
    file = dataset.read("train")
    (found,) = detect(model, [dataset.image(file.images[0])], CPU, categories=config.categories)
    assert pck(found, list(file.annotations)) > 0.9
    sure = found.above(0.9)
    assert set(sure.road_users.categories.tolist()) == {2, 4}
    for user in file.road_users:
        own = sure.road_users.categories == user.category_id
        overlaps = boxes.iou(boxes.xywh_to_xyxy(user.bbox), sure.road_users.boxes_xyxy[own])[0]
        assert overlaps[0] > 0.6, "the surest one"
        assert overlaps.min() > 0.2, "and nobody elsewhere, on a vehicle say"


@pytest.mark.parametrize("to", ["torchscript", "onnx"])
def test_exports_say_the_category(learnt: tuple[Path, Path], to: str, tmp_path: Path) -> None:
    data, checkpoint = learnt
    model, config, _ = load_weights(checkpoint, "cpu")
    model.roi_heads.score_thresh = MIN_SCORE
    image = torch.as_tensor(read_image(next((data / "images").rglob("*.png")))).permute(2, 0, 1).float() / 255
    with torch.inference_mode():
        expected = DeployedCategories(model, config.categories).eval()(image)
    if to == "onnx":
        pytest.importorskip("onnx")
        runtime = pytest.importorskip("onnxruntime")
        session = runtime.InferenceSession(
            str(export(checkpoint, to, tmp_path / "a.onnx", console=Console(quiet=True)))
        )
        assert [output.name for output in session.get_outputs()] == [*OUTPUT_NAMES, CATEGORIES_OUTPUT]
        answer = [torch.as_tensor(part) for part in session.run(None, {"image": image.numpy()})]
    else:
        path = export(checkpoint, to, tmp_path / "a.pt", console=Console(quiet=True))
        with torch.inference_mode():
            answer = torch.jit.load(str(path))(image)  # type: ignore[no-untyped-call]
    sure = int((expected[1] > 0.9).sum())
    assert sure >= 4
    categories, sure_points = answer[4][:sure], answer[3][:sure]
    assert set(categories.tolist()) == {1, 2, 4}
    assert not sure_points[categories != 1].any()
    assert not answer[2][:sure][categories != 1].any()
    assert sure_points[categories == 1].mean() > 0.5
    for one, other in zip(expected, answer, strict=True):
        assert torch.allclose(one[:sure].double(), other[:sure].double(), rtol=0, atol=0.1)


def test_other_forms_have_as_many_classes(
    learnt: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Compact weights with the ranges of eight bits load as such; the lines for torchvision build five classes."""
    data, checkpoint = learnt
    quiet = Console(quiet=True)

    def gather(model: KeypointRCNN, images: Iterable[Any], categories: tuple[str, ...]) -> dict[str, torch.Tensor]:
        """Without the moments, from which rounding takes minutes."""
        for pixels in images:
            detect(model, [pixels], CPU, categories=categories)
        return {}

    monkeypatch.setattr("skope.train.export.gather", gather)
    packed = export(checkpoint, "compact", tmp_path / "a.safetensors", data=data, console=quiet)
    model, config, metadata = load_weights(packed, "cpu")
    assert config.categories == schema.CATEGORY_NAMES
    assert int8_ranges.read(model, metadata) is not None
    dataset = open_dataset(data)
    (image,) = dataset.read("train").images
    (found,) = detect(model, [dataset.image(image)], CPU, categories=config.categories)
    assert set(found.above(0.8).road_users.categories.tolist()) == {2, 4}

    lines = torchvision_code(tmp_path / "a.pth", config)
    assert "num_classes=5, num_keypoints=33" in lines
    assert lines.endswith("# labels 1 to 4: vehicle, bicycle, motorcycle, pedestrian")
    # Of torchvision's own size: these lines build the whole network.
    with monkeypatch.context() as whole:
        whole.setattr("skope.detector.backbones.BACKBONE_CHOICES", BACKBONE_CHOICES)
        whole.setattr("skope.detector.build.KeypointNetwork", KeypointNetwork)
        save_weights(tmp_path / "whole.safetensors", build(FOUR), FOUR, {})
        export(tmp_path / "whole.safetensors", "state_dict", tmp_path / "it's.pth", console=Console())
    names: dict[str, Any] = {}
    exec(capsys.readouterr().out, names)
    assert names["model"].roi_heads.box_predictor.cls_score.out_features == 5
    stock = keypointrcnn_resnet50_fpn(weights=None, weights_backbone=None, num_classes=5, num_keypoints=33)
    stock.load_state_dict(torch.load(tmp_path / "it's.pth"), strict=True)
