"""Datasets: the folder, the COCO files in it, shards, depth; which of its images are taken."""

from skope.dataset.folder import Dataset as Dataset
from skope.dataset.folder import LabelledImage as LabelledImage
from skope.dataset.folder import open_dataset as open_dataset
from skope.dataset.folder import read_image as read_image
