"""Photographs in a page, with vehicles drawn over them as SVG with constant line widths."""

import base64
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from skope import keypoints
from skope.boxes import xywh_to_xyxy
from skope.dataset.folder import read_image
from skope.page.svg import path_svg, tag
from skope.types import Array, Mask


@dataclass(frozen=True)
class EmbeddedImage:
    """Size of embedded images and of the letters on them."""

    longest_px: int = 960
    """Longer side, pixels."""
    jpeg_quality: int = 78
    letters: float = 11.0
    """Size of letters, in multiples of `unit`."""
    letter_width: float = 0.6
    """Mean width of a semi-bold letter of a sans-serif font, in sizes."""
    lines_away: int = 12
    """Maximum distance of a text from its box, lines."""


EMBEDDED_IMAGE: Final = EmbeddedImage()


def embedded(path: Path, size: tuple[int, int]) -> str:
    """Return an image file of `size` (width, height) as a data URL.

    Raises UserError if the file is not such an image.
    """
    return jpeg(read_image(path, size))


def jpeg(
    pixels: NDArray[np.uint8], *, longest: int = EMBEDDED_IMAGE.longest_px, quality: int = EMBEDDED_IMAGE.jpeg_quality
) -> str:
    """Encode an image as a data URL.

    Args:
        pixels: (H, W, 3) RGB.
        longest: Maximum length of the longer edge, pixels; larger images are scaled down.
        quality: JPEG quality, 0 to 100.

    Returns:
        A `data:` URL.
    """
    data = encoded_jpeg(pixels, longest=longest, quality=quality)
    return "data:image/jpeg;base64," + base64.b64encode(data).decode()


def encoded_jpeg(pixels: NDArray[np.uint8], *, longest: int, quality: int) -> bytes:
    """Encode an image as JPEG.

    Args:
        pixels: (H, W, 3) RGB.
        longest: Maximum length of the longer edge, pixels; a larger image is scaled down.
        quality: JPEG quality, 0 to 100.
    """
    scale = min(1.0, longest / max(pixels.shape[:2]))
    if scale < 1:
        pixels = np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    done, data = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return bytes(data.tobytes())


def drawing(layers: Sequence[str], size: tuple[int, int]) -> Markup:
    """Return layers as one drawing over a photograph of `size` (width, height)."""
    return tag("svg", *layers, viewBox="0 0 {} {}".format(*size), aria_hidden="true", preserveAspectRatio="none")


def unit(width: int) -> float:
    """Return the unit of sizes in a drawing over an image of `width` pixels."""
    return max(1.0, width / 640)


def box_svg(box_xywh: ArrayLike, name: str | None = None) -> Markup:
    """Return a rectangle with the tooltip `name`."""
    x, y, w, h = (round(float(v), 1) for v in np.asarray(box_xywh))
    return tag("rect", x=x, y=y, width=max(w, 0), height=max(h, 0), data_tip=name)


def points(
    at: Array,
    placed: Mask,
    sure: Mask,
    joined: Mask,
    scale: float,
    skeleton: Sequence[tuple[int, int]],
    shown: Collection[int] = range(keypoints.K),
) -> Markup:
    """Return keypoints of a vehicle as SVG paths.

    Args:
        at: (33, 2 or more) x, y.
        placed: (33,) whether a keypoint has a position and gets a mark.
        sure: (33,) whether the mark is a dot; otherwise a ring.
        joined: (33,) whether the skeleton connects the keypoint.
        scale: `unit` of the drawing.
        skeleton: Pairs of keypoints.
        shown: Indices of the drawn keypoints.
    """
    edges = "".join(
        f"M{path_point(at[a])}L{path_point(at[b])}"
        for a, b in skeleton
        if a in shown and b in shown and joined[a] and joined[b]
    )
    r = 1.6 * scale
    ring = f"m{-r:g} 0a{r:g} {r:g} 0 1 0 {2 * r:g} 0a{r:g} {r:g} 0 1 0 {-2 * r:g} 0"
    dots = "".join(f"M{path_point(at[k])}h0" for k in shown if placed[k] and sure[k])
    rings = "".join(f"M{path_point(at[k])}{ring}" for k in shown if placed[k] and not sure[k])
    return path_svg(edges, "edges") + path_svg(rings, "rings") + path_svg(dots, "dots")


def path_point(point: Array) -> str:
    """Format x and y of a position (2 or more,) for an SVG path."""
    return f"{point[0]:.1f} {point[1]:.1f}"


def labels_svg(of: Sequence[tuple[ArrayLike, str]], size: tuple[int, int]) -> Markup:
    """Draw a text for each box in an image of `size` (width, height), near its box and clear of the other texts.

    A text is above its box, else below it, else as little higher or lower as possible, with a line to the box. The
    texts of tall boxes, which are near, are placed first.
    """
    width, height = size
    letters = EMBEDDED_IMAGE.letters * unit(width)
    high = 1.25 * letters
    taken: list[Array] = []
    out = []
    for box_xywh, text in sorted(of, key=lambda pair: -float(np.asarray(pair[0])[3])):
        x0, y0, _, y1 = xywh_to_xyxy(box_xywh)
        long = EMBEDDED_IMAGE.letter_width * letters * len(text)
        left = float(np.clip(x0, 0.0, max(0.0, width - long)))
        above, below = y0 - high, y1 + 0.1 * high
        tops = [
            above,
            below,
            *(y for k in range(1, EMBEDDED_IMAGE.lines_away) for y in (above - k * high, below + k * high)),
        ]
        inside = [top for top in tops if 0 <= top <= height - high] or [float(np.clip(above, 0, height - high))]
        places = [np.array([left, top, left + long, top + high]) for top in inside]
        chosen = next(
            (candidate for candidate in places if not any(_overlap(candidate, neighbour) for neighbour in taken)),
            places[0],
        )
        taken.append(chosen)
        _, top, _, bottom = chosen
        if bottom < above:
            out.append(path_svg(f"M{left:.1f} {bottom:.1f}L{x0:.1f} {y0:.1f}", "leader"))
        elif top > below + high:
            out.append(path_svg(f"M{left:.1f} {top:.1f}L{x0:.1f} {y1:.1f}", "leader"))
        out.append(tag("text", text, x=f"{left:.1f}", y=f"{bottom - 0.3 * letters:.1f}", font_size=f"{letters:g}"))
    return Markup().join(out)


def _overlap(a: Array, b: Array) -> bool:
    """Return whether the interiors of two rectangles (4,) xyxy overlap."""
    return bool((np.maximum(a[:2], b[:2]) < np.minimum(a[2:], b[2:])).all())
