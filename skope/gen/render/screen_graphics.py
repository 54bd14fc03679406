"""Graphics that operators draw into images in addition to date and name.

They are logos, watermarks, clocks, letters, arrows, bars, and place names with arrows.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np

from skope.gen.scene.random_streams import Stream
from skope.gen.scene.recording import Recording
from skope.types import Pixels

_Draw = Callable[[Pixels, Pixels, np.random.Generator], None]

CAPTION_FONTS: Final = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_PLAIN,
)
CAPTION_LETTERS: Final = "ABCDEFGHJKLMNPRSTUVWXYZ0123456789"


@dataclass(frozen=True)
class OverlayStyle:
    """Captions and watermarks of the stream."""

    least_opacity: float = 0.25
    """Opacity of the faintest watermark."""
    captioned_share: float = 0.6
    """Share of the recordings with graphics that also have place names."""
    least_scale: float = 0.3
    """Minimum scale of OpenCV's letters at which a name is readable."""
    caption_colors: tuple[tuple[int, int, int], ...] = (
        (255, 255, 0),
        (255, 255, 0),
        (250, 250, 250),
        (255, 190, 30),
        (80, 255, 90),
    )
    """Colours of captions, RGB."""


OVERLAY_STYLE: Final = OverlayStyle()

NAME_SYLLABLES: Final = (
    "AR", "BER", "CAS", "CHAN", "DEL", "EAST", "FOR", "GATE", "HA", "JU", "KAL", "LAN", "MER", "NOR", "O", "PAR",
    "RONG", "SEN", "TON", "VAL", "WOOD", "YARD",
)  # fmt: skip
NAME_ENDINGS: Final = ("", "", "", "", " RD", " AVE", " BRIDGE", " EXIT", " DR 12", " N", " CITY")
ARROW_HEAD: Final = np.array([(1.0, 0.0), (-0.75, 0.62), (-0.35, 0.0), (-0.75, -0.62)])
"""Outline of an arrowhead that points to the right; its middle is at the origin, its tip at 1."""


class ScreenGraphics:
    """Graphics in the images of one recording; they do not change between frames."""

    def __init__(self, recording: Recording) -> None:
        count, camera = round(recording.conditions.screen_graphics), recording.camera
        self._ink: Pixels | None = None
        if count:
            rng = recording.rng(Stream.SCREEN_GRAPHICS)
            ink = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
            cover = np.zeros((camera.height, camera.width), dtype=np.uint8)
            for draw in rng.choice(np.array(_GRAPHIC_KINDS, dtype=object), count):
                mark = np.zeros_like(cover)
                draw(ink, mark, rng)
                opaque = rng.choice([1.0, rng.uniform(OVERLAY_STYLE.least_opacity, 1.0)])
                cover = np.maximum(cover, (mark * np.float32(opaque)).astype(np.uint8))
            names_rng = recording.rng(Stream.PLACE_NAMES)
            if names_rng.random() < OVERLAY_STYLE.captioned_share:
                _place_names(ink, cover, names_rng)
            covers = np.repeat(cover[..., None], 3, axis=-1)
            self._seen = np.asarray(cv2.bitwise_not(covers), dtype=np.uint8)
            self._ink = np.asarray(cv2.multiply(ink, covers, scale=1 / 255), dtype=np.uint8)

    def draw(self, rgb: Pixels) -> Pixels:
        """Return the image (H, W, 3) with the graphics over it; the same array if there are none."""
        if self._ink is None:
            return rgb
        return np.asarray(cv2.add(cv2.multiply(rgb, self._seen, scale=1 / 255), self._ink), dtype=np.uint8)


def _color(rng: np.random.Generator) -> tuple[int, int, int]:
    """Return a random colour: mostly white, else black or a bright colour."""
    kind = rng.random()
    if kind < 0.7:
        return (245, 245, 245) if kind < 0.5 else (12, 12, 12)
    red, green, blue = (rng.permutation([255, int(rng.integers(256)), 0])).tolist()
    return red, green, blue


