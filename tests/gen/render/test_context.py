"""OpenGL contexts: the GPU of a worker, and machines whose EGL has fewer devices than GPUs."""

import pytest

from skope.gen.render.gl import context
from skope.gen.render.gl.context import Device


def test_a_worker_draws_on_the_first_device_if_its_own_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A container with CUDA on eight GPUs, but without NVIDIA's graphics libraries, has only Mesa's device."""
    monkeypatch.setattr(context, "_gpu_number", lambda worker: 7)
    device = Device()
    assert device.context.info["GL_RENDERER"]
    device.context.release()
