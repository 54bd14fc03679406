"""Datasets in the formats of other tools, both ways: a module for each, or two.

A writer takes a dataset folder and fills an empty one; a reader takes files of elsewhere and adds their images and
vehicles to a new dataset (see `skope.gen.formats.dataset_builder`).
"""
