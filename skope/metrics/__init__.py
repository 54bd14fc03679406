"""Metrics of detections and keypoints against ground truth; they need NumPy only."""
