"""Backends that compute the detector's costly parts: torch, or a runtime that is faster on CPUs; in which number
format."""
