"""Settings for what varies between the recordings of a dataset."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from skope.types import Range


@dataclass(frozen=True, kw_only=True)
class Variation:
    """Optional variation between the recordings of a dataset: ranges of random values, and switches.

    By default, only the conditions (light, air, lens and sensor) are sampled, within the ranges of weather and hour.

    `Parameters.variation` holds the variation of a dataset, and `RecordingPlan.variation` that of one recording.
    Dataset cards list these fields among the parameters.
    """

    settings: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of conditions set by `--set` or the preset; all other conditions follow each site's weather and hour."""
    night: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of conditions that the preset uses at night instead of those in `settings`; `--set` overrides both."""
    cameras: Mapping[str, Range] = field(default_factory=dict)
    """Ranges from which each recording's camera is sampled, with the keys of
    `skope.gen.scene.camera_sampling.CAMERA_LIMITS`. Empty to use the sites' own cameras."""
    shape_jitter: bool = False
    """Whether each vehicle gets a random shape close to that of its model."""
    views: int = 0
    """Number of consecutive recordings of one simulated traffic. Each has its own camera at a sampled place in the
    town.

    0: each recording has its own traffic, and its camera is at its site. Only training sites have views; plans of other
    sites always have 0."""
    largest_vehicle: Range | None = None
    """Range of the height of the largest vehicle that a sampled camera sees, as a fraction of the image height.

    None uses `largest_vehicle` of `skope.gen.scene.camera_sampling.CAMERA_SAMPLING`."""
    town_jitter: bool = False
    """Whether the scenery along the roads is sampled again for each simulated traffic. Recordings of one traffic share
    it."""
    distractors: Range | None = None
    """Range of the number of distractors around the cameras: objects that resemble vehicles; None for no objects."""
    lit_objects: Range | None = None
    """Range of the number of burning or luminous objects around the cameras at night; None for no objects.

    If set, the roads also have patches of light and hatched areas."""
    seasons: bool = False
    """Whether grass and leaves have the colours of a season, which is sampled together with the scenery."""
    further_models: bool = False
    """Whether the traffic also has the models of `further_fleet.toml`: more lorries, buses, vans and others."""
    road_users: bool = False
    """Whether pedestrians and riders of two-wheelers are labelled in their own categories.

    If True, there are also more of them, in a greater variety."""
    randomised: float = 0.0
    """Fraction of the simulated traffics with random colours and patterns on ground and walls, 0 to 1."""
