"""The lamps of vehicles that can be lit, as bits."""

from typing import Final

LAMPS: Final = {"low_beam": 1, "brake": 2, "indicator_left": 4, "indicator_right": 8, "reverse": 16}
"""The bit of each lamp in the number that says which of a vehicle's lamps are lit."""
