"""Stage 3: render the images of a recording with OpenGL or pybullet's TinyRenderer."""
