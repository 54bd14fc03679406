"""Where the heat maps of keypoints peak, for many vehicles at once.

torchvision enlarges the maps of one vehicle after another to the size of its box, and takes the largest value. That
is a small call for each of them, and on a GPU a wait too. Bicubic enlargement is linear in the rows and in the columns,
so that it is a product of three matrices, which runs for all vehicles of a chunk together.
"""

from typing import Final

import torch
from torch import Tensor

_VALUES_AT_ONCE: Final = {"cuda": 2**27, "cpu": 2**20}
"""Values of enlarged maps that are held together, by the kind of device."""
_SHARPNESS: Final = -0.75
"""Parameter of the bicubic kernel (Keys, 1981), as in torch's `interpolate`."""


def heatmap_peaks(maps: Tensor, boxes: Tensor) -> tuple[Tensor, Tensor]:
    """The places and values of the largest values of heat maps that are enlarged to their boxes.

    The answer is that of torchvision's `heatmaps_to_keypoints` up to rounding: of two places whose values
    differ by less than that, either may be it.

    Args:
        maps: (N, K, H, W) logits of K keypoints of N vehicles.
        boxes: (N, 4) xyxy of the vehicles, pixels.

    Returns:
        (N, K, 2) x and y of the peaks, pixels, and (N, K) logits there.
    """
    places = maps.new_zeros(*maps.shape[:2], 2)
    peaks = maps.new_zeros(*maps.shape[:2])
    extents = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1)
    sizes = extents.ceil().int()
    most = _VALUES_AT_ONCE.get(maps.device.type, _VALUES_AT_ONCE["cpu"]) // maps.shape[1]
    for chunk in _chunks(sizes.tolist(), most):
        here = torch.tensor(chunk, device=maps.device)
        cells, peaks[here] = _largest(maps[here], sizes[here])
        places[here] = boxes[here, None, :2] + (cells + 0.5) * (extents[here] / sizes[here])[:, None]
    return places, peaks


def _chunks(sizes: list[list[int]], most: int) -> list[list[int]]:
    """Numbers of the vehicles that are enlarged together: alike in size, so that little is padding."""
    chunks: list[list[int]] = []
    wide = high = 0
    for i in sorted(range(len(sizes)), key=lambda i: max(sizes[i])):
        wide, high = max(wide, sizes[i][0]), max(high, sizes[i][1])
        if not chunks or (len(chunks[-1]) + 1) * wide * high > most:
            chunks.append([])
            wide, high = sizes[i]
        chunks[-1].append(i)
    return chunks


def _largest(maps: Tensor, sizes: Tensor) -> tuple[Tensor, Tensor]:
    """(N, K, 2) column and row, and (N, K) value, of the peaks of maps enlarged to (N, 2) widths and heights."""
    wide, high = sizes.amax(dim=0).tolist()
    across = _enlargement(sizes[:, 0], wide, maps.shape[3])
    down = _enlargement(sizes[:, 1], high, maps.shape[2])
    enlarged = down[:, None] @ maps @ across[:, None].mT
    inside_x = torch.arange(wide, device=maps.device) < sizes[:, :1]
    inside_y = torch.arange(high, device=maps.device) < sizes[:, 1:]
    inside = inside_y[:, None, :, None] & inside_x[:, None, None, :]
    values, at = enlarged.masked_fill_(~inside, -torch.inf).flatten(2).max(dim=2)
    return torch.stack([at % wide, at // wide], dim=-1), values


def _enlargement(sizes: Tensor, longest: int, cells: int) -> Tensor:
    """(N, longest, cells) matrices that enlarge `cells` values to each of the sizes; what is beyond is not used."""
    target = torch.arange(longest, device=sizes.device, dtype=torch.float32)
    at = (target + 0.5) * (cells / sizes[:, None].float()) - 0.5
    low = at.floor()
    share = at - low
    matrix = torch.zeros(len(sizes), longest, cells, device=sizes.device)
    for tap in (-1, 0, 1, 2):
        index = (low + tap).long().clamp(0, cells - 1)
        matrix.scatter_add_(2, index[..., None], _kernel((share - tap).abs())[..., None])
    return matrix


def _kernel(distance: Tensor) -> Tensor:
    """The bicubic kernel at distances of up to two cells."""
    a = _SHARPNESS
    near = ((a + 2) * distance - (a + 3)) * distance * distance + 1
    far = ((a * distance - 5 * a) * distance + 8 * a) * distance - 4 * a
    return torch.where(distance <= 1, near, far)
