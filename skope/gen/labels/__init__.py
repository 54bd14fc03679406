"""Stage 4: keypoints, boxes and occlusion of what stands in an image."""
