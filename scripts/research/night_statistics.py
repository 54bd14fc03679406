"""Compare statistics of night images: real cameras, and generated images before and after a change.

    python scripts/research/night_statistics.py real=PHOTOGRAPHS before=data/old/images after=data/new/images

Each group is NAME=PATH of a folder of JPEG or PNG images, searched recursively. The first group is the reference. A row
is one statistic: its median over the images of each group, the reference's 10% to 90% range, and "in" or "out" for
each other group's median. Lengths are in pixels of an image 1280 pixels wide, to which the images are scaled first.
Only noise, blocks and quality are measured on the original file.

| statistic | meaning |
|---|---|
| luma_1 .. luma_99 | percentiles of the luma (ITU-R BT.601), 0 to 255 |
| black, burnt_out | share of pixels with a luma under 12, over 250 |
| noise | standard deviation within flat patches of 24 pixels below a quarter of the height, after a quadratic fit |
| noise_lag_1 .. 3 | its autocorrelation at these distances, pixels |
| flat_blocks | share of JPEG's 8 x 8 blocks in the lower two thirds whose luma is constant, within 1 |
| quality | JPEG quality by the mean of the luma table, libjpeg's scale; none without JPEG files |
| road_red, road_blue | red and blue of these patches over their green |
| glow_half, glow_tenth | distance from a burnt-out lamp at which its glow has fallen to this share |
| glow_blue | blue minus red around it, 1 to 5 pixels away |
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from skope.errors import UserError
from skope.terminal.console import text_table

WIDTH_PX: Final = 1280
PATCH_PX: Final = 24
PERCENTILES: Final = (1, 5, 25, 50, 75, 95, 99)
LAMP_PIXELS: Final = (8, 2000)
"""Smallest and largest burnt-out areas that count as lamps, pixels."""
GLOW_REACH_PX: Final = 20
MOST_LAMPS: Final = 60
LIBJPEG_MEAN: Final = 57.625
"""Mean of libjpeg's luma table at quality 50."""

Floats = NDArray[np.float32]


def statistics_of(path: Path) -> dict[str, float]:
    """Compute the statistics of one image by name, without those that it does not allow."""
    try:
        image = Image.open(path)
        tables: Mapping[int, Sequence[int]] = getattr(image, "quantization", {}) or {}
        rgb = np.asarray(image.convert("RGB"))
    except (OSError, UnidentifiedImageError) as error:
        raise UserError(f"{path}: not a readable image: {error}") from None
    luma = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    out = {f"luma_{p}": float(v) for p, v in zip(PERCENTILES, np.percentile(luma, PERCENTILES), strict=True)}
    out |= {"black": float((luma < 12).mean()), "burnt_out": float((luma > 250).mean())}
    out["flat_blocks"] = flat_blocks(luma)
    if tables:
        out["quality"] = jpeg_quality(tables[0])
    return out | noise_of(rgb, luma) | glow_of(rgb)


