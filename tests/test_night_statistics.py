"""scripts/research/night_statistics.py: statistics of images that were made to have them."""

from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.samples import load_script


@pytest.fixture(scope="module")
def night() -> ModuleType:
    return load_script("research/night_statistics")


def saved(path: Path, rgb: np.ndarray, quality: int = 95) -> Path:
    Image.fromarray(np.clip(rgb, 0, 255).astype(np.uint8)).save(path, quality=quality)
    return path


@pytest.mark.parametrize("quality", [40, 75, 90])
def test_jpeg_quality_is_that_of_the_file(night: ModuleType, tmp_path: Path, quality: int) -> None:
    path = saved(tmp_path / "one.jpg", np.full((64, 64, 3), 90), quality)
    assert night.statistics_of(path)["quality"] == pytest.approx(quality, abs=0.7)


def test_noise_and_its_autocorrelation_are_measured_on_a_shaded_road(night: ModuleType) -> None:
    rng = np.random.default_rng(0)
    white = rng.normal(0, 3.0, (480, 640))
    blurred = cv2.GaussianBlur(white, (0, 0), 1.0)
    shade = np.linspace(80, 140, 640)
    for noise, lag in ((white, 0.0), (3 * blurred / blurred.std(), np.exp(-1 / 4))):
        luma = (shade + noise).astype(np.float32)
        found = night.noise_of(np.repeat(luma[..., None], 3, axis=-1).astype(np.uint8), luma)
        # The flattest patches have less noise than all, and the fit takes some of what is blurred.
        assert 2.5 < found["noise"] < 3.0
        assert found["noise_lag_1"] == pytest.approx(lag, abs=0.05)
        assert found["road_red"] == pytest.approx(1.0, abs=0.01)


def test_flat_blocks_are_those_without_detail(night: ModuleType) -> None:
    luma = np.full((96, 96), 50, dtype=np.float32)
    luma[32:, 48:] += np.random.default_rng(1).integers(0, 30, (64, 48))
    assert night.flat_blocks(luma) == pytest.approx(0.5)


def test_glow_is_measured_from_the_edge_of_a_burnt_out_lamp(night: ModuleType) -> None:
    rgb = np.full((720, 1280, 3), 60.0)
    y, x = np.mgrid[:720, :1280]
    for row, column in ((300, 300), (400, 700), (500, 1000)):
        away = np.maximum(np.hypot(y - row, x - column) - 4, 0)
        rgb += (195 * np.exp(-away / 4.0))[..., None] * [1.0, 0.95, 1.0]
        rgb[..., 2] += 20 * np.exp(-away / 4.0) * (away > 0)
    found = night.glow_of(np.clip(rgb, 0, 255).astype(np.uint8))
    assert found["glow_half"] == pytest.approx(4 * np.log(2), abs=1.01)
    assert found["glow_tenth"] == pytest.approx(4 * np.log(10), abs=1.5)
    assert found["glow_blue"] > 3
    assert night.glow_of(np.full((72, 128, 3), 60, dtype=np.uint8)) == {}


def test_the_table_says_what_is_outside_the_reference(night: ModuleType) -> None:
    real = [{"noise": value} for value in (1.0, 2.0, 3.0)]
    _, row = night.compare({"real": real, "near": [{"noise": 2.2}], "far": [{"noise": 9.0}]})
    assert row == ["noise", "1.2", "2.8", "2", "2.2", "in", "9", "out"]
