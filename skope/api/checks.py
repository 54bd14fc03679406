"""Checks of arguments: one line that names the argument, what was expected, and what came."""

import math

from skope.errors import UserError


def in_range(name: str, value: float, least: float, most: float) -> None:
    """Raise a UserError unless an argument's value is a number from `least` to `most`."""
    if not isinstance(value, int | float) or not least <= value <= most:
        to = "" if math.isinf(most) else f" to {most:g}"
        raise UserError(f"{name}: expected a number from {least:g}{to}, got {value!r}")
