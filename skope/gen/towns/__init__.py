"""Towns: networks, styles and camera sites of the package, and users' own roads."""
