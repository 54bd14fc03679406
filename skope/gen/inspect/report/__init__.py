"""A page to look at a dataset: its card, its numbers, and images with their labels as layers to switch."""

from skope.gen.inspect.report.page import write_dataset_report

__all__ = ["write_dataset_report"]
