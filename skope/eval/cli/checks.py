"""Refuse numbers of the command line that lie outside of what they may be."""

import math
from typing import Final

from skope.errors import UserError

_MOST_PIXELS: Final = 10_000.0


def numbers_of(flag: str, text: str) -> list[float]:
    """The finite numbers of text such as "0,1,2.5"; a UserError names the flag where it is no such list."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = [math.nan]
    if not all(math.isfinite(value) for value in values):
        raise UserError(f"{flag}: expected numbers, got {text!r}")
    return values


def check_pixels(flag: str, *values: float | None) -> None:
    """Raise a UserError that names the flag unless all values, but for None, can be lengths in an image, pixels."""
    for value in values:
        if value is not None and not 0 <= value <= _MOST_PIXELS:
            raise UserError(f"{flag}: expected pixels from 0 to {_MOST_PIXELS:g}, got {value:g}")


def check_probability(flag: str, value: float) -> None:
    """Raise a UserError that names the flag unless the value is from 0 to 1."""
    if not 0 <= value <= 1:
        raise UserError(f"{flag}: expected a number from 0 to 1, got {value}")
