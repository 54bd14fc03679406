"""The commands of `skope gen`."""
