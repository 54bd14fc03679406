"""Running a detector: on datasets, folders, videos and streams."""
