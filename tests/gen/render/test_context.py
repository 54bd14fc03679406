"""OpenGL contexts: the GPU of a worker, machines whose EGL has fewer devices than GPUs, contexts of other code."""

import moderngl
import numpy as np
import pytest

from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.gl import context
from skope.gen.render.gl.context import Device
from skope.gen.render.gl.renderer import device
from tests.gen.scenes import driven


def test_a_worker_draws_on_the_first_device_if_its_own_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A container with CUDA on eight GPUs, but without NVIDIA's graphics libraries, has only Mesa's device."""
    monkeypatch.setattr(context, "_gpu_number", lambda worker: 7)
    second = Device()
    assert second.context.info["GL_RENDERER"]
    second.context.release()


def test_frames_are_drawn_after_other_code_has_used_a_context_of_its_own() -> None:
    renderer = make_renderer("gl", driven(frames=2))
    first = renderer.render(0).rgb
    other = moderngl.create_context(standalone=True, backend="egl")
    texture = other.texture((4, 4), 4, bytes(range(64)))
    np.testing.assert_array_equal(renderer.render(0).rgb, first)
    with other:
        assert texture.read() == bytes(range(64))  # unharmed
    make_renderer("gl", driven(frames=2)).render(1)
    other.release()
    np.testing.assert_array_equal(renderer.render(0).rgb, first)
    device().target((8, 8), ["4f1"]).clear()
