"""Bar and figures of a training run under way."""

import time
from collections.abc import Mapping
from typing import Any, Final, Self

from skope.schema import CATEGORIES
from skope.terminal.console import Console, minutes

_MEASURED_STEPS: Final = 2
"""Steps whose duration tells how long the run will take."""


class TrainingProgress:
    """A bar over all images of the run with the epoch's mean losses; says once how long the run will take."""

    def __init__(self, images: int, epochs: int, console: Console) -> None:
        self._console = console
        self._epochs, self._total, self._seen, self._images = epochs, images, 0, 0
        self._bar = console.bar(total=images, unit="image", label="training")
        self._since = time.perf_counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        self._bar.clear()
        self._console.say(text)

    def tick(self, epoch: int, images: int, losses: Mapping[str, float]) -> None:
        """Note that a step over `images` images is done."""
        values = {name.removeprefix("loss_"): f"{value:.3f}" for name, value in losses.items()}
        self._bar.set_postfix({"epoch": f"{epoch + 1}/{self._epochs}", **values}, refresh=False)
        self._bar.update(images)
        self._seen += 1
        if self._seen == 1:  # the first step is slower: libraries choose algorithms and ask for memory
            self._since, self._images = time.perf_counter(), 0
            return
        self._images += images
        if self._seen == 1 + _MEASURED_STEPS:
            seconds = time.perf_counter() - self._since
            rate, each = self._images / seconds, seconds / _MEASURED_STEPS
            self.note(f"{each:.2g} s a step: about {minutes(self._total / rate)} for {self._total} images")


def figures_text(figures: Mapping[str, Any]) -> str:
    """The figures of a validation (`skope.train.validate.validate`) in one line."""

    def percent(name: str) -> str:
        return "-" if figures[name] is None else f"{figures[name]:.1%}"

    return (
        f"PCK {percent('pck')} of found vehicles ({percent('box_recall')} of {figures['vehicles']}), "
        f"{percent('pck_given')} in given boxes; keypoint recall {percent('keypoint_recall')}"
        + "".join(f"; {name} recall {percent(f'{name}_recall')}" for name in CATEGORIES if f"{name}_recall" in figures)
    )
