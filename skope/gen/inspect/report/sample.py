"""Choose the images that a page shows: few of many, spread over splits, sites and recordings."""

from collections.abc import Sequence

from skope.schema import Image


def spread(images: Sequence[Image], count: int) -> list[int]:
    """Places of at most `count` images, rising: as many of each split's sites as of any other, evenly over time."""
    groups: dict[tuple[str | None, str | None], list[int]] = {}
    for i, image in enumerate(images):
        groups.setdefault((image.split, image.site), []).append(i)
    own = [sorted(group, key=lambda i: _time(images[i])) for group in groups.values()]
    chosen = [
        group[k]
        for group, share in zip(own, _shares([len(g) for g in own], count), strict=True)
        for k in _even(len(group), share)
    ]
    return sorted(chosen)


def _time(image: Image) -> tuple[str, int]:
    return image.recording or "", image.frame_index or 0


def _shares(sizes: Sequence[int], count: int) -> list[int]:
    """Number of each group, as even as their sizes allow; where there are fewer than groups, some have one."""
    if count < len(sizes):
        having = set(_even(len(sizes), count))
        return [int(k in having) for k in range(len(sizes))]
    shares, left = [0] * len(sizes), min(count, sum(sizes))
    while left:
        open_ = [k for k, size in enumerate(sizes) if shares[k] < size]
        for k in [open_[j] for j in _even(len(open_), min(left, len(open_)))]:
            shares[k] += 1
            left -= 1
    return shares


def _even(size: int, count: int) -> list[int]:
    """`count` of `size` places, evenly spread, each the middle of its part."""
    return [(2 * k + 1) * size // (2 * count) for k in range(count)]
