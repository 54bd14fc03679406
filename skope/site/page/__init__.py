"""The page of `skope eval site`: calibrate a camera by clicking, and draw gates, zones and lanes into its image."""
