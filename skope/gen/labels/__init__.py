"""Stage 4: keypoints, boxes and occlusion of the objects in an image."""
