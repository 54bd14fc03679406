"""Choose the renderer that this machine can run, and make one for a recording."""

from collections.abc import Callable
from functools import partial
from typing import Final

from skope.errors import UserError, one_of
from skope.gen.render.frame import Renderer
from skope.gen.scene.recording import Recording

RENDERER_CHOICES: Final = ("auto", "gl", "pybullet")


def choose_renderer(name: str) -> tuple[str, str, str]:
    """Resolve a `--renderer` flag.

    Args:
        name: One of `RENDERER_CHOICES`. "auto" is "gl" where an OpenGL context can be created, else "pybullet".

    Returns:
        "gl" or "pybullet"; the driver that it draws with (pixels are the same on the same driver only); a sentence
        for the user about the choice.

    Raises:
        UserError: There is no such renderer, or "gl" is asked for and no OpenGL context can be created.
    """
    if one_of("--renderer", name, RENDERER_CHOICES) == "pybullet":
        return "pybullet", "TinyRenderer", "renderer pybullet"
    from skope.gen.render.gl.renderer import device

    try:
        return "gl", device().name, f"renderer gl on {device().name}"
    except UserError as error:
        if name == "gl":
            raise
        return "pybullet", "TinyRenderer", f"renderer pybullet, which is plainer, because: {error}"


def make_renderer(name: str, recording: Recording, on_light: Callable[[], None] = lambda: None) -> Renderer:
    """Make a renderer for a recording's frames, with the distortion of its lens and the noise of its sensor.

    Args:
        name: "gl" or "pybullet", as `choose_renderer` returns it.
        recording: What is drawn.
        on_light: Called, perhaps more than once, before "gl" works out the light of the recording's scenery, which may
            take most of a minute; not called where the cache has it.
    """
    from skope.gen.render.camera_effects import Sensor

    if name == "gl":
        from skope.gen.render.gl.renderer import GLRenderer

        return Sensor(recording, partial(GLRenderer, on_light=on_light))
    from skope.gen.render.tiny_renderer import TinyRenderer

    assert name == "pybullet"
    return Sensor(recording, TinyRenderer)
