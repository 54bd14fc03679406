"""Datasets: folder, COCO files, shards, depth, and selection of images."""

from skope.dataset.folder import Dataset as Dataset
from skope.dataset.folder import LabelledImage as LabelledImage
from skope.dataset.folder import open_dataset as open_dataset
from skope.dataset.folder import read_image as read_image
