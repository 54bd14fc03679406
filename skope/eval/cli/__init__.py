"""The commands of `skope eval`."""
