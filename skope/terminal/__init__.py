"""Interaction of the commands: options, messages, progress, tables."""
