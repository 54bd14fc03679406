"""Confirm a video's detections by its other frames.

Boxes are linked from frame to frame (`skope.tracking.box_links`). A track with only one or two confident detections is
dropped. Weak detections stay in a track that is confident in most frames. A track that never moves is dropped unless it
has the size of a vehicle. The expected size comes from vehicles that drive through the same position.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from skope import boxes as box_math
from skope.schema import Found
from skope.tracking.box_links import LINK_LIMITS, BoxLinks, size_of
from skope.types import Array, Integers32

SizeSample = tuple[float, float, float]
"""Position of a box on the road, x and y, and its size there, the square root of its area; pixels."""


@dataclass(frozen=True)
class ConfirmationLimits:
    """Limits for confirming detections."""

    fewest_moving: int = 4
    """Minimum number of moving vehicles that give the expected size of others."""
    size_sigma: float = 0.25
    """Relative standard deviation of vehicle sizes at one position."""
    size_sigmas: float = 2.0
    """Maximum difference from the expected size, in its standard deviations."""
    size_factor: float = 2.0
    """Maximum ratio to the expected size."""
    fit_rounds: int = 10
    """Number of rounds of the robust fit of sizes."""
    weak_score: float = 0.2
    """Minimum score at which detections continue a vehicle that has higher scores in other frames."""
    fewest_frames: int = 3
    """Minimum number of frames with high scores."""
    fewest_key_frames: int = 2
    """Minimum number of frames with high scores if the detector runs on key frames only."""
    high_share: float = 0.8
    """A vehicle keeps its weak detections if more than this share of its detections have high scores."""
    standing_sizes: float = 0.3
    """Maximum motion of a stationary vehicle, in its sizes."""
    moving_sizes: float = 1.0
    """Minimum motion of a driving vehicle, in its sizes."""


CONFIRMATION_LIMITS: Final = ConfirmationLimits()


class ExpectedSizes:
    """Expected sizes of vehicles at each position of the image.

    On a plane, inverse depth is affine in the image's coordinates. Sizes of one kind of vehicle therefore are, too.
    """

    def __init__(self, vehicles: Sequence[Sequence[SizeSample]]) -> None:
        """`vehicles` are the samples of each vehicle that moved."""
        self._enough = len(vehicles) >= CONFIRMATION_LIMITS.fewest_moving
        if self._enough:
            samples = np.array([sample for samples in vehicles for sample in samples])
            self._parameters, self._covariance = _fitted(samples)

    def allow(self, sample: SizeSample) -> bool:
        """Return whether a vehicle may have this size at its position; also True if the expected size is unknown."""
        if not self._enough:
            return True
        *position, size = sample
        at = np.array([1.0, *position])
        expected = float(at @ self._parameters)
        spread = CONFIRMATION_LIMITS.size_sigmas * float(np.sqrt(at @ self._covariance @ at))
        return (
            (expected - spread) / CONFIRMATION_LIMITS.size_factor
            < size
            < (expected + spread) * CONFIRMATION_LIMITS.size_factor
        )


def _fitted(samples: Array) -> tuple[Array, Array]:
    """Fit sizes (N, 3) x, y, size; return (3,) size at the origin and its slopes along x and y, and their covariance.

    Errors are relative to the size, and large ones have a linear cost (Huber).
    """
    design = np.column_stack([np.ones(len(samples)), samples[:, :2]]) / samples[:, 2:]
    weights = np.ones(len(samples))
    for _ in range(CONFIRMATION_LIMITS.fit_rounds):
        normal = design.T @ (design * weights[:, None])
        parameters = np.linalg.lstsq(normal, design.T @ weights, rcond=None)[0]
        errors = np.abs(design @ parameters - 1)
        weights = np.minimum(1.0, CONFIRMATION_LIMITS.size_sigma / np.maximum(errors, 1e-9))
    return np.asarray(parameters), np.asarray(CONFIRMATION_LIMITS.size_sigma**2 * np.linalg.pinv(normal))


@dataclass(slots=True)
class _Vehicle:
    """Detections of one possible vehicle; sizes are square roots of boxes' areas, pixels."""

    time_s: float = 0.0
    """Time of its last frame, seconds."""
    seen: int = 0
    """Number of frames with the vehicle."""
    found: int = 0
    """Number of frames in which it was detected; in others it is interpolated."""
    sure: int = 0
    """Number of frames in which it was detected with a high score."""
    lowest: Array = field(default_factory=lambda: np.full(2, np.inf))
    """(2,) least x and y of its middle, pixels."""
    highest: Array = field(default_factory=lambda: np.full(2, -np.inf))
    sizes: float = 0.0
    """Sum of its sizes."""
    samples: list[SizeSample] = field(default_factory=list)
    """Positions of its box on the road, x and y, and its size there: one for each size that it has moved."""

    @property
    def size(self) -> float:
        return self.sizes / self.seen

    @property
    def moved(self) -> float:
        """Displacement of its middle, in its sizes."""
        return float((self.highest - self.lowest).max()) / self.size

    def see(self, time_s: float, box: Array, *, sure: bool, interpolated: bool) -> None:
        self.time_s = time_s
        self.seen += 1
        self.found += not interpolated
        self.sure += sure and not interpolated
        middle, size = (box[:2] + box[2:]) / 2, size_of(box)
        self.lowest, self.highest = np.minimum(self.lowest, middle), np.maximum(self.highest, middle)
        self.sizes += size
        ground = (float(middle[0]), float(box[3]))
        if not self.samples or np.hypot(*np.subtract(ground, self.samples[-1][:2])) > size:
            self.samples.append((*ground, size))


