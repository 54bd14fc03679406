"""The page of `skope eval site`: a camera calibrated by clicking, and what counts on the road drawn into its image."""
