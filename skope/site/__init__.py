"""A site file: the camera, what it was calibrated by, lanes, gates, zones; read and saved.

Generating and evaluating share it: see docs/own-road.md for the keys.
"""
