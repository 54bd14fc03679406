"""Named streams of random numbers, one for each thing that is drawn for a recording.

A draw depends on the dataset's seed, the recording's site and number and on what is drawn, and on nothing else, so that
one more draw for one thing leaves all others as they are.
"""

import zlib
from enum import Enum, auto
from typing import Final

import numpy as np


class Stream(Enum):
    """The random streams of a recording: one for each thing that is drawn."""

    TRAFFIC = auto()
    """Time that traffic runs before the recording, SUMO's seed, and which vehicles drive where."""
    PEDESTRIANS = auto()
    CROWDS = auto()
    """Pedestrians who are labelled, in place of `PEDESTRIANS`."""
    RIDERS = auto()
    """Share of those driving by who ride on two wheels, where riders are labelled."""
    TRAFFIC_SHARE = auto()
    """Traffic of a recording, as a share of its site's."""
    HEAVY_SHARE = auto()
    """Share of lorries and buses in a traffic."""
    PARKED_VEHICLES = auto()
    CONDITIONS = auto()
    """Weather, light, lens and sensor."""
    ASKED_LIGHT = auto()
    """The one of the weathers and hours that were asked for with which a site begins."""
    CAMERA = auto()
    """Pose of the camera, where it is not the site's own."""
    VARIANT = auto()
    """Scenery of a simulation's town, where it is grown anew."""
    DISTRACTORS = auto()
    """Number of things around the cameras that resemble vehicles."""
    LIT_OBJECTS = auto()
    """Number of things around the cameras that burn or shine at night."""
    SEASON = auto()
    RANDOMISED = auto()
    """Whether ground and walls have random colours and patterns, and which."""
    PAINT = auto()
    """The paint of a vehicle before a camera that shares its traffic with others; takes the CRC-32 of the name."""
    SHAPE = auto()
    """One of the shapes that a dataset with views has of a model; in place of the site stands the model's name."""
    ROAD_USER = auto()
    """The shape of a vehicle or the look of a rider; takes the CRC-32 of the name."""
    RAIN = auto()
    """Slant of a recording's rain by the wind."""
    RAIN_IN_FRAME = auto()
    """Takes the frame."""
    DROPS_ON_GLASS = auto()
    LENS_DIRT = auto()
    SCREEN_GRAPHICS = auto()
    PLACE_NAMES = auto()
    """Names of places that an operator draws into the pictures."""
    SENSOR_NOISE = auto()
    """Takes the frame."""


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
"""Streams that are seeded with the letters of the site's name; the others are seeded with its CRC-32."""


def rng(seed: int, site: str, recording: int, stream: Stream, *which: int) -> np.random.Generator:
    """The generator of a named stream of a recording.

    Args:
        seed: Seed of the dataset.
        site: Name of the site.
        recording: Number of the recording at the site.
        stream: What is drawn.
        which: What the stream takes besides, as the number of a vehicle.
    """
    place = site.encode() if stream in _IN_PICTURES else (zlib.crc32(site.encode()),)
    return np.random.default_rng([seed, *place, recording, *_STREAM_NUMBERS[stream], *which])
