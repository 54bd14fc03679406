"""Vehicles followed through footage."""