def flat_blocks(luma: Floats) -> float:
    """Return the share of 8 x 8 blocks with constant luma (within 1), in the lower two thirds of the image."""
    height, width = (side // 8 for side in luma.shape)
    blocks = luma[: 8 * height, : 8 * width].reshape(height, 8, width, 8)
    spread = np.ptp(blocks, axis=(1, 3))
    return float((spread[height // 3 :] <= 1).mean())


def jpeg_quality(table: Sequence[int]) -> float:
    """Return the quality from 1 to 100 on libjpeg's scale, from the mean of a luma quantisation table."""
    scale = 100 * float(np.mean(table)) / LIBJPEG_MEAN
    return float(np.clip((200 - scale) / 2 if scale < 100 else 5000 / scale, 1, 100))


def noise_of(rgb: NDArray[np.uint8], luma: Floats) -> dict[str, float]:
    """Measure the noise, its autocorrelation and the colour of the flattest patches of medium brightness."""
    fit = _quadratic_residual()
    found = []
    for y in range(luma.shape[0] // 4, luma.shape[0] - PATCH_PX + 1, PATCH_PX):
        for x in range(0, luma.shape[1] - PATCH_PX + 1, PATCH_PX):
            patch = luma[y : y + PATCH_PX, x : x + PATCH_PX]
            if 25 < patch.mean() < 170:
                rest = (fit @ patch.ravel()).reshape(patch.shape)
                color = rgb[y : y + PATCH_PX, x : x + PATCH_PX].reshape(-1, 3).mean(axis=0)
                found.append((float(rest.std()), rest, color))
    found.sort(key=lambda row: row[0])
    # The flattest ones are single-coloured signs and clipped areas.
    chosen = [row for row in found[len(found) // 20 : len(found) // 5 + 1] if row[0] > 0]
    if not chosen:
        return {}
    lags = {
        f"noise_lag_{lag}": float(np.median([_autocorrelation(rest, lag) for _, rest, _ in chosen]))
        for lag in (1, 2, 3)
    }
    red, green, blue = np.median([color for _, _, color in chosen], axis=0)
    color = {"road_red": float(red / green), "road_blue": float(blue / green)}
    return {"noise": float(np.median([sigma for sigma, _, _ in chosen])), **lags, **color}


def _quadratic_residual() -> Floats:
    """Return the matrix (N, N) that removes the best quadratic surface from a patch of N pixels."""
    y, x = (np.mgrid[:PATCH_PX, :PATCH_PX].reshape(2, -1) / PATCH_PX) - 0.5
    terms = np.column_stack([np.ones_like(x), x, y, x * y, x * x, y * y])
    return np.asarray(np.eye(len(x)) - terms @ np.linalg.pinv(terms), dtype=np.float32)


def _autocorrelation(rest: Floats, lag: int) -> float:
    across, down = (rest[:, lag:] * rest[:, :-lag]).mean(), (rest[lag:] * rest[:-lag]).mean()
    return float((across + down) / (2 * rest.var()))


def glow_of(rgb: NDArray[np.uint8]) -> dict[str, float]:
    """Measure how the light around burnt-out lamps falls off, and its colour, in an image scaled to `WIDTH_PX`."""
    size = (WIDTH_PX, round(rgb.shape[0] * WIDTH_PX / rgb.shape[1]))
    scaled = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    luma = cv2.cvtColor(scaled, cv2.COLOR_RGB2GRAY).astype(np.float32)
    count, labels, areas, _ = cv2.connectedComponentsWithStats((luma > 248).astype(np.uint8))
    halves, tenths, blues = [], [], []
    order = areas[1:, cv2.CC_STAT_AREA].argsort()[::-1][:MOST_LAMPS] + 1 if count > 1 else ()
    for lamp in order:
        x, y, width, height, area = areas[lamp].tolist()
        if not LAMP_PIXELS[0] <= area <= LAMP_PIXELS[1] or y < 0.15 * size[1]:
            continue
        rows = slice(max(y - GLOW_REACH_PX, 0), y + height + GLOW_REACH_PX)
        columns = slice(max(x - GLOW_REACH_PX, 0), x + width + GLOW_REACH_PX)
        away = cv2.distanceTransform((labels[rows, columns] != lamp).astype(np.uint8), cv2.DIST_L2, 5)
        near, color = luma[rows, columns], scaled[rows, columns].astype(np.float32)
        rings = [near[(away > d - 0.5) & (away <= d + 0.5)] for d in range(1, GLOW_REACH_PX)]
        if any(not ring.size for ring in rings):
            continue
        profile = np.array([np.median(ring) for ring in rings])
        ground = float(np.median(profile[-6:]))
        if ground > 190:
            continue
        excess = (profile - ground) / (255 - ground)
        halves.append(1 + int((excess >= 0.5).cumprod().sum()))
        tenths.append(1 + int((excess >= 0.1).cumprod().sum()))
        ring = (away > 1) & (away <= 5)
        blues.append(float((color[ring][:, 2] - color[ring][:, 0]).mean()))
    if not halves:
        return {}
    return {
        "glow_half": float(np.median(halves)),
        "glow_tenth": float(np.median(tenths)),
        "glow_blue": float(np.median(blues)),
    }


def images_in(folder: Path) -> list[Path]:
    """Return the images in a folder and its subfolders."""
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in (".jpg", ".jpeg", ".png"))
    if not found:
        raise UserError(f"{folder}: has no JPEG or PNG images")
    return found


def compare(groups: Mapping[str, Sequence[Mapping[str, float]]]) -> list[list[str]]:
    """Build the rows of the table, with a header.

    The columns are the statistic, the range of the first group, then the median of each group.
    """
    reference, *compared = groups
    names = list(dict.fromkeys(name for rows in groups.values() for row in rows for name in row))
    table = [["statistic", f"{reference} 10%", "90%", reference, *(cell for name in compared for cell in (name, ""))]]
    for name in names:
        values = {group: [row[name] for row in rows if name in row] for group, rows in groups.items()}
        reference_values = values[reference]
        low, high = np.percentile(reference_values, (10, 90)) if reference_values else (np.nan, np.nan)
        row = [name, f"{low:.3g}", f"{high:.3g}", f"{np.median(reference_values):.3g}" if reference_values else "-"]
        for group in compared:
            middle = float(np.median(values[group])) if values[group] else np.nan
            row += [f"{middle:.3g}", "in" if low <= middle <= high else "out"]
        table.append(row)
    return table


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("groups", nargs="+", metavar="NAME=FOLDER")
    options = parser.parse_args()
    try:
        groups = {}
        for text in options.groups:
            name, _, folder = text.partition("=")
            if not folder:
                parser.error(f"{text}: expected NAME=FOLDER")
            groups[name] = [statistics_of(path) for path in images_in(Path(folder))]
        head, *rows = compare(groups)
        print("\n".join(text_table(head, rows)))
    except UserError as error:
        parser.exit(2, f"{parser.prog}: {error}\n")


if __name__ == "__main__":
    main()
