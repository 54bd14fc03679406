"""How well vehicles in generated footage are found, every frame scored, in each way of running a detector.

    skope gen video t06_plaza_opening --fps 10 --seconds 12 --out footage     # and other sites
    skope eval predict footage/t06_plaza_opening.mp4 --out seen/as_it_is/t06_plaza_opening
    skope eval predict footage/t06_plaza_opening.mp4 --unconfirmed --out seen/unconfirmed/t06_plaza_opening
    python scripts/research/video_modes.py footage seen/as_it_is seen/unconfirmed

The first folder holds the labels of `skope gen video`; each other one is a mode, with a folder of `skope eval predict`
for each file of labels. The table has vehicles (not ignored, in all frames together), precision, phantoms a frame,
recall, that of vehicles in their first second, PCK@0.1 of what is found, and the recall of the detections whose scores
are high enough for a precision of 0.90, at IoU 0.6.
"""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

import numpy as np

from skope.dataset import coco
from skope.dataset.folder import PREDICTIONS_FILE
from skope.metrics.keypoint_outcomes import Options, outcomes_at
from skope.metrics.match import match
from skope.metrics.outcome_counts import ratio
from skope.metrics.pck_precision_recall import ranked, recall_at_precision
from skope.metrics.read_inputs import read_vehicle_results
from skope.schema import AnnotationFile, Result

IOU: Final = 0.6
ALPHA: Final = 0.1
JUST_ENTERED_S: Final = 1.0
"""How long a vehicle counts as one that has just entered."""
PRECISION: Final = 0.9
COLUMNS: Final = (
    *("vehicles", "precision", "phantoms a frame", "recall", "of those in their first second", "PCK %"),
    f"recall at precision {PRECISION:.2f}",
)


@dataclass(frozen=True)
class Counts:
    """Sums over frames; those of several clips add up."""

    frames: int = 0
    vehicles: int = 0
    found: int = 0
    entering: int = 0
    entering_found: int = 0
    phantoms: int = 0
    labelled: int = 0
    correct: int = 0
    scores: tuple[float, ...] = ()
    """Of all detections that count, those with low scores too."""
    hits: tuple[bool, ...] = ()
    """Whether each of them is a vehicle."""

    def __add__(self, other: "Counts") -> "Counts":
        return Counts(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(self)))

    def cells(self) -> list[str]:
        """The cells of `COLUMNS`."""
        shares = (
            ratio(self.found, self.found + self.phantoms),
            ratio(self.phantoms, self.frames),
            ratio(self.found, self.vehicles),
            ratio(self.entering_found, self.entering),
        )
        pck = ratio(100 * self.correct, self.labelled)
        at = recall_at_precision(np.array(self.scores), np.array(self.hits, dtype=bool), self.vehicles, PRECISION)
        return [str(self.vehicles), *(_text(share, 3) for share in shares), _text(pck, 1), _text(at["recall"], 3)]


def count(truth: AnnotationFile, results: Sequence[Result], score: float = 0.0) -> Counts:
    """Compare what was found in each frame of a clip, with scores above `score`, with its labels."""
    everything = match(truth, results, score=0.0, thresholds=(IOU,))
    scores, hits = ranked(everything, IOU)
    matches = match(truth, results, score=score, thresholds=(IOU,)) if score else everything
    outcomes = outcomes_at(matches, IOU, Options())
    times = np.array([image.time_s or 0.0 for image in truth.images])[matches.gt_image]
    tracks = np.array([vehicle.track_id for vehicle in matches.vehicles])
    first = {track: times[tracks == track].min() for track in set(tracks.tolist())}
    entered = np.array([first[track] for track in tracks.tolist()])
    begin = min((image.time_s or 0.0 for image in truth.images), default=0.0)
    # What is there when the clip begins has not just entered.
    entering = (times - entered < JUST_ENTERED_S) & (entered > begin)
    found = outcomes.found
    return Counts(
        frames=len(truth.images),
        vehicles=len(found),
        found=int(found.sum()),
        entering=int(entering.sum()),
        entering_found=int((entering & found).sum()),
        phantoms=int(((matches.taken[IOU] < 0) & ~matches.det_on_ignored).sum()),
        labelled=int(outcomes.labelled[found].sum()),
        correct=int(outcomes.correct(ALPHA)[found].sum()),
        scores=tuple(scores.tolist()),
        hits=tuple(hits.tolist()),
    )


def rows(labels: Sequence[Path], modes: Sequence[Path]) -> Iterator[list[str]]:
    """A row for each clip and mode, then one of all clips for each mode."""
    sums = dict.fromkeys(modes, Counts())
    for path in labels:
        truth = coco.read(path)
        for mode in modes:
            one = count(truth, read_vehicle_results(mode / path.stem / PREDICTIONS_FILE, truth))
            sums[mode] += one
            yield [path.stem, str(mode), *one.cells()]
    for mode, total in sums.items():
        yield ["all", str(mode), *total.cells()]


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("labels", type=Path, help="folder of the labels of `skope gen video`")
    parser.add_argument("modes", type=Path, nargs="+", help="folders of folders of `skope eval predict`")
    options = parser.parse_args()
    print("| " + " | ".join(("clip", "mode", *COLUMNS)) + " |", "|---" * (len(COLUMNS) + 2) + "|", sep="\n")
    for row in rows(sorted(options.labels.glob("*.json")), options.modes):
        print("| " + " | ".join(row) + " |")


if __name__ == "__main__":
    main()
