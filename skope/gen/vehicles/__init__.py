"""Vehicle models: the fleet, how each is built, its keypoints, paints and shapes, and models that users add."""
