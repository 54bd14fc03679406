"""Augment training images with effects of traffic cameras: geometry, light, optics, compression, occluders.

Each step is a function of (pixels, vehicles, generator); those that move pixels move boxes and keypoints with them.
Pixels are (H, W, 3) uint8 sRGB in and out.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache
from statistics import NormalDist
from types import MappingProxyType
from typing import Final

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from skope.errors import UserError
from skope.train.targets import Vehicles
from skope.types import Array, Pixels

_PIXEL_LEVELS: Final = np.arange(256, dtype=np.uint8)
"""All 256 values of a pixel, the input of lookup tables."""

_NORMAL_LEVELS: Final = np.array([NormalDist().inv_cdf((k + 0.5) / 256) for k in range(256)])
"""Quantiles of the standard normal distribution for the 256 values of a random byte."""


@dataclass(frozen=True)
class CropRules:
    """Margins and cuts of cropped images."""

    margin_rows: int = 5
    """Number of rows to which the image is reduced for the margin around it, so that nothing in it is recognisable."""
    cutting_share: float = 0.25
    """Fraction of the crops with an edge through a vehicle. They are enlarged by 1.5 or more."""
    least_cut_height: float = 0.05
    """Minimum height of a vehicle that is cut, as a share of the image height."""


CROP_RULES: Final = CropRules()


Step = Callable[[Pixels, Vehicles, np.random.Generator], tuple[Pixels, Vehicles]]


@dataclass(frozen=True, kw_only=True)
class Augment:
    """Probabilities of each change to an image, from 0 to 1."""

    flip: float = 0.5
    """Mirror the image: left and right are exchanged."""
    crop: float = 0.0
    """Random scale from 0.3 to 2.5 and random crop, which can cut vehicles; the size of the image is kept."""
    occluders: float = 0.0
    """Flat rectangles in front of parts of vehicles: the points under them are hidden."""
    color: float = 0.0
    """Change saturation, hue and white balance."""
    brightness: float = 0.0
    """Exposure from -2.5 to 1.5 stops, and gamma: from glare to night."""
    spectrum: float = 0.0
    """Change the strength of each spatial frequency, most for fine ones, where rendered and real surfaces differ."""
    filters: float = 0.0
    """Blend with the image filtered by a random 3x3 kernel."""
    infrared: float = 0.0
    """Make the image grey, like that of a night camera."""
    rain: float = 0.0
    """Draw bright streaks like rain."""
    blur: float = 0.0
    """Blur from wrong focus or motion."""
    noise: float = 0.0
    """Sensor noise, independent per channel or equal in all channels."""
    resample: float = 0.0
    """Reduce the image to at least a fifth and enlarge it again; in half of the cases sharpened with halos."""
    jpeg: float = 0.0
    """Compress as JPEG of quality 8 to 80."""
    video: float = 0.0
    """Blocks of a video encoder at a low bit rate: some macroblocks are much coarser than others."""
    clean: float = 0.0
    """Leave light, optics and compression unchanged, regardless of the other probabilities."""
    reduce: float = 0.0
    """Reduce images larger than the network's input to that size first, so that all further steps take less time."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0 <= value <= 1:
                raise UserError(f"{field.name}: expected a probability from 0 to 1, got {value}")

    def apply(
        self, pixels: Pixels, vehicles: Vehicles, rng: np.random.Generator, scale: float = 1.0
    ) -> tuple[Pixels, Vehicles]:
        """Return the image and its vehicles after the steps that the generator selects.

        Args:
            pixels: (H, W, 3) sRGB.
            vehicles: Road users in the image, in its pixels.
            rng: Random generator that selects the steps and their strengths.
            scale: Size of the image inside the network relative to its own size; `reduce` applies below 1.
        """
        # With a separate generator, the other random numbers do not depend on it.
        reduced = scale < 1 and rng.spawn(1)[0].random() < self.reduce
        size = _size(pixels, scale if reduced else 1.0)
        clean = rng.random() < self.clean
        for name, step in AUGMENT_STEPS.items():
            # Sampled for every step, so that the probability of one step does not affect other steps.
            chosen, step_rng = rng.random() < getattr(self, name), np.random.default_rng(rng.integers(2**63))
            if name == "crop":
                # One interpolation for both, so that an enlarged part is as sharp as the image allows.
                pixels, vehicles = (
                    _part(pixels, vehicles, step_rng, size) if chosen else _resized(pixels, vehicles, size)
                )
            elif chosen and (name in GEOMETRIC_STEPS or not clean):
                pixels, vehicles = step(pixels, vehicles, step_rng)
        return pixels, vehicles


