"""Peaks of heat maps are where torchvision finds them, one vehicle after another."""

import pytest
import torch
from torchvision.models.detection.roi_heads import heatmaps_to_keypoints

from skope.detector import detect as module
from skope.detector.detect import heatmap_peaks


@pytest.mark.parametrize("most", [1, 33 * 90 * 90, 2**24])
def test_peaks_are_those_of_torchvision(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of boxes from a fraction of a pixel to much larger than the maps, whichever go through together."""
    monkeypatch.setitem(module._VALUES_AT_ONCE, "cpu", most)
    draw = torch.Generator().manual_seed(0)
    maps = torch.nn.functional.avg_pool2d(torch.randn(24, 33, 56, 56, generator=draw), 5, 1, 2) * 5
    corners, sizes = torch.rand(24, 2, generator=draw) * 900, torch.rand(24, 2, generator=draw) ** 3 * 300 + 0.3
    boxes = torch.cat([corners, corners + sizes], dim=1)
    expected, logits = heatmaps_to_keypoints(maps, boxes)
    places, found = heatmap_peaks(maps, boxes)
    torch.testing.assert_close(places, expected[..., :2], rtol=0, atol=1e-3)
    torch.testing.assert_close(found, logits, rtol=1e-5, atol=1e-4)


def test_no_vehicles_have_no_peaks() -> None:
    places, peaks = heatmap_peaks(torch.zeros(0, 33, 56, 56), torch.zeros(0, 4))
    assert places.shape == (0, 33, 2)
    assert peaks.shape == (0, 33)
