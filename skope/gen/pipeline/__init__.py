"""From flags and presets to a finished dataset: what is planned, who works on it, what goes on after a stop."""
