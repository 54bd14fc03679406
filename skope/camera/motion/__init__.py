"""Motion of a camera: image shifts, shake, changes of view, and corrected poses."""
