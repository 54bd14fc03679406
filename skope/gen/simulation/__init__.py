"""Stage 2: vehicles as bodies, and people, driven past a camera."""
