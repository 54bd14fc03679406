"""What a renderer makes of a recording's frame; annotation knows nothing else of renderers."""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from skope.errors import UserError, one_of
from skope.gen.recording import Recording

RENDERERS: Final = ("auto", "gl", "pybullet")
SKY: Final = -1
STATIC: Final = 0


@dataclass(frozen=True, eq=False)
class Silhouette:
    """A vehicle's pixels as if nothing stood before it, on a canvas of three times the image's width and height.

    All its visible pixels lie in the mask's rectangle.
    """

    x: int
    """Image column of the mask's first column; negative left of the image."""
    y: int
    mask: NDArray[np.bool_]
    """(h, w)"""


@dataclass(frozen=True, eq=False)
class View:
    """One rendered frame of N vehicles. Depth and ids are sampled at pixel centres."""

    rgb: NDArray[np.uint8]
    """(H, W, 3) sRGB."""
    depth: NDArray[np.float32]
    """(H, W) planar z in metres, sky = +inf."""
    slope: NDArray[np.float32]
    """(H, W, 2) change of depth per pixel to the right and down on the surface shown, metres."""
    ids: NDArray[np.int32]
    """(H, W) `SKY`, `STATIC`, or i + 1 for the frame's i-th vehicle."""
    silhouettes: tuple[Silhouette, ...]
    """N of them."""
    contrast: NDArray[np.float64]
    """(N,) mean absolute difference over the visible pixels between the frame with and without the vehicle, before
    noise, of 255; 0 without visible pixels."""


class Renderer(Protocol):
    """Draws the frames of one recording; the same frame always gives the same view."""

    def render(self, frame: int) -> View: ...


def choose_renderer(name: str) -> tuple[str, str, str]:
    """The renderer of a `--renderer` flag, the driver behind it, and what to say of the choice.

    `auto` is `gl` where an OpenGL context can be had and else `pybullet`; asked for by name, `gl` must be there.
    """
    if one_of("--renderer", name, RENDERERS) == "pybullet":
        return "pybullet", "TinyRenderer", "renderer pybullet"
    from skope.gen.render.gl.renderer import device

    try:
        return "gl", device().name, f"renderer gl on {device().name}"
    except UserError as error:
        if name == "gl":
            raise
        return "pybullet", "TinyRenderer", f"renderer pybullet, which is plainer, because: {error}"


def make_renderer(name: str, recording: Recording) -> Renderer:
    """The renderer of that name (one of `RENDERERS` but "auto") for a recording, seen through its lens and sensor."""
    from skope.gen.render.sensor import Sensor

    if name == "gl":
        from skope.gen.render.gl.renderer import GLRenderer

        return Sensor(recording, GLRenderer)
    from skope.gen.render.tiny import TinyRenderer

    assert name == "pybullet"
    return Sensor(recording, TinyRenderer)
