"""Named streams of random numbers, one for each quantity that is sampled for a recording.

A sample depends only on the dataset's seed, the recording's site and index, and the quantity. An additional sample of
one quantity therefore leaves all others unchanged.
"""

import zlib
from enum import Enum, auto
from typing import Final

import numpy as np


class Stream(Enum):
    """Random streams of a recording, one for each sampled quantity."""

    TRAFFIC = auto()
    """Warm-up time of the traffic before the recording, SUMO's seed, and the route of each vehicle."""
    PEDESTRIANS = auto()
    CROWDS = auto()
    """Labelled pedestrians; used instead of `PEDESTRIANS`."""
    RIDERS = auto()
    """Fraction of the traffic on two wheels, if riders are labelled."""
    TRAFFIC_SHARE = auto()
    """Traffic of a recording, as a fraction of its site's traffic."""
    HEAVY_SHARE = auto()
    """Fraction of lorries and buses in the traffic."""
    PARKED_VEHICLES = auto()
    CONDITIONS = auto()
    """Weather, light, lens and sensor."""
    ASKED_LIGHT = auto()
    """Index of the first of the requested weathers and hours that a site uses."""
    CAMERA = auto()
    """Pose of the camera, if it is not the site's own."""
    VARIANT = auto()
    """Scenery of a simulation's town, if it is sampled again."""
    DISTRACTORS = auto()
    """Number of objects around the cameras that resemble vehicles."""
    LIT_OBJECTS = auto()
    """Number of burning or luminous objects around the cameras at night."""
    SEASON = auto()
    RANDOMISED = auto()
    """Whether ground and walls have random colours and patterns, and which ones."""
    PAINT = auto()
    """Paint of a vehicle in a recording that shares its traffic with others; takes the CRC-32 of its name."""
    SHAPE = auto()
    """Shape of a model in a dataset with views; seeded with the model's name instead of the site's."""
    ROAD_USER = auto()
    """Shape of a vehicle or appearance of a rider; takes the CRC-32 of its name."""
    RAIN = auto()
    """Slant of the rain in the wind, per recording."""
    RAIN_IN_FRAME = auto()
    """Raindrops of a frame; takes the frame."""
    DROPS_ON_GLASS = auto()
    LENS_DIRT = auto()
    SCREEN_GRAPHICS = auto()
    PLACE_NAMES = auto()
    """Place names that an operator overlays on the images."""
    SENSOR_NOISE = auto()
    """Sensor noise of a frame; takes the frame."""


_STREAM_NUMBERS: Final[dict[Stream, tuple[int, ...]]] = {
    Stream.TRAFFIC: (),
    Stream.PEDESTRIANS: (1,),
    Stream.TRAFFIC_SHARE: (2,),
    Stream.HEAVY_SHARE: (21,),
    Stream.PARKED_VEHICLES: (3,),
    Stream.CONDITIONS: (4,),
    Stream.CAMERA: (5,),
    Stream.VARIANT: (6,),
    Stream.PAINT: (7,),
    Stream.SHAPE: (8,),
    Stream.ROAD_USER: (),
    Stream.ASKED_LIGHT: (9,),
    Stream.DISTRACTORS: (14,),
    Stream.LIT_OBJECTS: (22,),
    Stream.SEASON: (15,),
    Stream.RANDOMISED: (16,),
    Stream.RAIN: (11,),
    Stream.RAIN_IN_FRAME: (12,),
    Stream.DROPS_ON_GLASS: (13,),
    Stream.LENS_DIRT: (17,),
    Stream.SCREEN_GRAPHICS: (18,),
    Stream.PLACE_NAMES: (23,),
    Stream.CROWDS: (19,),
    Stream.RIDERS: (20,),
    Stream.SENSOR_NOISE: (),
}
_IN_PICTURES: Final = (
    Stream.RAIN,
    Stream.RAIN_IN_FRAME,
    Stream.DROPS_ON_GLASS,
    Stream.LENS_DIRT,
    Stream.SCREEN_GRAPHICS,
    Stream.PLACE_NAMES,
    Stream.SENSOR_NOISE,
)
"""Streams that are seeded with the letters of the site's name; all others are seeded with its CRC-32."""


def rng(seed: int, site: str, recording: int, stream: Stream, *which: int) -> np.random.Generator:
    """Return the generator of a named stream of a recording.

    Args:
        seed: Seed of the dataset.
        site: Name of the site.
        recording: Index of the recording at the site.
        stream: Quantity to sample.
        which: Further arguments of the stream, such as the number of a vehicle.
    """
    site_key = site.encode() if stream in _IN_PICTURES else (zlib.crc32(site.encode()),)
    return np.random.default_rng([seed, *site_key, recording, *_STREAM_NUMBERS[stream], *which])
