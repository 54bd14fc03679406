"""Stage 5: images, labels and the card of a dataset as files."""
