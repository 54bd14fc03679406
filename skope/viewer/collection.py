"""A collection to be looked at: splits with their vehicles, what a detector found in them, and where their pictures
come from."""

from collections.abc import Callable
from dataclasses import dataclass

from skope.metrics.keypoint_outcomes import Options
from skope.schema import AnnotationFile, Image, Result
from skope.viewer.pictures import Picture


@dataclass(frozen=True, kw_only=True, eq=False)
class ShownSplit:
    """A split, and what a detector found in its images."""

    file: AnnotationFile
    results: tuple[Result, ...] = ()


@dataclass(frozen=True, kw_only=True, eq=False)
class Collection:
    """Everything that the page goes through, in the order of the splits and of their files."""

    title: str
    """Says what is seen: the dataset and its splits, or the detector and what it was run on."""
    splits: tuple[ShownSplit, ...]
    """At least one; all have the same keypoint scheme."""
    picture: Callable[[Image], Picture]
    """Gives the picture of an image, or raises a UserError that says what is wrong with it."""
    truth: bool = True
    """Whether the vehicles in the files are ground truth; footage has none."""
    options: Options | None = None
    """Options by which detections count and are held against the ground truth; None where there are no predictions."""
