"""Errors of places everywhere in an image: the radius that holds a place in 90% of the cases."""

from typing import Any, Final

import numpy as np

from skope.camera.uncertain_camera import UncertainCamera
from skope.types import Array

_CELLS: Final = 80
"""Cells across the image."""
_FARTHEST_M: Final = 250.0
"""Beyond this distance nothing is said of places."""


def error_map(known: UncertainCamera) -> dict[str, Any]:
    """Square cells of `cell` pixels, row by row from the top: errors in their middles, metres; None: no road there."""
    camera = known.camera
    cell = max(4, -(-camera.width // _CELLS))
    columns, rows = -(-camera.width // cell), -(-camera.height // cell)
    x, y = np.meshgrid((np.arange(columns) + 0.5) * cell, (np.arange(rows) + 0.5) * cell)
    pixels = np.stack([x, y], axis=-1)
    away = np.linalg.norm(known.places(pixels) - camera.position, axis=-1)
    errors = np.where(away < _FARTHEST_M, known.place_error(pixels), np.nan)
    return {"cell": cell, "columns": columns, "rows": rows, "values": values(errors.ravel())}


def values(errors: Array) -> list[float | None]:
    """Numbers as JSON has them: three digits, None for NaN."""
    return [float(f"{value:.3g}") if np.isfinite(value) else None for value in errors.tolist()]
