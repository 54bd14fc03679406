import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skope.dataset import coco
from skope.detector.network_settings import Settings
from skope.detector.predictor import Predictor
from skope.terminal.console import Console
from tests.samples import make_annotation, make_dataset


@pytest.fixture
def own_truth(random_run: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A copy of the run, and a dataset whose vehicles are what it finds; the left half of the points is hidden."""
    run = tmp_path / "run"
    shutil.copytree(random_run, run)
    root = make_dataset(tmp_path / "data", images=2, splits=("train",))
    predictor = Predictor.load(run, Settings(device="cpu"), Console(quiet=True))
    path = root / "annotations" / "train.json"
    file = coco.read(path)
    vehicles = []
    for i, found in enumerate(predictor.split(file, root), start=1):
        points = found.keypoints.copy()
        points[:, 2] = np.where(points[:, 0] < found.bbox[0] + found.bbox[2] / 2, 1, 2)
        vehicles.append(replace(make_annotation(i, found.image_id, tuple(found.bbox)), keypoints=points))
    coco.write(path, replace(file, annotations=tuple(vehicles)))
    return run, root
