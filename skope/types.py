"""The array type that the whole package uses."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Numbers of type float64; docstrings give the shape, as in (N, 33, 3)."""
