"""What varies between the recordings of a dataset."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from skope.types import Range


@dataclass(frozen=True, kw_only=True)
class Variation:
    """Things that are drawn at random for each recording, and their ranges; by default, as few as can be.

    A dataset has one, `Parameters.variation`, and so has each of its recordings, `RecordingPlan.variation`. Cards of
    datasets name the fields among the parameters.
    """

    settings: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of conditions that `--set` or the preset gives; the others follow each site's weather and hour."""
    night: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of conditions that the preset gives at night in place of those of `settings`; `--set` goes before both."""
    cameras: Mapping[str, Range] = field(default_factory=dict)
    """Ranges that each recording's camera is drawn from, by the names of
    `skope.gen.scene.camera_sampling.CAMERA_LIMITS`; empty to use the sites' own cameras."""
    shape_jitter: bool = False
    """Whether each vehicle gets a shape of its own near its model's."""
    views: int = 0
    """Number of recordings in a row that share one simulated traffic, each with a camera at another corner of the town;
    0 where cameras hang at their sites and each recording has its own traffic. Only sites for training have views:
    plans of other sites have 0 whatever the dataset has."""
    largest_vehicle: Range | None = None
    """Range of the height of the largest vehicle that a view's camera sees, as a share of the image's; None for
    the field `largest_vehicle` of `skope.gen.scene.camera_sampling.CAMERA_SAMPLING`."""
    town_jitter: bool = False
    """Whether what stands along the roads is drawn anew; recordings that share their traffic share it too."""
    distractors: Range | None = None
    """Range of the number of things around the cameras that resemble vehicles and are none; None for none."""
    lit_objects: Range | None = None
    """Range of the number of things around the cameras that burn or shine at night; None for none. Where there are any,
    there are also patches of light and hatched areas on the roads."""
    seasons: bool = False
    """Whether grass and leaves have the colours of a season, drawn for each town that is drawn anew."""
    further_models: bool = False
    """Whether traffic also has the models of `further_fleet.toml`: more lorries, buses, vans and others."""
    road_users: bool = False
    """Whether people on foot and on two wheels are labelled, in categories of their own, and there are more and other
    ones of them."""
    randomised: float = 0.0
    """Share of the simulated traffics whose ground and walls have random colours and patterns, 0..1."""
