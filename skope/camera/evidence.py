"""Marks that a user sets in an image to calibrate a camera, with their standard deviations.

The centre of a pixel is (col + 0.5, row + 0.5). Metres are those of the world, in which the road is the plane z = 0.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.errors import UserError
from skope.records import is_number
from skope.types import Array


@dataclass(frozen=True)
class MarkingErrors:
    """Default standard deviations of marks."""

    pixel: float = 1.5
    """Standard deviation of a point marked in an image, pixels per axis."""
    position_m: float = 0.1
    """Standard deviation of a position read off a map or surveyed, metres along x and y."""
    height_m: float = 0.03
    """Standard deviation of the road's height over its plane, metres."""


MARKING_ERRORS: Final = MarkingErrors()


@dataclass(frozen=True, eq=False)
class MarkedPoint:
    """Point with a known position in the world."""

    pixel: Array
    """(2,) position in the image, pixels."""
    place: Array
    """(3,) position in the world, metres."""
    sigma_px: float = MARKING_ERRORS.pixel
    sigma_m: float = MARKING_ERRORS.position_m
    """Standard deviation of x and y, metres."""
    sigma_z_m: float = MARKING_ERRORS.height_m
    """Standard deviation of z, metres; larger for points above the road with inaccurate heights."""
    name: str = ""

    def __post_init__(self) -> None:
        _floats(self, "points", self.name, pixel=(2,), place=(3,))
        _positive(self, "points", self.name, "sigma_px", "sigma_m", "sigma_z_m")


@dataclass(frozen=True, eq=False)
class MarkedLength:
    """Known distance between two points on the road, for example the length of a marking or the width of a lane."""

    pixels: Array
    """(2, 2) end points, pixels."""
    metres: float
    sigma_m: float = 0.05
    sigma_px: float = MARKING_ERRORS.pixel
    name: str = ""

    def __post_init__(self) -> None:
        _floats(self, "lengths", self.name, pixels=(2, 2))
        _positive(self, "lengths", self.name, "metres", "sigma_m", "sigma_px")


@dataclass(frozen=True, eq=False)
class ParallelLines:
    """Two or more parallel lines on the road."""

    lines: Array
    """(L, 2, 2) two points per line, pixels."""
    sigma_px: float = MARKING_ERRORS.pixel
    name: str = ""

    def __post_init__(self) -> None:
        _floats(self, "parallels", self.name, lines=(-1, 2, 2))
        _positive(self, "parallels", self.name, "sigma_px")
        if len(self.lines) < 2:
            raise UserError(f"{_named('parallels', self.name)}: expected two lines or more, got {len(self.lines)}")


@dataclass(frozen=True, eq=False)
class Vertical:
    """Upright object on the road, for example a post or the corner of a house."""

    pixels: Array
    """(2, 2) foot and top, pixels."""
    metres: float | None = None
    """Height, metres; None: not known."""
    sigma_m: float = 0.1
    sigma_px: float = MARKING_ERRORS.pixel
    name: str = ""

    def __post_init__(self) -> None:
        _floats(self, "verticals", self.name, pixels=(2, 2))
        _positive(self, "verticals", self.name, "sigma_m", "sigma_px", *(["metres"] if self.metres is not None else []))


