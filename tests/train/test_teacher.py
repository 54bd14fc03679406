"""Learning from a teacher: nothing where it counts nothing, and what it adds where it does."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torchvision.models.detection import KeypointRCNN
from typer.testing import CliRunner

from skope.detector.build import DetectorConfig, build
from skope.detector.checkpoint import checkpoint_name, save_weights
from skope.errors import UserError
from skope.train import cli, step, teacher
from skope.train.losses import LossSettings, detection_losses
from skope.train.recipe import TeacherRules
from skope.train.teacher import Teacher, TeacherOutputs
from tests import samples
from tests.detector.test_detector import SMALL
from tests.train.test_losses import target

pytestmark = pytest.mark.usefixtures("small_network")

CONFIG = DetectorConfig(norm="frozen", norm_eps=1e-5, **SMALL)
NARROW = replace(CONFIG, backbone="resnet18", pyramid_width=16, keypoint_layers=1, keypoint_width=16, box_width=16)
TARGET = target([[10, 10, 60, 50], [50, 30, 110, 80]], [1, 1], torch.Generator().manual_seed(1))
IMAGE = torch.randint(0, 256, (3, 90, 120), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
RULES = LossSettings(16, 2, 0.0)


def drawn(config: DetectorConfig, seed: int) -> KeypointRCNN:
    torch.manual_seed(seed)
    return build(config).train()


def taught(student: KeypointRCNN, lessons: Teacher | None) -> dict[str, Tensor]:
    torch.manual_seed(7)
    return detection_losses(student, [IMAGE], [TARGET], RULES, lessons)


def teacher_of(model: KeypointRCNN, **rules: float) -> Teacher:
    return Teacher(model.eval().requires_grad_(False), CONFIG, TeacherRules(checkpoint="x", **rules))


def test_a_teacher_that_counts_nothing_changes_nothing() -> None:
    nothing = {"classes": 0.0, "boxes": 0.0, "keypoints": 0.0}
    student = drawn(NARROW, 1)
    without, beside = (taught(student, one) for one in (None, teacher_of(drawn(CONFIG, 2), **nothing)))
    assert without.keys() == set(step.LOSS_NAMES)
    assert beside.keys() == {*step.LOSS_NAMES, *teacher.TEACHER_LOSSES}
    assert all(torch.equal(beside[name], loss) for name, loss in without.items())
    assert all(beside[name] == 0 for name in teacher.TEACHER_LOSSES)
    assert Teacher.load(TeacherRules(checkpoint="no such file", **nothing), NARROW, torch.device("cpu")) is None
    assert Teacher.load(TeacherRules(), NARROW, torch.device("cpu")) is None


def test_nothing_is_learnt_from_oneself() -> None:
    student = drawn(CONFIG, 1)
    with torch.no_grad():
        itself, other = (taught(student, teacher_of(drawn(CONFIG, seed))) for seed in (1, 2))
    for name in teacher.TEACHER_LOSSES:
        assert abs(float(itself[name])) < 1e-3 * float(other[name]), name


def test_heat_maps_that_calibration_has_flattened_are_sharpened() -> None:
    """Nothing is to be learnt from half of one's own maps times two."""
    student, flat = drawn(CONFIG, 1), drawn(CONFIG, 1)
    with torch.no_grad():
        for parameter in flat.roi_heads.keypoint_predictor.parameters():
            parameter /= 2
        as_it_is, sharpened = (taught(student, teacher_of(flat, sharpen=by)) for by in (1.0, 2.0))
    assert float(as_it_is["loss_teacher_keypoints"]) > 1e-3
    assert abs(float(sharpened["loss_teacher_keypoints"])) < 1e-5


def test_the_student_comes_nearer_and_the_teacher_stays() -> None:
    student, lessons = drawn(NARROW, 1), teacher_of(drawn(CONFIG, 2), temperature=2.0)
    before = [one.clone() for one in lessons.model.state_dict().values()]
    for name in teacher.TEACHER_LOSSES:
        student.zero_grad()
        taught(student, lessons)[name].backward()  # type: ignore[no-untyped-call]
        assert float(student.backbone.body.conv1.weight.grad.abs().max()) > 0, name
    assert all(torch.equal(one, two) for one, two in zip(before, lessons.model.state_dict().values(), strict=True))
    assert all(parameter.grad is None for parameter in lessons.model.parameters())
    sgd = torch.optim.SGD(student.parameters(), lr=1e-3)
    sums = []
    for _ in range(4):
        sgd.zero_grad()
        losses = taught(student, lessons)
        total = sum(losses[name] for name in teacher.TEACHER_LOSSES)
        total.backward()
        sgd.step()
        sums.append(float(total.detach()))
    assert sums[-1] < sums[0]


def test_divergence_of_two_known_distributions() -> None:
    """0.5 log(0.5 / 0.8) + 0.5 log(0.5 / 0.2), whatever all logits have in common."""
    lesson = TeacherOutputs(None, {}, TeacherRules())
    own, other = torch.tensor([[0.8, 0.2]]).log() + 3, torch.tensor([[0.5, 0.5]]).log()
    assert lesson._divergence(own, other).tolist() == pytest.approx([0.2231436])
    hot = TeacherOutputs(None, {}, TeacherRules(temperature=2.0))
    assert hot._divergence(2 * own, 2 * other).tolist() == pytest.approx([4 * 0.2231436])


def test_a_teacher_of_other_things_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    save_weights(path, drawn(CONFIG, 1), CONFIG, {})
    four = replace(NARROW, categories=("vehicle", "pedestrian"))
    with pytest.raises(
        UserError, match=r"expected the categories vehicle, pedestrian; got vehicle\. .*--set teacher\.cla"
    ):
        Teacher.load(TeacherRules(checkpoint=str(path)), four, torch.device("cpu"))
    points = Teacher.load(TeacherRules(checkpoint=str(path), classes=0, boxes=0), four, torch.device("cpu"))
    assert points is not None
    assert not any(parameter.requires_grad for parameter in points.model.parameters())
    with pytest.raises(UserError, match="expected keypoint scheme skope3d, got skope33"):
        Teacher.load(
            TeacherRules(checkpoint=str(path)),
            replace(NARROW, scheme="skope3d"),
            torch.device("cpu"),
        )


def test_a_run_with_a_teacher(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    save_weights(run / checkpoint_name(1), drawn(CONFIG, 1), CONFIG, {})
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    flags = ["--data", data, "--device", "cpu", "--epochs", "1", "--recipe", "scratch", "--min-size", "64"]
    flags += ["--set", f"teacher.checkpoint={run}", "--out", tmp_path / "out", "--set", "keypoint_regions=2"]
    done = CliRunner().invoke(cli.app, list(map(str, flags)))
    assert done.exit_code == 0, done.output
    assert f"learns from {run} beside the labels" in done.output
    (row,) = (json.loads(line) for line in (tmp_path / "out" / "metrics.jsonl").read_text().splitlines())
    names = (*step.LOSS_NAMES, *teacher.TEACHER_LOSSES)
    assert all(row[name] > 0 for name in names)
    assert row["loss"] == pytest.approx(sum(row[name] for name in names), rel=1e-5)
