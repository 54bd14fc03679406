"""The OpenGL renderer: moderngl through EGL, the same code on Mesa's llvmpipe and on a GPU."""