@dataclass(frozen=True, eq=False)
class CameraPrior:
    """Gaussian prior on camera parameters, for example from vehicle sizes, a data sheet or a measured height."""

    of: tuple[str, ...]
    """Names in `skope.camera.uncertain_camera.CAMERA_PARAMETERS`."""
    mean: Array
    """(M,) means, in the units of the parameters."""
    covariance: Array
    """(M, M) covariance."""
    name: str = ""

    def __post_init__(self) -> None:
        count = len(self.of)
        _floats(self, "priors", self.name, mean=(count,), covariance=(count, count))
        if (np.linalg.eigvalsh(self.covariance) <= 0).any():
            raise UserError(f"{_named('priors', self.name)}: covariance: expected a positive definite matrix")

    @classmethod
    def of_fov(cls, fov_deg: float, sigma_deg: float, width: int) -> "CameraPrior":
        """Return a prior of the horizontal field of view.

        Args:
            fov_deg: Full horizontal field of view before distortion, degrees.
            sigma_deg: Standard deviation of the field of view, degrees.
            width: Width of the images, pixels.

        Returns:
            A Gaussian of the logarithm of the focal length in pixels.
        """
        half = math.radians(fov_deg) / 2
        slope = math.radians(sigma_deg) / math.sin(2 * half)
        return cls(
            ("focal",), np.array([math.log(width / 2 / math.tan(half))]), np.array([[slope**2]]), "field of view"
        )

    @classmethod
    def of_height(cls, metres: float, sigma_m: float) -> "CameraPrior":
        """Return a prior of the camera's height over the road, metres."""
        return cls(("z",), np.array([metres]), np.array([[sigma_m**2]]), "height")

    @classmethod
    def of_lens(cls, focal_px: float, sigma_px: float, k1: tuple[float, float] | None) -> "CameraPrior":
        """Return a prior of the focal length and, if known, of the lens distortion.

        Args:
            focal_px: Focal length, pixels.
            sigma_px: Standard deviation of the focal length, pixels.
            k1: First coefficient of the radial distortion and its standard deviation; None: unknown.

        Returns:
            A Gaussian of the logarithm of the focal length and, if given, of k1, independent of each other.
        """
        rows = [("focal", math.log(focal_px), sigma_px / focal_px), *([("k1", *k1)] if k1 else [])]
        names, mean, sigmas = zip(*rows, strict=True)
        return cls(names, np.array(mean), np.diag(np.square(sigmas)), "lens")


@dataclass(frozen=True, eq=False)
class Evidence:
    """All evidence on a camera with images of one size."""

    size: tuple[int, int]
    """Width and height of the images, pixels."""
    points: tuple[MarkedPoint, ...] = ()
    lengths: tuple[MarkedLength, ...] = ()
    parallels: tuple[ParallelLines, ...] = ()
    verticals: tuple[Vertical, ...] = ()
    priors: tuple[CameraPrior, ...] = ()


def _named(kind: str, name: str) -> str:
    return f"{kind} {name!r}" if name else kind


def _floats(record: object, kind: str, label: str, **shapes: tuple[int, ...]) -> None:
    """Convert fields to float arrays of these shapes; -1 means any length."""
    for name, shape in shapes.items():
        try:
            value = np.asarray(getattr(record, name), dtype=np.float64)
        except (TypeError, ValueError):
            value = np.full(1, np.nan)
        fits = value.ndim == len(shape) and all(b in (-1, a) for a, b in zip(value.shape, shape, strict=True))
        if not fits or not np.isfinite(value).all():
            wanted = " x ".join("N" if n < 0 else str(n) for n in shape)
            raise UserError(f"{_named(kind, label)}: {name}: expected {wanted} finite numbers")
        object.__setattr__(record, name, value)


def _positive(record: object, kind: str, label: str, *names: str) -> None:
    for name in names:
        value = getattr(record, name)
        if not is_number(value) or not value > 0:
            raise UserError(f"{_named(kind, label)}: {name}: expected a number above 0, got {value!r}")


def marked_points(pixels: ArrayLike, places: ArrayLike, names: Iterable[str] = ()) -> tuple[MarkedPoint, ...]:
    """Return marked points with the default standard deviations of manual marks.

    Args:
        pixels: (N, 2) pixels.
        places: (N, 3) positions in the world, metres.
        names: N names; none: the points are numbered from 1.

    Returns:
        N points with the default standard deviations of `MarkedPoint`.

    Raises:
        ValueError: The numbers of positions or names and of pixels differ.
    """
    labels = list(names) or [str(i + 1) for i in range(len(np.asarray(pixels)))]
    rows = zip(np.asarray(pixels), np.asarray(places), labels, strict=True)
    return tuple(MarkedPoint(pixel, position, name=label) for pixel, position, label in rows)
