"""Road users over time: the type that everything shares, and its file."""
