"""A camera that moves: image shifts, shake, changes of view, and poses corrected for them."""
