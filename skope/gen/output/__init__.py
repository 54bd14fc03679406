"""Stage 5: writing of images, labels and the dataset card."""
