"""Houses, trees, signs, ground and markings, generated from a town's roads."""
