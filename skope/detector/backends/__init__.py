"""Backends for the costly parts of the detector: torch or a faster runtime for CPUs, in several number formats."""
