from pathlib import Path

import cv2
import numpy as np
import pytest

from skope.dataset.depth_files import depth_png, encode_depth, read_depth
from skope.errors import UserError


def test_depth_keeps_a_256th_of_a_metre_and_the_sky(tmp_path: Path) -> None:
    depth = np.array([[0.0, 0.001, 1.0, 10.3], [255.99, 256.0, 4000.0, np.inf]], dtype=np.float32)
    coded = encode_depth(depth)
    assert coded.dtype == np.uint16
    assert coded.tolist() == [[1, 1, 256, 2637], [65533, 65535, 65535, 0]]
    (tmp_path / "d.png").write_bytes(depth_png(depth))
    back = read_depth(tmp_path / "d.png")
    assert back.dtype == np.float32
    assert np.isinf(back).tolist() == np.isinf(depth).tolist()
    assert np.abs(back[0, 2:] - depth[0, 2:]).max() <= 0.5 / 256
    assert back[1, 2] == pytest.approx(255.99, abs=0.01)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (65, 3), (200, 301)])
def test_opencv_reads_what_is_written(shape: tuple[int, int]) -> None:
    depth = np.random.default_rng(0).uniform(0, 300, shape).astype(np.float32)
    png = np.frombuffer(depth_png(depth), dtype=np.uint8)
    np.testing.assert_array_equal(cv2.imdecode(png, cv2.IMREAD_UNCHANGED), encode_depth(depth))


def test_a_depth_file_has_16_bits(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "d.png"), np.zeros((3, 4), np.uint8))
    with pytest.raises(UserError, match="not a 16-bit depth image"):
        read_depth(tmp_path / "d.png")
    (tmp_path / "d.png").write_bytes(b"")
    with pytest.raises(UserError, match="not a 16-bit depth image"):
        read_depth(tmp_path / "d.png")
