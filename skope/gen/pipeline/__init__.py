"""From presets and parameters to a finished dataset: plans, workers, the folder under construction, footage."""
