"""Position, heading and size of vehicles from their keypoints."""
