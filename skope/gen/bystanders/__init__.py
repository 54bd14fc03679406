"""Bystanders: pedestrians, cyclists and motorcyclists."""