# ------------------------------------------------------------------------------------------------------------ geometry


def _flip(pixels: Pixels, vehicles: Vehicles, rng: np.random.Generator) -> tuple[Pixels, Vehicles]:
    return _pixels(cv2.flip(pixels, 1)), vehicles.flipped(pixels.shape[1])


def _size(pixels: Pixels, scale: float) -> tuple[int, int]:
    """Return width and height of an image at a scale."""
    height, width = pixels.shape[:2]
    return max(1, round(width * scale)), max(1, round(height * scale))


def _resized(pixels: Pixels, vehicles: Vehicles, size: tuple[int, int]) -> tuple[Pixels, Vehicles]:
    """Return the whole image at another (width, height), resized as the network would."""
    height, width = pixels.shape[:2]
    if size == (width, height):
        return pixels, vehicles
    factors = (size[0] / width, size[1] / height)
    return _pixels(cv2.resize(pixels, size)), vehicles.cropped((0.0, 0.0), factors, *size)


def _crop(pixels: Pixels, vehicles: Vehicles, rng: np.random.Generator) -> tuple[Pixels, Vehicles]:
    return _part(pixels, vehicles, rng, _size(pixels, 1.0))


def _part(
    pixels: Pixels, vehicles: Vehicles, rng: np.random.Generator, size: tuple[int, int]
) -> tuple[Pixels, Vehicles]:
    """Return a part of the view, or more than the view, at another scale, as an image of `size` (width, height)."""
    height, width = pixels.shape[:2]
    cutting = rng.random() < CROP_RULES.cutting_share
    scale = float(np.exp(rng.uniform(np.log(1.5 if cutting else 0.3), np.log(2.5))))
    part = np.array([width, height]) / scale
    room = [width, height] - part  # negative: the image leaves a margin
    corner = np.minimum(room, 0) + rng.random(2) * np.abs(room)
    if cutting:
        corner = _cutting(corner, part, room, vehicles.boxes_xyxy, rng)
    factors = size / part
    # OpenCV counts the centre of a pixel as i, skope as i + 0.5.
    shift = -corner * factors + 0.5 * factors - 0.5
    matrix = np.array([[factors[0], 0, shift[0]], [0, factors[1], shift[1]]])
    if scale < 1:
        moved = _margin(pixels, size)
        # Without this, every other pixel would be skipped.
        pixels = _pixels(cv2.GaussianBlur(pixels, (0, 0), 0.5 * (scale**-2 - 1) ** 0.5 + 1e-3))
        cv2.warpAffine(pixels, matrix, size, dst=moved, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_TRANSPARENT)
    else:
        moved = _pixels(cv2.warpAffine(pixels, matrix, size, borderMode=cv2.BORDER_REPLICATE))
    enlarged = (float(factors[0]), float(factors[1]))
    return moved, vehicles.cropped((float(corner[0]), float(corner[1])), enlarged, *size)


def _margin(pixels: Pixels, size: tuple[int, int]) -> Pixels:
    """Return blurred surroundings of a reduced image (width, height): its colours, without recognisable content."""
    height, width = pixels.shape[:2]
    few = (max(1, round(CROP_RULES.margin_rows * width / height)), CROP_RULES.margin_rows)
    tiny = cv2.resize(pixels, few, interpolation=cv2.INTER_AREA)
    return _pixels(cv2.resize(tiny, size, interpolation=cv2.INTER_CUBIC))


def _cutting(corner: Array, part: Array, room: Array, boxes_xyxy: Array, rng: np.random.Generator) -> Array:
    """Return a corner (2,) for a part of the image whose edge passes through a large vehicle, if there is one.

    Args:
        corner: (2,) original corner, from 0 to `room`.
        part: (2,) width and height of the part.
        room: (2,) width and height of the image minus those of the part.
        boxes_xyxy: (N, 4) boxes of the vehicles.
        rng: Random generator that selects vehicle and edge.
    """
    height = part[1] + room[1]
    high = boxes_xyxy[boxes_xyxy[:, 3] - boxes_xyxy[:, 1] >= CROP_RULES.least_cut_height * height]
    if not len(high):
        return corner
    box = rng.choice(high)
    through = box[:2] + rng.uniform(0.2, 0.8, 2) * (box[2:] - box[:2])
    # Near and far edge of either axis, if the image extends far enough.
    ways = [(axis, through[axis] - far * part[axis]) for axis in (0, 1) for far in (0, 1)]
    ways = [(axis, at) for axis, at in ways if 0 <= at <= room[axis]]
    out = corner.copy()
    if ways:
        axis, at = ways[rng.integers(len(ways))]
        out[axis] = at
        # Along the other axis, the vehicle is inside the part.
        other_axis = 1 - axis
        out[other_axis] = np.clip(through[other_axis] - rng.random() * part[other_axis], 0, room[other_axis])
    return out


