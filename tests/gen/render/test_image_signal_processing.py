"""What a camera makes of its sensor's picture."""

import cv2
import numpy as np
import pytest

from skope.gen.render.camera_effects import processed
from skope.gen.scene.conditions import Conditions

PLAIN = {
    "sun_elevation_deg": 40.0,
    "sun_azimuth_deg": 0.0,
    "clouds": 0.0,
    "visibility_m": 1e4,
    "exposure_ev": 0.0,
    "noise": 0.0,
    "vignetting": 0.0,
    "k1": 0.0,
}


def conditions(**fields: float) -> Conditions:
    return Conditions(**{**PLAIN, **fields})


@pytest.fixture
def picture() -> np.ndarray:
    """(40, 60, 3) colours in blocks of 10 px, none of them near black or white."""
    blocks = np.random.default_rng(0).integers(70, 180, (4, 6, 3), dtype=np.uint8)
    return np.asarray(cv2.resize(blocks, (60, 40), interpolation=cv2.INTER_NEAREST))


def test_a_plain_camera_changes_nothing(picture: np.ndarray) -> None:
    assert processed(picture, conditions()) is picture


def test_contrast_and_black_level() -> None:
    ramp = np.arange(256, dtype=np.uint8).reshape(1, -1, 1).repeat(3, axis=-1)
    steep = processed(ramp, conditions(contrast=2.0))[0, :, 0].astype(int)
    assert steep[118] == 118
    assert set(np.diff(steep[60:176])) == {2}
    assert (steep[0], steep[255]) == (0, 255)
    lifted = processed(ramp, conditions(black_level=40.0))[0, :, 0].astype(int)
    assert (lifted[0], lifted[255]) == (40, 255)
    assert (np.diff(lifted) >= 0).all()


def test_saturation_changes_colours_and_not_brightness(picture: np.ndarray) -> None:
    def brightness(rgb: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), dtype=int)

    for saturation in (0.0, 0.5, 1.2):
        out = processed(picture, conditions(saturation=saturation))
        assert np.abs(brightness(out) - brightness(picture)).max() <= 1
        spread, before = (np.ptp(rgb.astype(int), axis=-1) for rgb in (out, picture))
        assert np.abs(spread - saturation * before).max() <= 2


def test_sharpening_overshoots_at_edges_only(picture: np.ndarray) -> None:
    out = processed(picture, conditions(sharpening=1.5)).astype(int)
    middles = (slice(4, None, 10), slice(4, None, 10))
    np.testing.assert_allclose(out[middles], picture[middles], atol=2)
    jumps, before = (np.abs(np.diff(rgb.astype(int), axis=1))[:, 9::10] for rgb in (out, picture))
    clear = before > 20
    assert (jumps[clear] > 1.5 * before[clear]).all()
