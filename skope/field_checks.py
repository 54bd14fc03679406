"""Checks of single fields, which raise a UserError that names the field, what was expected and what came."""

import math
from typing import Any, TypeGuard

import numpy as np

from skope.errors import UserError, one_of
from skope.types import Array, Pixels


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value is a finite number that a float holds; true and false are none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # whole numbers have any length
        return False


def array(name: str, value: Any, *shape: int) -> Array:
    """Check a field of numbers.

    Args:
        name: The field, with which the message begins.
        value: Numbers, nested in any way.
        shape: Shape of the result; only how many numbers there are must agree.

    Returns:
        `value` as float64 of that shape.

    Raises:
        UserError: These are not so many finite numbers.
    """
    try:
        result = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{name}: expected numbers, got {str(value)[:60]!r}") from None
    if result.size != math.prod(shape):
        expected = " x ".join(map(str, shape))
        raise UserError(f"{name}: expected {expected} numbers, got {result.size}")
    if not np.isfinite(result).all():
        raise UserError(f"{name}: not all numbers are finite")
    return result.reshape(shape)


def integer(name: str, value: Any, least: int) -> int:
    """Check a field that is a whole number.

    Args:
        name: The field, with which the message begins.
        value: Its value.
        least: Smallest value that is allowed.

    Returns:
        `value`.

    Raises:
        UserError: It is no whole number, is true or false, or is smaller.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise UserError(f"{name}: expected a whole number from {least}, got {value!r}")
    return value


def check_share(name: str, value: float | None) -> None:
    """Raise a UserError unless `value` is None or from 0 to 1."""
    if value is not None and not (is_number(value) and 0 <= value <= 1):
        raise UserError(f"{name}: expected a share from 0 to 1, got {value!r}")


def choice(name: str, value: str | None, choices: tuple[str, ...]) -> None:
    """Check a field that has choices, or is None.

    Args:
        name: The field, with which the message begins.
        value: Its value; None: not set.
        choices: What is allowed.

    Raises:
        UserError: It is set to something else; the message lists the choices.
    """
    if value is not None:
        one_of(name, value, choices)


def check_number(name: str, value: Any) -> None:
    """Raise a UserError unless `value` is a finite number from 0."""
    if not is_number(value) or value < 0:
        raise UserError(f"{name}: expected a number from 0, got {value!r}")


def probability(name: str, value: Any) -> None:
    """Raise a UserError unless `value` is a number from 0 to 1."""
    if not is_number(value) or not 0 <= value <= 1:
        raise UserError(f"{name}: expected a number from 0 to 1, got {value!r}")


def image_pixels(name: str, value: Any) -> Pixels:
    """Check an image that a caller gives as an array.

    Args:
        name: The argument, with which the message begins.
        value: (H, W, 3) RGB pixels of type uint8, with any strides; `bgr[..., ::-1]` has negative ones.

    Returns:
        The same pixels, row by row in memory; a copy only where they were not.

    Raises:
        UserError: It is no array, or one of another shape or type, or has no pixel.
    """
    expected = f"{name}: expected (H, W, 3) RGB pixels of type uint8"
    if not isinstance(value, np.ndarray):
        raise UserError(f"{expected}, got {'None' if value is None else type(value).__name__}")
    got = f"{expected}, got {value.shape} of type {value.dtype}"
    if value.ndim == 3 and value.shape[2] == 3:
        if value.dtype.kind == "f":
            raise UserError(f"{got}: for values from 0 to 1, give (255 * {name}).round().astype(numpy.uint8)")
        if not value.size:
            raise UserError(f"{got}: it is empty")
    if value.ndim != 3 or value.shape[2] != 3 or value.dtype != np.uint8:
        raise UserError(got)
    return np.ascontiguousarray(value)
