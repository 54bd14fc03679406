"""In how many seconds of an interval the camera saw little: its pictures dark or flat, or of another view."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.traffic.observation import Observation, held_s

DARK: Final = 0.1
"""Pictures of a lower mean brightness show hardly anything. Of 386 generated ones, of all hours and weathers, the
darkest two have 0.089 (a road without lamps) and 0.097; nights with lamps 0.105 and more, as cameras expose longer."""
FLAT: Final = 0.015
"""Pictures of lower contrast show hardly anything. The thickest fog of those pictures, in which only the nearest
vehicles can be told, has 0.010 and 0.012, other fog 0.031 and more, photographs of a car park from above 0.022."""


@dataclass(frozen=True, kw_only=True)
class SightIn:
    """Sight of the camera in an interval; None where nothing was measured in it."""

    dark_s: float | None
    """Seconds in which the picture was dark."""
    flat_s: float | None
    """Seconds in which it had hardly any contrast: fog, a lens that is covered."""
    moved_s: float
    """Seconds of another view than the camera's calibration is of: it had been moved. Nothing is observed then."""
    poor_s: float | None
    """Seconds in which any of these holds."""
    brightness: float | None
    """Mean brightness, from 0 to 1."""
    contrast: float | None
    """Mean contrast."""


def sight_in(observation: Observation, begin_s: float, end_s: float) -> SightIn:
    """Measure how well the camera saw in an interval.

    Args:
        observation: What is known of the footage.
        begin_s: Begin of the interval, seconds.
        end_s: Its end, seconds.
    """
    every = np.union1d(observation.times_s, observation.moved_s)
    moved_s = float(held_s(every, begin_s, end_s, observation.further_s)[np.isin(every, observation.moved_s)].sum())
    times, brightness, contrast = observation.sight.T
    held = held_s(times, begin_s, end_s, observation.further_s)
    if not held.sum() > 0:
        return SightIn(
            dark_s=None, flat_s=None, moved_s=moved_s, poor_s=moved_s or None, brightness=None, contrast=None
        )
    dark, flat = brightness < DARK, contrast < FLAT
    frames = np.concatenate([[-np.inf], every])
    of_moved = np.isin(frames[np.searchsorted(every, times, side="right")], observation.moved_s)
    return SightIn(
        dark_s=float(held[dark].sum()),
        flat_s=float(held[flat].sum()),
        moved_s=moved_s,
        poor_s=moved_s + float(held[(dark | flat) & ~of_moved].sum()),
        brightness=float(np.average(brightness, weights=held)),
        contrast=float(np.average(contrast, weights=held)),
    )


def sight_lines(observation: Observation) -> Iterator[str]:
    """Sentence on how long the camera saw little; none where it always saw."""
    found = sight_in(observation, -np.inf, np.inf)
    parts = {
        "dark": found.dark_s,
        "without contrast": found.flat_s,
        "of another view, as the camera had been moved": found.moved_s,
    }
    told = [f"{seconds:.0f} s {what}" for what, seconds in parts.items() if seconds is not None and seconds >= 0.5]
    if told:
        yield (
            f"the camera saw little: {', '.join(told)}; who crosses then is hardly seen, and intervals do not "
            "tell how many (sight.csv says when)"
        )
