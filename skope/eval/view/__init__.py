"""Folders of `skope eval` and `skope eval predict` as the viewer shows them."""
