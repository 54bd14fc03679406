"""Inspection of datasets, vehicles, towns and the installation; no other package imports it."""
