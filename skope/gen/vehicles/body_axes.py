"""Directions in the vehicle frame: x forward, y left, z up."""

from typing import Final

LEFT_AXIS: Final = (0.0, 1.0, 0.0)
"""Normal of a vehicle's left side."""