def _occluders(pixels: Pixels, vehicles: Vehicles, rng: np.random.Generator) -> tuple[Pixels, Vehicles]:
    pixels = pixels.copy()
    for box in vehicles.boxes_xyxy[rng.random(len(vehicles.boxes_xyxy)) < 0.5]:
        size = (box[2:] - box[:2]) * rng.uniform(0.15, 0.5, 2)
        corner = box[:2] + rng.random(2) * (box[2:] - box[:2] - size)
        cover = np.rint([*corner, *(corner + size)])
        x0, y0, x1, y1 = cover.astype(int)
        shade = rng.integers(0, 256, 3) + rng.normal(0, 8, (max(0, y1 - y0), max(0, x1 - x0), 3))
        pixels[y0:y1, x0:x1] = _bytes(shade)
        vehicles = vehicles.covered(cover)
    return pixels, vehicles


# --------------------------------------------------------------------------------------------------------- light, glass


def _photometric(change: Callable[[Pixels, np.random.Generator], Pixels]) -> Step:
    """Step that does not move pixels."""
    return lambda pixels, vehicles, rng: (change(pixels, rng), vehicles)


def _color(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    levels = _PIXEL_LEVELS.astype(np.float32)
    hue = (levels + rng.uniform(-12, 12)) % 180  # OpenCV's hue has half degrees
    turned = np.stack([hue, levels * rng.uniform(0, 1.6), levels], axis=-1)
    hsv = cv2.LUT(cv2.cvtColor(pixels, cv2.COLOR_RGB2HSV), _bytes(turned)[None])
    balance = _bytes(_PIXEL_LEVELS[:, None] * rng.uniform(0.8, 1.2, 3))
    return _pixels(cv2.LUT(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), balance[None]))


