"""Peaks of heat maps lie where the maps say, between the centres of cells."""

import torch
from torchvision.models.detection.roi_heads import heatmaps_to_keypoints

from skope.detector.detect import heatmap_peaks


def hills(tops: torch.Tensor, cells: int = 56, width: float = 2.5) -> torch.Tensor:
    """(N, K, cells, cells) maps with a bell-shaped hill of height 6 around each of the (N, K, 2) tops, in cells."""
    centres = torch.arange(cells) + 0.5
    x, y = ((centres - tops[..., axis, None]) ** 2 for axis in (0, 1))
    return 6 * torch.exp(-(x[..., None, :] + y[..., None]) / (2 * width**2))


def random_boxes(number: int, draw: torch.Generator, least_px: float = 1.5) -> torch.Tensor:
    """(N, 4) boxes with sides from `least_px` to 300 px more."""
    corners = torch.rand(number, 2, generator=draw) * 900
    sizes = torch.rand(number, 2, generator=draw) ** 3 * 300 + least_px
    return torch.cat([corners, corners + sizes], dim=1)


def test_hills_between_cells_are_found() -> None:
    draw = torch.Generator().manual_seed(0)
    boxes, tops = random_boxes(24, draw), torch.rand(24, 33, 2, generator=draw) * 50 + 3
    places, heights = heatmap_peaks(hills(tops), boxes)
    expected = boxes[:, None, :2] + tops / 56 * (boxes[:, 2:] - boxes[:, :2])[:, None]
    cells = (places - expected).abs() / (boxes[:, 2:] - boxes[:, :2])[:, None] * 56
    assert cells.max() < 0.02
    torch.testing.assert_close(heights, torch.full((24, 33), 6.0), rtol=0, atol=0.03)


def test_positions_are_those_of_torchvision_within_its_rounding() -> None:
    """torchvision rounds to half a pixel; its bicubic enlargement adds a fraction of a cell."""
    draw = torch.Generator().manual_seed(1)
    boxes, tops = random_boxes(24, draw, least_px=20), torch.rand(24, 33, 2, generator=draw) * 50 + 3
    maps = hills(tops)
    places, _ = heatmap_peaks(maps, boxes)
    expected, _ = heatmaps_to_keypoints(maps, boxes)
    cell = (boxes[:, 2:] - boxes[:, :2])[:, None] / 56
    assert ((places - expected[..., :2]).abs() <= 0.5 + 0.1 * cell).all()


def test_a_peak_at_the_edge_of_a_map_lies_in_the_middle_of_its_cell() -> None:
    maps = torch.zeros(1, 2, 56, 56)
    maps[0, 0, 0, 55], maps[0, 1, 55, 0] = 5.0, 5.0
    places, heights = heatmap_peaks(maps, torch.tensor([[100.0, 50.0, 156.0, 106.0]]))
    torch.testing.assert_close(places[0], torch.tensor([[155.5, 50.5], [100.5, 105.5]]))
    assert (heights == 5).all()


def test_a_flat_map_has_a_finite_peak() -> None:
    places, heights = heatmap_peaks(torch.full((1, 1, 56, 56), 0.25), torch.tensor([[0.0, 0.0, 10.0, 10.0]]))
    assert places.isfinite().all()
    assert heights.item() == 0.25


def test_no_vehicles_have_no_peaks() -> None:
    places, peaks = heatmap_peaks(torch.zeros(0, 33, 56, 56), torch.zeros(0, 4))
    assert places.shape == (0, 33, 2)
    assert peaks.shape == (0, 33)
