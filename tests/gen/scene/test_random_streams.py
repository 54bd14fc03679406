"""Random streams: apart from each other, and the same from release to release, as datasets of one seed must be."""

import itertools
import zlib

import numpy as np
import pytest

from skope.gen.scene.random_streams import Stream, rng

TAKES = {
    Stream.ROAD_USER: (zlib.crc32(b"v00007"),),
    Stream.RAIN_IN_FRAME: (4,),
    Stream.SENSOR_NOISE: (4,),
}


def draws(*where: object, stream: Stream) -> tuple[int, ...]:
    return tuple(rng(*where, stream, *TAKES.get(stream, ())).integers(0, 2**62, 4).tolist())


def test_streams_are_apart() -> None:
    places = [(7, "t01_mill_corner", 2), (8, "t01_mill_corner", 2), (7, "t01_main_west", 2), (7, "t01_mill_corner", 3)]
    drawn = [draws(*place, stream=stream) for place, stream in itertools.product(places, Stream)]
    assert len(set(drawn)) == len(places) * len(Stream)
    assert draws(*places[0], stream=Stream.CAMERA) == draws(*places[0], stream=Stream.CAMERA)


CRC, SPELT = [zlib.crc32(b"ab")], [97, 98]


@pytest.mark.parametrize(
    ("stream", "entropy"),
    [
        (Stream.TRAFFIC, [7, *CRC, 2]),
        (Stream.PEDESTRIANS, [7, *CRC, 2, 1]),
        (Stream.TRAFFIC_SHARE, [7, *CRC, 2, 2]),
        (Stream.PARKED_VEHICLES, [7, *CRC, 2, 3]),
        (Stream.CONDITIONS, [7, *CRC, 2, 4]),
        (Stream.ASKED_LIGHT, [7, *CRC, 2, 9]),
        (Stream.CAMERA, [7, *CRC, 2, 5]),
        (Stream.DISTRACTORS, [7, *CRC, 2, 14]),
        (Stream.LIT_OBJECTS, [7, *CRC, 2, 22]),
        (Stream.SEASON, [7, *CRC, 2, 15]),
        (Stream.RANDOMISED, [7, *CRC, 2, 16]),
        (Stream.ROAD_USER, [7, *CRC, 2, zlib.crc32(b"v00007")]),
        (Stream.RAIN, [7, *SPELT, 2, 11]),
        (Stream.RAIN_IN_FRAME, [7, *SPELT, 2, 12, 4]),
        (Stream.DROPS_ON_GLASS, [7, *SPELT, 2, 13]),
        (Stream.PLACE_NAMES, [7, *SPELT, 2, 23]),
        (Stream.SENSOR_NOISE, [7, *SPELT, 2, 4]),
    ],
)
def test_streams_stay_what_they_are(stream: Stream, entropy: list[int]) -> None:
    """Recordings and pictures of a seed come from these numbers: another one here makes other datasets."""
    expected = np.random.default_rng(entropy).integers(0, 2**62, 4)
    assert draws(7, "ab", 2, stream=stream) == tuple(expected.tolist())
