"""Dialogue of the commands: options, messages, progress, tables."""
