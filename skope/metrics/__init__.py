"""Metrics of detections and keypoints against ground truth; they need NumPy, and SciPy for intervals."""
