"""Lit lamps of traffic lights, drawn over a rendered image."""

from collections.abc import Iterator
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.scene.recording import Moment
from skope.gen.scenery.build import Signal
from skope.pictures.draw import SUBPIXEL_BITS
from skope.types import Array

_LAMP: Final = {"r": 0, "u": 0, "y": 1, "g": 2, "s": 2}
"""The lamp that each of SUMO's states lights; the others light none."""
_LAMP_COLORS: Final = ((235, 40, 30), (250, 190, 40), (40, 220, 110))
_RADIUS: Final = 0.1


def lit_signals(
    camera: Camera, moment: Moment, signals: tuple[Signal, ...]
) -> Iterator[tuple[Array, Array, tuple[float, float, float]]]:
    """Place, direction and colour of the lamps that are lit and turned to the camera."""
    for signal, lamp in _lit_heads(camera, moment, signals):
        red, green, blue = ((value / 255) ** 2.2 for value in _LAMP_COLORS[lamp])
        yield signal.lamps[lamp], signal.facing, (red, green, blue)


def _lit_heads(camera: Camera, moment: Moment, signals: tuple[Signal, ...]) -> Iterator[tuple[Signal, int]]:
    """The heads that are turned to the camera, with their lit lamp."""
    for signal in signals:
        lamp = _LAMP.get(moment.signals[signal.program][signal.link].lower())
        if lamp is not None and (camera.position - signal.lamps[0]) @ signal.facing > 0:
            yield signal, lamp


def light_signals(
    rgb: NDArray[np.uint8],
    depth: NDArray[np.floating[Any]],
    camera: Camera,
    moment: Moment,
    signals: tuple[Signal, ...],
    fine: int = 1,
) -> None:
    """Draw the lamps that are lit, turned to the camera and not hidden.

    Args:
        rgb: (H * fine, W * fine, 3), changed in place.
        depth: (H, W) metres.
        camera: The image's camera.
        moment: When it is.
        signals: The town's traffic lights.
        fine: Pixels of `rgb` beside each other in one of `depth`.
    """
    for signal, lamp in _lit_heads(camera, moment, signals):
        pixel, z, valid = camera.project(signal.lamps[lamp])
        if not valid or not camera.inside(pixel):
            continue
        at = pixel * fine
        if z < depth[int(at[1]), int(at[0])] + 0.3:
            radius = max(0.7, _RADIUS * camera.K[0, 0] / z * fine)
            center = np.rint((at - 0.5) * 2**SUBPIXEL_BITS).astype(int).tolist()
            cv2.circle(
                rgb,
                center,
                round(radius * 2**SUBPIXEL_BITS),
                _LAMP_COLORS[lamp],
                -1,
                cv2.LINE_AA,
                SUBPIXEL_BITS,
            )


def light_signals_linear(
    light: NDArray[np.float32],
    depth: NDArray[np.floating[Any]],
    camera: Camera,
    moment: Moment,
    signals: tuple[Signal, ...],
    radiance: float,
) -> None:
    """Draw the lamps into linear light (H, W, 4), in place, with `radiance` of the brightest channel."""
    if not signals:
        return
    shown = np.zeros((*light.shape[:2], 3), dtype=np.uint8)
    light_signals(shown, depth, camera, moment, signals)
    rows, columns = np.nonzero(shown.any(axis=-1))
    light[rows, columns, :3] += radiance * (shown[rows, columns] / np.float32(255)) ** 2.2
