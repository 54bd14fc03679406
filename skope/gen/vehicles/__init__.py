"""Vehicle models: the fleet, its builders, keypoints, paints and shapes, and models that users add."""
