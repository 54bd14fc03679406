"""How bright pictures are and how much contrast they have, by day, at night, and through fog."""

from pathlib import Path

import numpy as np
import pytest

from skope.camera.motion.frame_contrast import brightness_and_contrast, visibility_rows
from skope.camera.motion.image_shift import small_grey
from skope.camera.motion.view_changes import ViewSamples
from skope.dataset.folder import read_image
from skope.schema import Image
from skope.traffic.report_remarks import REMARK_LIMITS

DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.parametrize("name", ["noon.jpg", "low_sun.jpg", "rain_night.jpg", "fog.jpg"])
def test_pictures_in_which_vehicles_are_told_are_neither_dark_nor_flat(name: str) -> None:
    """Nor is the docs' fog, nor a night with lamps; the same without light, or through much thicker fog, is."""
    picture = read_image(DOCS / name).astype(np.float64)
    brightness, contrast = brightness_and_contrast(small_grey(picture.astype(np.uint8)))
    assert brightness > REMARK_LIMITS.dark
    assert contrast > REMARK_LIMITS.flat
    unlit, _ = brightness_and_contrast(small_grey((0.1 * picture).astype(np.uint8)))
    assert unlit < REMARK_LIMITS.dark
    _, hidden = brightness_and_contrast(small_grey((210 + 0.03 * picture).astype(np.uint8)))
    assert hidden < REMARK_LIMITS.flat


def test_squares_of_a_checkerboard() -> None:
    """Half black, half white: brightness 1/2, deviation 1/2 in each square but for its odd pixel."""
    board = (np.indices((90, 160)).sum(axis=0) % 2 * 255).astype(np.uint8)
    brightness, contrast = brightness_and_contrast(board)
    assert brightness == pytest.approx(0.5, abs=0.01)
    assert contrast == pytest.approx(0.5 / 0.52, abs=0.02)
    assert brightness_and_contrast(np.full((90, 160), 51, dtype=np.uint8)) == (
        pytest.approx(0.2),
        pytest.approx(0.0, abs=1e-3),
    )


def test_rows_are_half_a_second_apart() -> None:
    frames = [
        (
            Image(id=k + 1, file_name="a", width=320, height=180, time_s=k / 10),
            np.full((180, 320, 3), 20 * (k // 5), np.uint8),
        )
        for k in range(11)
    ]
    looks = ViewSamples()
    assert len(list(looks.watch(frames))) == 11
    rows = visibility_rows([((number - 1) / 10, look) for number, look in looks.taken.items()])
    assert [row[0] for row in rows] == [0.0, 0.5, 1.0]
    assert [row[1] for row in rows] == pytest.approx([0, 20 / 255, 40 / 255], abs=0.005)
