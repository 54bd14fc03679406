"""Peaks of the keypoints' heat maps, for many vehicles at once.

torchvision enlarges the maps of one vehicle after another to the size of its box, and takes the largest value. That
is a small call for each of them, and on a GPU a wait too. Bicubic enlargement is linear in the rows and in the columns,
so that it is a product of three matrices, which runs for all vehicles of a chunk together.
"""

from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import pad

_VALUES_AT_ONCE: Final = {"cuda": 2**27, "cpu": 2**20}
"""Values of enlarged maps that are held together, by the kind of device."""
_KERNEL_CELLS: Final = 2
"""The bicubic kernel reaches over so many cells on either side; beyond a map's edge its last ones are repeated."""
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
    for chunk, *largest in _chunks(sizes.tolist(), most):
        here = torch.tensor(chunk, device=maps.device)
        cells, peaks[here] = _largest(maps[here], sizes[here], *largest)
        places[here] = boxes[here, None, :2] + (cells + 0.5) * (extents[here] / sizes[here])[:, None]
    return places, peaks


def _chunks(sizes: list[list[int]], most: int) -> list[tuple[list[int], int, int]]:
    """Numbers of the vehicles that are enlarged together, alike in size to save padding, and their largest sides."""
    chunks: list[tuple[list[int], int, int]] = []
    for i in sorted(range(len(sizes)), key=lambda i: max(sizes[i])):
        members, width, height = chunks.pop() if chunks else ([], 0, 0)
        wider, higher = max(width, sizes[i][0]), max(height, sizes[i][1])
        if members and (len(members) + 1) * wider * higher > most:
            chunks.append((members, width, height))
            members, wider, higher = [], *sizes[i]
        chunks.append(([*members, i], wider, higher))
    return chunks


def _largest(maps: Tensor, sizes: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """(N, K, 2) column and row, and (N, K) value, of the peaks of maps enlarged to (N, 2) widths and heights.

    `width` and `height` are the largest of these.
    """
    maps = pad(maps, (_KERNEL_CELLS,) * 4, mode="replicate")
    number, keypoints, rows, columns = maps.shape
    wide = maps.reshape(number, keypoints * rows, columns) @ _enlargement(sizes[:, 0], width, columns).mT
    wide = wide.view(number, keypoints, rows, width).transpose(1, 2).reshape(number, rows, keypoints * width)
    enlarged = (_enlargement(sizes[:, 1], height, rows) @ wide).view(number, height, keypoints, width)
    of_row, column = enlarged.max(dim=3)
    values, row = of_row.max(dim=1)
    column = column.gather(1, row[:, None])[:, 0]
    # What lies beyond a map's own size repeats its last row or column.
    return torch.minimum(torch.stack([column, row], dim=-1), sizes[:, None] - 1), values


def _enlargement(sizes: Tensor, longest: int, cells: int) -> Tensor:
    """(N, longest, cells) matrices that enlarge padded cells to each of the sizes, and then repeat the last value."""
    target = torch.arange(longest, device=sizes.device)
    target = torch.minimum(target, sizes[:, None] - 1)
    at = (target + 0.5) * ((cells - 2 * _KERNEL_CELLS) / sizes[:, None]) - 0.5 + _KERNEL_CELLS
    distance = (at[..., None] - torch.arange(cells, device=sizes.device)).abs()
    a = _SHARPNESS
    near = ((a + 2) * distance - (a + 3)) * distance * distance + 1
    far = ((a * distance - 5 * a) * distance + 8 * a) * distance - 4 * a
    return torch.where(distance <= 1, near, far.masked_fill_(distance >= _KERNEL_CELLS, 0.0))
