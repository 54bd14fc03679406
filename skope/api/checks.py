"""Checks of arguments: one line that names the argument, what was expected, and what came."""

import math

from skope.errors import UserError
from skope.field_checks import is_number


def in_range(name: str, value: float, least: float, most: float) -> None:
    """Raise a UserError unless an argument's value is a number from `least` to `most`.

    Args:
        name: The argument's name, with which the message begins.
        value: What the caller gave.
        least: Smallest value that is allowed.
        most: Largest value that is allowed; infinity: there is none.

    Raises:
        UserError: `value` is no number, NaN, or outside the range.
    """
    if not is_number(value) or not least <= value <= most:
        to = "" if math.isinf(most) else f" to {most:g}"
        raise UserError(f"{name}: expected a number from {least:g}{to}, got {value!r}")
