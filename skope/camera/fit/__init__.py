"""Cameras, and the road under them, from vehicles, from marked points and lines, and from known lengths."""
