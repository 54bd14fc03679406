"""Stage 3: pictures of a recording, by OpenGL or by pybullet's TinyRenderer."""
