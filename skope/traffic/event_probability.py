"""How probable it is that an event happened once, and that events happened that nothing saw.

Until both are fitted by distance, size, class and light on footage with truth, they follow from the track alone and
from what tracking has been measured to miss (docs/from-camera-to-tracks.md, "Names").
"""

from typing import Final

from skope.traffic.trajectories import Trajectory

_MOST_PLACES: Final = 48
"""More places than this say no more."""
_DOUBTED: Final = 0.75
"""Factor for a track with one of `_DOUBTS`."""
_DOUBTS: Final = frozenset({"two_poses", "impossible_motion", "against_traffic"})
MISSED: Final = (1.2, 8.0)
"""The share of road users that are missed, as a Beta distribution: 13% in the mean, 1 to 34% with 90%. Of 57 and 56
vehicles of generated footage 4 were missed by day and 15 in rain, over all distances."""


def event_probability(trajectory: Trajectory) -> float:
    """Probability that an event of this track happened, and is no other track's too.

    By Laplace's rule of succession over the moments at which a place was taken: two say little, many say much.
    """
    places = min(int(trajectory.measured.sum()), _MOST_PLACES)
    seen = (places + 1) / (places + 2)
    doubted = _DOUBTED if _DOUBTS & set(trajectory.flags) else 1.0
    return seen * doubted * trajectory.joined_probability
