"""What `skope eval` and `skope eval predict` wrote, as the viewer shows it."""