def _word(rng: np.random.Generator, least: int, most: int) -> str:
    return "".join(rng.choice(list(CAPTION_LETTERS), int(rng.integers(least, most + 1))))


def _corner(shape: tuple[int, ...], size: tuple[int, int], rng: np.random.Generator) -> tuple[int, int]:
    """Return the corner position of an item of `size` (width, height) near a corner or an edge."""
    height, width = shape[:2]
    free_x, free_y = max(width - size[0], 0), max(height - size[1], 0)
    x = rng.choice([rng.uniform(0.01, 0.06), rng.uniform(0.94, 0.99), rng.uniform(0.2, 0.8)]) * free_x
    y = rng.choice([rng.uniform(0.01, 0.06), rng.uniform(0.94, 0.99)]) * free_y
    return int(x), int(y)


def _text(ink: Pixels, mark: Pixels, words: str, at: tuple[int, int], scale: float, rng: np.random.Generator) -> None:
    """Write words with their lower left corner at a position."""
    font, thick = int(rng.choice(CAPTION_FONTS)), max(1, round(scale * rng.uniform(1.2, 3.0)))
    cv2.putText(ink, words, at, font, scale, _color(rng), thick, cv2.LINE_AA)
    cv2.putText(mark, words, at, font, scale, 255, thick, cv2.LINE_AA)


def _letters(ink: Pixels, mark: Pixels, rng: np.random.Generator) -> None:
    """Draw large letters, such as the name of a direction, somewhere in the image."""
    height, width = mark.shape
    scale = width / 1920 * rng.uniform(1.5, 6.0)
    at = int(rng.uniform(0.05, 0.85) * width), int(rng.uniform(0.15, 0.95) * height)
    _text(ink, mark, _word(rng, 1, 4), at, scale, rng)


