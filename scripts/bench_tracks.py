"""How long it takes from a video to tracks in metres, and how large the results are.

    python scripts/bench_tracks.py crossing.mp4 --camera crossing.json

A line for each step, `skope eval predict`, `track` and `pose`: seconds, seconds of footage in a second of work, and how
much each wrote.
"""

import argparse
import contextlib
import io
import sys
import tempfile
import time
from pathlib import Path

from skope.cli import main as main_of_skope
from skope.dataset import coco
from skope.dataset.folder import FRAMES_FILE


def timed(*arguments: object) -> float:
    """Seconds that a command of skope takes, but for the start of a process."""
    sys.argv = ["skope", "eval", *map(str, arguments), "-q"]
    begun = time.perf_counter()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        main_of_skope()
    return time.perf_counter() - begun


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("videos", nargs="+", type=Path)
    parser.add_argument("--camera", type=Path, required=True, help="camera file of the videos")
    parser.add_argument("--checkpoint", default="road33", help="as `skope eval predict` takes it")
    options = parser.parse_args()
    print("video                 step      seconds  footage s/s      MB")
    for video in options.videos:
        with tempfile.TemporaryDirectory() as folder:
            seen = Path(folder) / "predict"
            call = (video, "--camera", options.camera, "--checkpoint", options.checkpoint)
            steps = {"predict": timed("predict", *call, "--out", seen)}
            for step in ("track", "pose"):
                steps[step] = timed(step, seen, "--out", Path(folder) / step)
            times = [image.time_s or 0.0 for image in coco.read(seen / FRAMES_FILE).images]
            for step, seconds in steps.items():
                size = sum(path.stat().st_size for path in (Path(folder) / step).rglob("*") if path.is_file())
                pace = (times[-1] - times[0]) / seconds
                print(f"{video.name:20s}  {step:8s} {seconds:8.1f} {pace:12.2f} {size / 1e6:7.2f}")


if __name__ == "__main__":
    main()
