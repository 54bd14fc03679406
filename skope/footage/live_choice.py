"""Select the detector for a live stream: the detectors that come with skope are timed on its first frame."""

import itertools
import statistics
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, Protocol

from skope.detector import weights
from skope.detector.network_settings import Settings
from skope.detector.predictor import Predictor
from skope.keypoints import Scheme
from skope.schema import AnyResult, Image
from skope.terminal.console import Console
from skope.types import Pixels

TIMED_FRAMES: Final = 3
"""Number of timed frames; their median gives a detector's rate, after one warm-up frame."""


class FrameDetector(Protocol):
    """Detector for frames: a `Predictor`, or several from which one is selected."""

    @property
    def scheme(self) -> Scheme:
        """Scheme of the keypoints."""

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of the categories."""

    @property
    def name(self) -> str:
        """Name in the package, or file of the detector."""

    def each(self, images: Iterator[tuple[Image, Pixels]]) -> Iterator[tuple[Image, list[AnyResult]]]:
        """Yield the results of consecutive images, each as soon as it is available."""

    def each_ahead(self, images: Iterator[tuple[Image, Pixels]]) -> Iterator[tuple[Image, list[AnyResult]]]:
        """Yield the results of images that may wait for a batch."""


class LiveDetectorSelector:
    """Selects the first of several detectors that keeps up with a live stream, and runs it."""

    def __init__(self, candidates: Sequence[Predictor], every: int, console: Console) -> None:
        """Prepare the selection.

        Args:
            candidates: The detectors, in order of preference. They share keypoints and categories.
            every: Frame stride of the stream.
            console: Console for the measured rates and the selected detector.
        """
        self._candidates, self._every, self._console = list(candidates), every, console

    @classmethod
    def load(cls, given: str | None, settings: Settings, every: int, console: Console) -> "LiveDetectorSelector":
        """Load the detectors that come with skope, or the `given` one.

        Raises UserError if a checkpoint cannot be loaded.
        """
        names = weights.BY_ACCURACY if given is None else (given,)
        return cls([Predictor.load(Path(name), settings, console) for name in names], every, console)

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of all candidate detectors."""
        return tuple(path for candidate in self._candidates for path in candidate.files)

    @property
    def scheme(self) -> Scheme:
        """Scheme of the keypoints."""
        return self._candidates[0].scheme

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of the categories."""
        return self._candidates[0].categories

    @property
    def name(self) -> str:
        """Name of the selected detector."""
        return self._candidates[0].name

    def each(self, images: Iterator[tuple[Image, Pixels]]) -> Iterator[tuple[Image, list[AnyResult]]]:
        """Time the detectors on the first frame, report the selected one, and yield its results frame by frame."""
        start = list(itertools.islice(images, 1))
        if start:
            rates = [_rate(candidate, *start[0]) for candidate in self._candidates]
            start += itertools.islice(images, 1)
            self._choose(rates, self._sent(start))
        yield from self._candidates[0].each(itertools.chain(start, images))

    each_ahead = each

    def _sent(self, start: Sequence[tuple[Image, Pixels]]) -> float | None:
        """Return the frames per second to process: the rate of arrival while the detectors were timed."""
        if len(start) < 2:
            return None
        first, second = start[0][0], start[1][0]
        seconds = (second.time_s or 0.0) - (first.time_s or 0.0)
        frames = (second.frame_index or 0) - (first.frame_index or 0)
        return frames / self._every / seconds if seconds > 0 else None

    def _choose(self, rates: Sequence[float], sent: float | None) -> None:
        """Select the detector to run."""
        fastest = max(range(len(rates)), key=lambda i: rates[i])
        chosen = 0 if sent is None else next((i for i, rate in enumerate(rates) if rate >= sent), fastest)
        each = ", ".join(
            f"{candidate.name} {rate:.1f}" for candidate, rate in zip(self._candidates, rates, strict=True)
        )
        choice = f": {self._candidates[chosen].name} runs (--checkpoint names another)" if len(rates) > 1 else ""
        came = "" if sent is None else f"the camera sends {sent:.1f} frames/s; "
        missed = "" if sent is None or rates[chosen] >= sent else f"; {1 - rates[chosen] / sent:.0%} are passed over"
        self._console.say(f"{came}detector speed on this machine, frames/s: {each}{choice}{missed}")
        self._candidates = [self._candidates[chosen]]


def _rate(predictor: Predictor, image: Image, pixels: Pixels) -> float:
    """Return the frames per second of a detector."""
    seconds = []
    for _ in range(1 + TIMED_FRAMES):
        begun = time.perf_counter()
        list(predictor.each(iter([(image, pixels)])))
        seconds.append(time.perf_counter() - begun)
    return 1 / statistics.median(seconds[1:])
