"""Datasets in the formats of other tools, in both directions: one or two modules per format.

A writer takes a dataset folder and fills an empty folder. A reader takes external files and adds their images and
vehicles to a new dataset (see `skope.gen.formats.dataset_builder`).
"""
