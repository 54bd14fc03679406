"""Houses, trees, signs, ground and markings, grown from a town's roads."""