def _boxed(ink: Pixels, mark: Pixels, rng: np.random.Generator) -> None:
    """Draw a clock or a name on a plain box."""
    scale = mark.shape[1] / 1920 * rng.uniform(0.7, 1.8)
    size = int(scale * 320), int(scale * 48)
    x, y = _corner(mark.shape, size, rng)
    for canvas, color in ((ink, _color(rng)), (mark, (255, 255, 255))):
        cv2.rectangle(canvas, (x, y), (x + size[0], y + size[1]), color, -1)
    clock = ":".join(f"{int(n):02d}" for n in rng.integers(0, 60, 3))
    _text(ink, mark, str(rng.choice([clock, _word(rng, 5, 12)])), (x + size[1] // 4, y + size[1] * 3 // 4), scale, rng)


def _logo(ink: Pixels, mark: Pixels, rng: np.random.Generator) -> None:
    """Draw a round or square badge with another shape or a word in it."""
    side = int(mark.shape[1] * rng.uniform(0.03, 0.1))
    x, y = _corner(mark.shape, (side, side), rng)
    middle, is_round = (x + side // 2, y + side // 2), rng.random() < 0.5
    for canvas, color in ((ink, _color(rng)), (mark, (255, 255, 255))):
        if is_round:
            cv2.circle(canvas, middle, side // 2, color, -1, cv2.LINE_AA)
        else:
            cv2.rectangle(canvas, (x, y), (x + side, y + side), color, -1)
    corners = [[x + int(a * side), y + int(b * side)] for a, b in rng.uniform(0.15, 0.85, (int(rng.integers(3, 6)), 2))]
    cv2.fillPoly(ink, [cv2.convexHull(np.array(corners, dtype=np.int32))], _color(rng), cv2.LINE_AA)


def _watermark(ink: Pixels, mark: Pixels, rng: np.random.Generator) -> None:
    """Draw a wide line of text over the middle."""
    height, width = mark.shape
    at = int(0.15 * width), int(rng.uniform(0.35, 0.7) * height)
    _text(ink, mark, " ".join(_word(rng, 3, 8) for _ in range(2)), at, width / 1920 * rng.uniform(2.0, 4.5), rng)


def _arrow(ink: Pixels, mark: Pixels, rng: np.random.Generator) -> None:
    """Draw an arrow that shows the direction of a lane."""
    height, width = mark.shape
    x, y = rng.uniform(0.1, 0.9) * width, rng.uniform(0.2, 0.9) * height
    way = width * rng.uniform(0.03, 0.12) * np.array([np.cos(turn := rng.uniform(0, 2 * np.pi)), np.sin(turn)])
    start, end = (int(x), int(y)), (int(x + way[0]), int(y + way[1]))
    thick = max(1, int(width / 1920 * rng.uniform(3, 14)))
    for canvas, color in ((ink, _color(rng)), (mark, (255, 255, 255))):
        cv2.arrowedLine(canvas, start, end, color, thick, cv2.LINE_AA, tipLength=0.35)


def _bar(ink: Pixels, mark: Pixels, rng: np.random.Generator) -> None:
    """Draw a bar along the upper or lower edge."""
    height, width = mark.shape
    deep = int(height * rng.uniform(0.03, 0.08))
    y = 0 if rng.random() < 0.5 else height - deep
    for canvas, color in ((ink, _color(rng)), (mark, (255, 255, 255))):
        cv2.rectangle(canvas, (0, y), (width, y + deep), color, -1)
    _text(ink, mark, _word(rng, 6, 20), (int(0.02 * width), y + int(0.8 * deep)), deep / 38, rng)


@dataclass(frozen=True)
class _CaptionStyle:
    """Caption style of one operator; all captions of an image share it."""

    ink: tuple[int, int, int]
    scale: float
    font: int
    thickness: int
    boxed: bool
    """Whether captions have a black box behind them. If not, they have a dark outline."""
    pointed: bool
    """Whether an arrowhead beside each caption points along the road."""

    @classmethod
    def drawn(cls, width: int, rng: np.random.Generator) -> Self:
        """Return the random style of an operator for images of this width, pixels."""
        scale = max(
            width / 1920 * float(rng.choice([rng.uniform(0.75, 1.3), rng.uniform(1.2, 2.2)])), OVERLAY_STYLE.least_scale
        )
        ink = OVERLAY_STYLE.caption_colors[int(rng.integers(len(OVERLAY_STYLE.caption_colors)))]
        font = int(rng.choice([cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX]))
        thickness = max(1, round(scale * rng.uniform(1.8, 3.0)))
        return cls(ink, scale, font, thickness, rng.random() < 0.6, rng.random() < 0.85)


def _place_names(ink: Pixels, cover: Pixels, rng: np.random.Generator) -> None:
    """Draw one to four place names over the road, and mostly the operator's plate in a corner.

    Args:
        ink: (H, W, 3) colours, changed in place.
        cover: (H, W) opacities, changed in place.
        rng: Random generator.
    """
    height, width = cover.shape
    style = _CaptionStyle.drawn(width, rng)
    if rng.random() < 0.6:
        _plate(ink, cover, rng)
    # The sum of two draws is mostly near the middle; each strip of the image has one name.
    count = int(rng.integers(1, 5))
    for k in rng.permutation(count):
        name = "".join(rng.choice(NAME_SYLLABLES, int(rng.integers(1, 4)))) + str(rng.choice(NAME_ENDINGS))
        lines = name.split(" ", 1) if rng.random() < 0.3 else [name]
        x = width * (k + rng.uniform(0.1, 0.9)) / count
        y = height * (rng.uniform(0.04, 0.96) + rng.uniform(0.04, 0.96)) / 2
        _caption(ink, cover, lines, (int(x), int(y)), style, rng)


def _caption(
    ink: Pixels,
    cover: Pixels,
    lines: list[str],
    middle: tuple[int, int],
    style: _CaptionStyle,
    rng: np.random.Generator,
) -> None:
    """Write lines around a middle, with an arrowhead beside them."""
    sizes = [cv2.getTextSize(line, style.font, style.scale, style.thickness)[0] for line in lines]
    pad = max(1, round(5 * style.scale))
    step = max(size[1] for size in sizes) + 3 * pad
    top = middle[1] - step * len(lines) // 2
    for k, (line, (long, tall)) in enumerate(zip(lines, sizes, strict=True)):
        left, base = middle[0] - long // 2, top + k * step + tall + pad
        if style.boxed:
            corners = (left - pad, base - tall - pad), (left + long + pad, base + 2 * pad)
            cv2.rectangle(ink, *corners, (0, 0, 0), -1)
            cv2.rectangle(cover, *corners, 255, -1)
        else:
            for canvas, color in ((ink, (10, 10, 10)), (cover, (255, 255, 255))):
                around = style.thickness + 2 * max(1, pad // 2)
                cv2.putText(canvas, line, (left, base), style.font, style.scale, color, around, cv2.LINE_AA)
        cv2.putText(ink, line, (left, base), style.font, style.scale, style.ink, style.thickness, cv2.LINE_AA)
        cv2.putText(cover, line, (left, base), style.font, style.scale, 255, style.thickness, cv2.LINE_AA)
    if style.pointed:
        reach, turn = 0.55 * step, float(rng.uniform(0.0, 2 * np.pi))
        toward = np.array([np.cos(turn), np.sin(turn)])
        half = np.array([max(size[0] for size in sizes) / 2 + pad, step * len(lines) / 2])
        # From the middle to the edge of the lines, and beyond.
        edge = toward * float((half / np.maximum(np.abs(toward), 1e-6)).min())
        R = np.array([[toward[0], toward[1]], [-toward[1], toward[0]]])
        outline = np.rint((np.array(middle) + edge + 1.1 * reach * toward) + reach * ARROW_HEAD @ R).astype(np.int32)
        for canvas, color in ((ink, style.ink), (cover, (255, 255, 255))):
            cv2.fillPoly(canvas, [outline], color, cv2.LINE_AA)
        for canvas, color in ((ink, (10, 10, 10)), (cover, (255, 255, 255))):
            cv2.polylines(canvas, [outline], True, color, max(1, round(1.5 * style.scale)), cv2.LINE_AA)


def _plate(ink: Pixels, cover: Pixels, rng: np.random.Generator) -> None:
    """Draw the operator's plate in an upper corner: two words around an emblem on white."""
    width = cover.shape[1]
    scale = width / 1920 * float(rng.uniform(0.5, 0.8))
    words = [_word(rng, 4, 9).capitalize() for _ in range(2)]
    color = tuple(int(v) for v in rng.integers(20, 130, 3))
    tall, gap = round(60 * scale), round(16 * scale)
    sizes = [cv2.getTextSize(word, cv2.FONT_HERSHEY_COMPLEX, scale, 1)[0][0] for word in words]
    long = sum(sizes) + tall + 4 * gap
    left = 0 if rng.random() < 0.6 else width - long
    cv2.rectangle(ink, (left, 0), (left + long, tall), (255, 255, 255), -1)
    cv2.rectangle(cover, (left, 0), (left + long, tall), 255, -1)
    x, base = left + gap, round(0.66 * tall)
    cv2.putText(ink, words[0], (x, base), cv2.FONT_HERSHEY_COMPLEX, scale, color, 1, cv2.LINE_AA)
    middle = (x + sizes[0] + gap + tall // 2, tall // 2)
    cv2.circle(ink, middle, max(1, round(0.3 * tall)), color, max(1, round(5 * scale)), cv2.LINE_AA)
    cv2.putText(
        ink, words[1], (middle[0] + tall // 2 + gap, base), cv2.FONT_HERSHEY_COMPLEX, scale, color, 1, cv2.LINE_AA
    )


_GRAPHIC_KINDS: Final[tuple[_Draw, ...]] = (_letters, _boxed, _logo, _watermark, _arrow, _bar)
