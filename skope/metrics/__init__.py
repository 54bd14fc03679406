"""What a detector's answers are worth against a ground truth; needs NumPy only."""