def _brightness(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    linear = (_PIXEL_LEVELS / np.float32(255)) ** np.float32(2.2) * np.float32(2 ** rng.uniform(-2.5, 1.5))
    return _pixels(cv2.LUT(pixels, _bytes(255 * np.clip(linear, 0, 1) ** (rng.uniform(0.6, 1.6) / 2.2))))


def _spectrum(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    """Change amplitudes of spatial frequencies: the finer a frequency, the larger the change can be.

    PASTA (Chattopadhyay et al., ICCV 2023) with alpha up to 3, k 2 and beta 0.25, as in the paper. The mean colour is
    kept, because brightness is a separate step.
    """
    height, width = pixels.shape[:2]
    fineness = _fineness(height, width)
    gain = rng.standard_normal(fineness.shape, dtype=np.float32)
    gain *= np.float32(rng.uniform(0, 3) ** 2) * fineness + np.float32(0.25)
    gain += 1
    np.maximum(gain, 0, out=gain)
    gain[0, 0] = 1
    spectrum = torch.fft.rfft2(torch.as_tensor(pixels.transpose(2, 0, 1)).float())
    changed = torch.fft.irfft2(spectrum.mul_(torch.as_tensor(gain)), s=(height, width))
    levels = changed.round_().clamp_(0, 255).to(torch.uint8)
    return np.ascontiguousarray(levels.numpy().transpose(1, 2, 0))


@lru_cache(maxsize=4)
def _fineness(height: int, width: int) -> NDArray[np.float32]:
    """Return (H, W // 2 + 1) squared spatial frequencies of an image, relative to the finest one."""
    down, right = np.fft.fftfreq(height), np.fft.rfftfreq(width)
    return ((down[:, None] ** 2 + right**2) / 0.5).astype(np.float32)


def _filters(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    kernel = rng.standard_normal((3, 3))
    kernel += kernel[::-1, ::-1]  # symmetric, so that nothing shifts
    kernel /= np.sign(kernel.sum()) * max(abs(kernel.sum()), 0.5)
    share = rng.uniform(0, 0.6)
    kernel *= share
    kernel[1, 1] += 1 - share
    return _pixels(cv2.filter2D(pixels, -1, kernel, borderType=cv2.BORDER_REPLICATE))


def _infrared(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    weights = rng.dirichlet([2, 2, 2])
    grey = (pixels @ weights - 128) * rng.uniform(0.8, 1.3) + 128
    return np.repeat(_bytes(grey)[..., None], 3, axis=-1)


def _rain(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    height, width = pixels.shape[:2]
    veil = np.zeros((height, width), np.uint8)
    slant, length = rng.uniform(-0.3, 0.3), height * rng.uniform(0.02, 0.08)
    for _ in range(int(rng.integers(50, 400) * height * width / 640 / 360)):
        x, y = rng.random(2) * [width, height]
        end = (int(x + slant * length), int(y + length))
        cv2.line(veil, (int(x), int(y)), end, int(rng.integers(40, 160)), 1, cv2.LINE_AA)
    share = cv2.GaussianBlur(veil, (3, 3), 0)[..., None] / np.float32(255)
    return _bytes(pixels * (1 - share) + 215 * share)


def _blur(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    reach = 2 + pixels.shape[0] / 360
    if rng.random() < 0.5:
        return _pixels(cv2.GaussianBlur(pixels, (0, 0), rng.uniform(0.4, 0.75 * reach)))
    size = 2 * int(rng.integers(1, 1 + 1.75 * reach)) + 1  # odd, so that the kernel has a centre and nothing shifts
    turn = cv2.getRotationMatrix2D(((size - 1) / 2, (size - 1) / 2), rng.uniform(0, 180), 1)
    row = np.zeros((size, size), np.float32)
    row[size // 2] = 1
    kernel = cv2.warpAffine(row, turn, (size, size))
    return _pixels(cv2.filter2D(pixels, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE))


def _noise(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    alike = rng.random() < 0.5
    levels = np.rint(rng.uniform(2, 25) * _NORMAL_LEVELS).astype(np.int16)
    shape = pixels.shape[:2] if alike else pixels.shape
    # Looking up a byte takes a fifth of the time of drawing a normal number.
    grain = levels[np.frombuffer(rng.bytes(math.prod(shape)), np.uint8).reshape(shape)]
    return _pixels(cv2.add(pixels, cv2.merge([grain] * 3) if alike else grain, dtype=cv2.CV_8U))


# ---------------------------------------------------------------------------------------------------------- compression


def _resample(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    height, width = pixels.shape[:2]
    factor = rng.uniform(0.2, 0.9)
    small = cv2.resize(pixels, (round(width * factor), round(height * factor)), interpolation=cv2.INTER_AREA)
    large = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    if rng.random() < 0.5:
        halo = rng.uniform(0, 1.5)
        large = cv2.addWeighted(large, 1 + halo, cv2.GaussianBlur(large, (0, 0), 1 / factor), -halo, 0)
    return _pixels(large)


def _jpeg(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    return _recoded(pixels, int(rng.integers(8, 81)))


def _video(pixels: Pixels, rng: np.random.Generator) -> Pixels:
    height, width = pixels.shape[:2]
    coarse, fine = _recoded(pixels, int(rng.integers(4, 15))), _recoded(pixels, int(rng.integers(35, 75)))
    # Neighbouring macroblocks (16 x 16 pixels) are changed alike, as by an encoder's rate control.
    grid = rng.random((-(-height // 64) + 1, -(-width // 64) + 1)).repeat(4, axis=0).repeat(4, axis=1)
    fate = grid + rng.normal(0, 0.15, grid.shape) < rng.uniform(0.3, 0.8)
    mask = fate.repeat(16, axis=0).repeat(16, axis=1)[:height, :width, None]
    return np.where(mask, coarse, fine)


def _recoded(pixels: Pixels, quality: int) -> Pixels:
    done, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    return _pixels(cv2.imdecode(data, cv2.IMREAD_COLOR_RGB))


def _pixels(values: object) -> Pixels:
    """Return OpenCV's result as uint8, because its type stubs are less specific."""
    return np.asarray(values, dtype=np.uint8)


def _bytes(values: NDArray[np.generic]) -> Pixels:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)  # type: ignore[no-any-return]


GEOMETRIC_STEPS: Final[dict[str, Step]] = {"flip": _flip, "crop": _crop, "occluders": _occluders}
"""Steps that move or cover pixels; they also apply to images without photometric changes."""
PHOTOMETRIC_STEPS: Final = {
    "color": _color,
    "brightness": _brightness,
    "spectrum": _spectrum,
    "filters": _filters,
    "infrared": _infrared,
    "rain": _rain,
    "blur": _blur,
    "noise": _noise,
    "resample": _resample,
    "jpeg": _jpeg,
    "video": _video,
}
"""Changes that do not move pixels."""
AUGMENT_STEPS: Final = MappingProxyType(
    {**GEOMETRIC_STEPS, **{name: _photometric(change) for name, change in PHOTOMETRIC_STEPS.items()}}
)
"""Steps by name, in physical order: scene, light, lens and sensor, encoder."""
assert (*AUGMENT_STEPS, "clean", "reduce") == tuple(field.name for field in fields(Augment))
