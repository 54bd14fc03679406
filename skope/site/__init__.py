"""Read and write a site file: camera, calibration marks, lanes, gates and zones.

Generation and evaluation share it: see docs/own-road.md for the keys.
"""
