"""Dataset generation from presets and parameters: plans, workers, the dataset under construction, and footage."""
