"""Synthetic roadside images with 33 keypoints per vehicle, the detector that learns from them, and its measurement."""

__version__ = "0.1.0"
