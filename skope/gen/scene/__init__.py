"""Recordings: their cameras, conditions, sun and road users."""
