"""Types for the whole package; docstrings give the shape of arrays, as in (N, 33, 3)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Array of float64, the usual type."""
AnyFloats = NDArray[np.floating[Any]]
"""Array of any floating type: depths are float32, positions float64."""
Floats32 = NDArray[np.float32]
"""Array of float32, for networks and optical flow."""
Integers = NDArray[np.int64]
"""Array of integers, such as indices and ids."""
Integers32 = NDArray[np.int32]
"""Array of small integers, for millions of values."""
Mask = NDArray[np.bool_]
"""Boolean array."""
Pixels = NDArray[np.uint8]
"""(H, W, 3) RGB, or (H, W) grey, 0 to 255."""
Range = tuple[float, float]
"""Minimum and maximum of a range from which a value is sampled."""
