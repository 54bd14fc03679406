"""Accuracy against time of detectors on video: each on the same generated clips, by the way that `predict` goes.

    python scripts/research/detector_curve.py runs/curve --rows road33@540@key,road33-lite@540@every
    python scripts/research/detector_curve.py runs/curve --rows road33-lite@360@every,mine.safetensors@540@every

A row is a detector, the short side inside the network, and `key` or `every`: what `skope eval predict` does on a CPU by
default, and with --every-frame. The clips (CLIPS) are made where they are missing: roads that nothing was trained on,
in two groups. Images a second are of all clips, decoding, camera sway, what goes on disk and the written results
counted, loading not; memory is the most that the process held. Every frame is scored (video_modes.py), and what
`skope eval track` makes of it (track_rates.py: HOTA and IDF1 where TrackEval is installed), each as the mean over a
group's clips. What is measured is kept in the folder, and not measured again.
"""

import argparse
import json
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from track_rates import Row, measure
from video_modes import Counts, count

from skope.dataset import coco
from skope.detector.network_settings import Settings
from skope.detector.predictor import Predictor
from skope.files.json_files import read_json, write_json
from skope.footage.predict_footage import Prediction
from skope.footage.predict_job import PredictJob, claim
from skope.terminal.console import Console
from skope.video.footage import open_footage


@dataclass(frozen=True)
class ClipPlan:
    """A clip and how it is made."""

    site: str
    weather: str
    hour: str
    group: str
    """`day`: seven by day, also in rain. `other`: four by night, in fog and in snow."""

    @property
    def name(self) -> str:
        """The name of its folder."""
        return f"{self.site}_{self.weather}_{self.hour}"


CLIPS: Final = (
    ClipPlan("t05_third_median", "clear", "noon", "day"),
    ClipPlan("t06_plaza_opening", "clear", "noon", "day"),
    ClipPlan("t06_willow_turn", "overcast", "noon", "day"),
    ClipPlan("t02_elm_corner", "clear", "dusk", "day"),
    ClipPlan("t06_harlan_long", "clear", "noon", "day"),
    ClipPlan("t02_cedar_pole", "rain", "noon", "day"),
    ClipPlan("t05_park_pole", "overcast", "noon", "day"),
    ClipPlan("t06_plaza_opening", "clear", "night", "other"),
    ClipPlan("t03_circle_mast", "rain", "night", "other"),
    ClipPlan("t02_elm_corner", "fog", "noon", "other"),
    ClipPlan("t05_park_pole", "snow", "noon", "other"),
)
SECONDS, FPS, SIZE = 12.0, 10.0, "1280x720"
COLUMNS: Final = (
    *("detector", "short side", "frames", "images/s", "memory, MB", "clips", "precision", "recall"),
    *("of those in their first second", "PCK %", "tracked", "switches", "HOTA", "IDF1"),
)


def make(clip: ClipPlan, folder: Path, options: argparse.Namespace) -> Path:
    """A clip's file of labels, made if it is missing; the video lies beside it."""
    labels = folder / "clips" / clip.name / f"{clip.site}.json"
    if not labels.is_file():
        words = f"gen video {clip.site} --road-users --fov 80 -q --seconds {options.seconds} --fps {FPS} --seed 0"
        words += f" --size {options.size} --weather {clip.weather} --time-of-day {clip.hour}"
        subprocess.run(
            [sys.executable, "-m", "skope", *words.split(), "--out", str(labels.parent)],
            check=True,
            stdout=subprocess.DEVNULL,
        )
    return labels


def folder_of(row: str, folder: Path) -> Path:
    """The folder of a row's results."""
    return folder / "rows" / row.replace("/", "_")


