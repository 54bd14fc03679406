"""Video input and output with PyAV: files, folders of images, live streams, a cache of frames, and the writer.

Only this package imports PyAV.
"""
