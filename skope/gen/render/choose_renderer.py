"""Choose the renderer that this machine can run, and create it for a recording."""

from collections.abc import Callable
from functools import partial
from typing import Final

from skope.errors import UserError, one_of
from skope.gen.render.frame import Renderer
from skope.gen.scene.recording import Recording

RENDERER_CHOICES: Final = ("auto", "gl", "pybullet")


def choose_renderer(name: str) -> tuple[str, str, str]:
    """Resolve a `--renderer` option.

    Args:
        name: One of `RENDERER_CHOICES`. "auto" selects "gl" if an OpenGL context can be created, else "pybullet".

    Returns:
        "gl" or "pybullet"; the name of its driver (pixels are equal only on equal drivers); a sentence for the user
        about the choice.

    Raises:
        UserError: The renderer does not exist, or `name` is "gl" and no OpenGL context can be created.
    """
    if one_of("--renderer", name, RENDERER_CHOICES) == "pybullet":
        return "pybullet", "TinyRenderer", "renderer pybullet"
    from skope.gen.render.gl.renderer import device

    try:
        return "gl", device().name, f"renderer gl on {device().name}"
    except UserError as error:
        if name == "gl":
            raise
        return "pybullet", "TinyRenderer", f"renderer pybullet (simpler images), because: {error}"


def make_renderer(name: str, recording: Recording, on_light: Callable[[], None] = lambda: None) -> Renderer:
    """Create a renderer for a recording's frames, with the distortion of its lens and the noise of its sensor.

    Args:
        name: "gl" or "pybullet", as `choose_renderer` returns it.
        recording: The recording to draw.
        on_light: Called, possibly more than once, before "gl" computes the light of the recording's scenery. This can
            take most of a minute. Not called if the light is in the cache.
    """
    from skope.gen.render.camera_effects import Sensor

    if name == "gl":
        from skope.gen.render.gl.renderer import GLRenderer

        return Sensor(recording, partial(GLRenderer, on_light=on_light))
    from skope.gen.render.tiny_renderer import TinyRenderer

    assert name == "pybullet"
    return Sensor(recording, TinyRenderer)
