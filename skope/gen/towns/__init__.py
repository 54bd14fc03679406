"""Towns to drive in: networks, styles and camera sites of the package, and roads of a user's own."""
