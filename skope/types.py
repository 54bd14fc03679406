"""Types that the whole package uses; docstrings give the shape of arrays, as in (N, 33, 3)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers of type float64, as nearly all are."""
AnyFloats = NDArray[np.floating[Any]]
"""Numbers of any floating type: depths are float32, places float64."""
Floats32 = NDArray[np.float32]
"""Numbers of type float32: what networks and optical flow take."""
Integers = NDArray[np.int64]
"""Whole numbers, as indices and ids."""
Integers32 = NDArray[np.int32]
"""Whole numbers that are kept by the million."""
Mask = NDArray[np.bool_]
"""Whether something holds, element by element."""
Pixels = NDArray[np.uint8]
"""(H, W, 3) RGB, or (H, W) grey, 0 to 255."""
Range = tuple[float, float]
"""The lowest and the highest value, between which one is drawn."""
