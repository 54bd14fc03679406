"""Random numbers by name: what is drawn for a recording depends on its dataset's seed, its site, its number and on what
it is drawn for, and on nothing else, so that one more draw for one thing leaves all others as they are.
"""

import zlib
from enum import Enum, auto
from typing import Final

import numpy as np


class Stream(Enum):
    """What is drawn at random for a recording."""

    TRAFFIC = auto()
    """How long the traffic runs before the recording, SUMO's seed, and who drives where."""
    PEDESTRIANS = auto()
    TRAFFIC_SHARE = auto()
    """How much of its site's traffic a recording has."""
    PARKED_VEHICLES = auto()
    CONDITIONS = auto()
    """Weather, light, lens and sensor."""
    CAMERA = auto()
    """Where the camera hangs, when that is not the site's own."""
    ROAD_USER = auto()
    """The shape of a vehicle or the look of a rider; takes the CRC-32 of the name."""
    RAIN = auto()
    """How the wind slants it."""
    RAIN_IN_FRAME = auto()
    """Takes the frame."""
    DROPS_ON_GLASS = auto()
    SENSOR_NOISE = auto()
    """Takes the frame."""


_NUMBERS: Final[dict[Stream, tuple[int, ...]]] = {
    Stream.TRAFFIC: (),
    Stream.PEDESTRIANS: (1,),
    Stream.TRAFFIC_SHARE: (2,),
    Stream.PARKED_VEHICLES: (3,),
    Stream.CONDITIONS: (4,),
    Stream.CAMERA: (5,),
    Stream.ROAD_USER: (),
    Stream.RAIN: (11,),
    Stream.RAIN_IN_FRAME: (12,),
    Stream.DROPS_ON_GLASS: (13,),
    Stream.SENSOR_NOISE: (),
}
_IN_PICTURES: Final = (Stream.RAIN, Stream.RAIN_IN_FRAME, Stream.DROPS_ON_GLASS, Stream.SENSOR_NOISE)
"""These spell the site's name out, the others take its CRC-32."""


def rng(seed: int, site: str, recording: int, stream: Stream, *which: int) -> np.random.Generator:
    """The generator of a stream of the site's recording of that number; `which` is what the stream takes."""
    place = site.encode() if stream in _IN_PICTURES else (zlib.crc32(site.encode()),)
    return np.random.default_rng([seed, *place, recording, *_NUMBERS[stream], *which])
