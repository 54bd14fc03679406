"""OpenGL renderer: moderngl through EGL, with the same code on Mesa's llvmpipe and on a GPU."""
