import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from skope.dataset import coco
from skope.dataset.image_selection import last_frames
from skope.detector import score_calibration
from skope.errors import UserError
from skope.metrics.score_reliability import calibration_error, reliability
from skope.schema import AnnotationFile, Image
from tests.samples import make_annotation

SCALE, OFFSET = np.linspace(0.3, 2.0, 33), np.linspace(-4.0, 1.0, 33)


def simulated(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Raw maxima, and outcomes with just the probabilities that SCALE and OFFSET say."""
    rng = np.random.default_rng(seed)
    raw = rng.normal(3, 2, (count, 33))
    return raw, rng.random((count, 33)) < 1 / (1 + np.exp(-(SCALE * raw + OFFSET)))


def as_points(raw: np.ndarray) -> np.ndarray:
    """As `skope.detector` gives them."""
    return np.concatenate([np.zeros((*raw.shape, 2)), (1 / (1 + np.exp(-raw)))[..., None]], axis=-1)


def test_the_two_numbers_of_each_keypoint_are_found_again() -> None:
    fitted = score_calibration.fit(*simulated(8_000), {})
    assert fitted.scale == pytest.approx(SCALE, abs=0.3)
    assert fitted.offset == pytest.approx(OFFSET, abs=0.4)
    raw, right = simulated(4000, seed=1)
    before, after = as_points(raw)[..., 2], fitted(as_points(raw))[..., 2]
    assert calibration_error(reliability(after.ravel(), right.ravel())) < 0.02
    assert calibration_error(reliability(before.ravel(), right.ravel())) > 0.1
    assert score_calibration.log_loss(after, right) < score_calibration.log_loss(before, right)


def test_the_fit_is_the_minimum_that_scipy_finds() -> None:
    raw, right = simulated(300)
    fitted = score_calibration.fit(raw, right, {})

    def smoothed(y: np.ndarray) -> np.ndarray:
        return np.where(y, (y.sum() + 1) / (y.sum() + 2), 1 / ((~y).sum() + 2))

    def loss(ab: np.ndarray, x: np.ndarray, y: np.ndarray, start: np.ndarray, hold: float) -> float:
        z = ab[0] * x + ab[1]
        return float((np.logaddexp(0, z) - smoothed(y) * z).sum() + hold / 2 * ((ab - start) ** 2).sum())

    exact: dict[str, Any] = {"method": "BFGS", "options": {"gtol": 1e-9}}
    together = minimize(loss, np.zeros(2), (raw.ravel(), right.ravel(), np.zeros(2), 1e-6), **exact).x
    for k in (0, 7, 32):
        own = minimize(loss, together, (raw[:, k], right[:, k], together, 1.0), **exact).x
        assert (fitted.scale[k], fitted.offset[k]) == pytest.approx(own, abs=1e-4)


def test_a_clean_separation_stays_finite_and_a_reversed_one_tells_nothing() -> None:
    raw = np.tile(np.linspace(-30, 30, 40)[:, None], (1, 33))
    right = raw > 0
    right[:, 5] = raw[:, 5] < 0
    fitted = score_calibration.fit(raw, right, {})
    assert np.isfinite([fitted.scale, fitted.offset]).all()
    assert fitted.scale[5] == 0
    scores = fitted(as_points(raw))[..., 2]
    assert scores[:, 5] == pytest.approx(0.5, abs=0.01)
    assert ((scores >= 0) & (scores <= 1)).all()
    assert (np.diff(scores, axis=0) >= 0).all()


def test_raw_maxima_come_back_from_the_detectors_scores() -> None:
    raw = np.linspace(-30, 30, 121)
    assert score_calibration.raw_maxima(torch.tensor(raw).sigmoid().numpy()) == pytest.approx(raw, abs=2e-3)
    assert np.isfinite(score_calibration.raw_maxima(np.array([0.0, 1.0]))).all()


def test_a_file_beside_the_weights(tmp_path: Path) -> None:
    weights = tmp_path / "epoch_003.safetensors"
    weights.write_bytes(b"weights")
    assert score_calibration.read(weights) is None
    fitted = score_calibration.fit(*simulated(200), {"images": 3})
    path = score_calibration.write(weights, fitted, {})
    assert path == tmp_path / "epoch_003.calibration.json"
    back = score_calibration.read(weights)
    assert back is not None
    assert np.array_equal(back.scale, fitted.scale)
    assert np.array_equal(back.offset, fitted.offset)
    assert back.fitted_on == {"images": 3}

    good = json.loads(path.read_text())
    for changes, said in (
        ({"scale": [1.0] * 32}, "scale: expected 33 numbers, got 32"),
        ({"scale": [-1.0] * 33}, "scale: expected numbers from 0, got -1"),
        ({"offset": None}, "offset: "),
        ({"version": 2}, "version: expected 1, got 2"),
        ({"scheme": "coco17"}, "scheme: "),
    ):
        path.write_text(json.dumps({**good, **changes}))
        with pytest.raises(UserError, match=said):
            score_calibration.read(weights)
    path.write_text(json.dumps(good))
    weights.write_bytes(b"other weights")
    with pytest.raises(UserError, match="fitted for other weights"):
        score_calibration.read(weights)


def test_the_last_part_of_each_recording() -> None:
    images = tuple(
        Image(id=i, file_name=f"{i}.png", width=9, height=9, site="a", recording=f"{i % 2}", frame_index=100 - i)
        for i in range(1, 21)
    )
    vehicles = tuple(make_annotation(i, i, (0, 0, 9, 9)) for i in range(1, 21))
    part = last_frames(AnnotationFile(images=images, annotations=vehicles), 0.2)
    # The lowest ids are the latest frames.
    assert [image.id for image in part.images] == [1, 2, 3, 4]
    assert [a.image_id for a in part.annotations] == [1, 2, 3, 4]


# ---------------------------------------------------------------------------------------------------------- the command


def test_a_calibrated_checkpoint_says_so_and_scores_by_it(skope: Any, own_truth: tuple[Path, Path]) -> None:
    run, root = own_truth
    common = ("--data", root, "--checkpoint", run, "--device", "cpu", "--score", "0.05", "--split", "train")
    assert skope("eval", *common, "--out", "before")[0] == 0

    code, _, err = skope("eval", "calibrate-scores", *common)
    assert (code, err.count("\n")) == (2, 1)
    assert "kept nothing of it for validation" in err
    assert skope("eval", "calibrate-scores", *common, "--last", "2")[2].startswith("skope: --last: expected a share")
    code, _, err = skope("eval", "calibrate-scores", *common, "--last", "0.5", "--score", "1")
    assert code == 2
    assert "none of" in err

    empty = Path("empty/annotations/easy.json")
    empty.parent.mkdir(parents=True)
    coco.write(empty, replace(coco.read(root / "annotations" / "train.json"), annotations=()))
    (Path("empty") / "dataset.json").write_bytes((root / "dataset.json").read_bytes())
    shutil.copytree(root / "images", "empty/images")
    code, _, err = skope("eval", "calibrate-scores", "--data", "empty", *common[2:-2], "--split", "easy")
    assert (code, "split easy: shows no vehicle to fit to" in err) == (2, True)

    code, out, err = skope("eval", "calibrate-scores", *common, "--last", "1")
    assert code == 0, err
    assert out.splitlines()[-1].startswith(f"Wrote {run}/epoch_001.calibration.json")
    fitted_on = json.loads((run / "epoch_001.calibration.json").read_text())["fitted_on"]
    assert fitted_on["images"] == 2
    assert fitted_on["vehicles"] > 10
    assert skope("eval", *common, "--out", "after")[0] == 0
    before, after = (json.loads(Path(name, "metrics.json").read_text()) for name in ("before", "after"))
    assert (before["calibrated"], after["calibrated"]) == (False, True)
    errors = [of["splits"]["train"]["confidence"]["calibration_error"] for of in (before, after)]
    assert errors[1] < 0.5 * errors[0]
    assert before["splits"]["train"]["iou"] == after["splits"]["train"]["iou"]
