"""Which renderer there is on this machine."""

from typing import Final

from skope.errors import UserError, one_of
from skope.gen.render.frame import Renderer
from skope.gen.scene.recording import Recording

RENDERERS: Final = ("auto", "gl", "pybullet")


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