def look(row: str, clips: Sequence[Path], out: Path) -> dict[str, float]:
    """Look at all clips with a detector, in this process; returns its rate and memory."""
    checkpoint, short, way = row.rsplit("@", 2)
    settings = Settings(device="cpu", backend="auto", precision="auto", min_size=int(short))
    console, looked_at, seconds = Console(quiet=True), 0, 0.0
    predictor = Predictor.load(Path(checkpoint), settings, console)
    for labels in clips:
        job = PredictJob(
            footage=open_footage(str(labels.with_suffix(".mp4"))),
            checkpoint=Path(checkpoint),
            out=out / labels.parent.name,
            settings=settings,
            every_frame=way == "every",
        )
        ready = predictor.reporting(job.least_score)
        if not looked_at:  # the first look makes ready what the others use
            ready.detections([pixels for _, (_, pixels) in zip(range(1), job.footage.frames(), strict=False)])
        begun = time.perf_counter()
        claim(job, predictor.files)
        prediction = Prediction(job, ready)
        looked_at += sum(1 for _ in prediction.frames())
        prediction.write(console)
        seconds += time.perf_counter() - begun
    return {"rate": looked_at / seconds, "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def figures(clips: Sequence[Path], out: Path) -> dict[str, Any]:
    """What was found and tracked in a group's clips."""
    total, rows = Counts(), []
    for labels in clips:
        truth = coco.read(labels)
        results = coco.read_results(out / labels.parent.name / "predictions.json")
        total += count(truth, results)
        with tempfile.TemporaryDirectory() as folder:
            rows.append(measure(truth, results, Path(folder)))
    _, precision, _, recall, entered, pck, _ = total.cells()
    tracked = f"{sum(row.tracked for row in rows)} of {sum(row.vehicles for row in rows)}"
    cells = [precision, recall, entered, pck, tracked, str(sum(row.switches for row in rows))]
    return {"cells": [*cells, *(_mean(rows, name) for name in ("HOTA", "IDF1"))]}


def _mean(rows: Sequence[Row], name: str) -> str:
    values = [row.scores[name] for row in rows if name in row.scores]
    return f"{np.mean(values):.3f}" if values else "-"


def measured(row: str, clips: Sequence[tuple[ClipPlan, Path]], folder: Path) -> dict[str, Any]:
    """A row's figures, measured where they are not kept."""
    out = folder_of(row, folder)
    kept = out / "figures.json"
    if not kept.is_file():
        own = [sys.executable, __file__, str(folder), "--look", row, "--paths", *(str(path) for _, path in clips)]
        speed = subprocess.run(own, check=True, stdout=subprocess.PIPE, text=True).stdout
        by_group = {
            group: figures([path for clip, path in clips if clip.group == group], out)
            for group in dict.fromkeys(clip.group for clip, _ in clips)
        }
        write_json(kept, {**json.loads(speed.splitlines()[-1]), "groups": by_group})
    return dict(read_json(kept))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where clips and figures are kept")
    parser.add_argument("--rows", default="road33@540@key,road33-lite@540@every,road33-lite@540@key")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="length of each clip")
    parser.add_argument("--size", default=SIZE, help="of the clips' pictures")
    parser.add_argument("--clips", type=int, default=len(CLIPS), help="only so many of them")
    parser.add_argument("--look", help=argparse.SUPPRESS)
    parser.add_argument("--paths", type=Path, nargs="*", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.look:
        print(json.dumps(look(options.look, options.paths, folder_of(options.look, options.folder))))
        return
    clips = [(clip, make(clip, options.folder, options)) for clip in CLIPS[: options.clips]]
    print(shlex.join(sys.argv), flush=True)
    print("| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|", sep="\n")
    for row in options.rows.split(","):
        found = measured(row, clips, options.folder)
        checkpoint, short, way = row.rsplit("@", 2)
        for group, one in found["groups"].items():
            rate, memory = f"{found['rate']:.2f}", f"{found['memory_mb']:.0f}"
            cells = [Path(checkpoint).stem, short, way, rate, memory, group, *one["cells"]]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