class Confirmation:
    """Collects the detections of a video frame by frame, and selects those that other frames confirm."""

    def __init__(self, score: float, *, every: int = 1) -> None:
        """Begin. Detections above `score` are confident; the detector runs on each `every`-th frame."""
        self._sure = score
        self._fewest = CONFIRMATION_LIMITS.fewest_frames if every == 1 else CONFIRMATION_LIMITS.fewest_key_frames
        self._links = BoxLinks()
        self._vehicles: dict[int, _Vehicle] = {}
        """Vehicles by number, without those that were lost before a confident detection."""
        self._open: set[int] = set()
        """Numbers of the vehicles that may still appear."""
        self._of: list[tuple[Integers32, list[bool]]] = []
        """Per frame, the vehicles of its detections, and whether these are confident."""

    def add(self, time_s: float, found: Sequence[Found]) -> None:
        """Add the detections of the next frame; confident ones choose their vehicles first."""
        sure = [detection.score > self._sure for detection in found]
        numbers = self._links.add(time_s, found, sure)
        rectangles = box_math.xywh_to_xyxy(np.array([detection.bbox for detection in found]).reshape(-1, 4))
        for i, number in enumerate(numbers.tolist()):
            vehicle = self._vehicles.setdefault(number, _Vehicle())
            vehicle.see(time_s, rectangles[i], sure=sure[i], interpolated=found[i].interpolated)
            self._open.add(number)
        self._forget(time_s)
        self._of.append((numbers, sure))

    def _forget(self, time_s: float) -> None:
        """End the vehicles that were lost."""
        lost = {i for i in self._open if time_s - self._vehicles[i].time_s > LINK_LIMITS.lost_s}
        self._open -= lost
        for i in lost:
            if self._vehicles[i].sure < self._fewest:
                del self._vehicles[i]

    def confirmed(self) -> list[Integers32]:
        """Return for each frame the number of each detection's vehicle, from 0; -1 for unconfirmed detections.

        Vehicles are numbered in the order of their first detection.
        """
        seen = {i: vehicle for i, vehicle in self._vehicles.items() if vehicle.sure >= self._fewest}
        sizes = ExpectedSizes(
            [vehicle.samples for vehicle in seen.values() if vehicle.moved > CONFIRMATION_LIMITS.moving_sizes]
        )
        stay = {
            i
            for i, vehicle in seen.items()
            if vehicle.moved > CONFIRMATION_LIMITS.standing_sizes
            or sizes.allow((*vehicle.samples[0][:2], vehicle.size))
        }
        constant = {i for i in stay if seen[i].sure > CONFIRMATION_LIMITS.high_share * seen[i].found}
        names = {number: name for name, number in enumerate(sorted(stay))}
        return [
            np.array(
                [
                    names[i] if i in stay and (sure or i in constant) else -1
                    for i, sure in zip(numbers.tolist(), flags, strict=True)
                ],
                dtype=np.int32,
            )
            for numbers, flags in self._of
        ]
