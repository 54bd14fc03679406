"""Position, heading and size of vehicles from their keypoints, and cameras from vehicles."""
