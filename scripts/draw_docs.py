"""Make the pictures of README and docs again, with the commands that they show; ten minutes on two cores.

    make demo                                                  # what birdseye and footage_overlay show
    python scripts/draw_docs.py                                # all
    python scripts/draw_docs.py noon fog --out elsewhere       # some

`gallery` and `report` are photographed by Chromium. docs/method.md has its figures from `draw_method.py`, and
docs/real_footage.jpg is a frame of somebody's footage: `skope eval predict VIDEO --overlay`.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.dataset.folder import open_dataset, read_image
from skope.files.atomic import replacing

Pixels = NDArray[np.uint8]

ROOT: Final = Path(__file__).parents[1]
SITE: Final = "t01_mill_corner"
MOST_BYTES: Final = 290_000
"""A page shows many of them."""
OVERLAY_FRAME: Final = 30


@dataclass(frozen=True)
class Places:
    """Where pictures come from."""

    work: Path
    """For what is made on the way."""
    run: Path
    """What `make demo` made."""


def skope(*words: object, at: Path = ROOT) -> None:
    """A command, in the folder `at`."""
    subprocess.run([sys.executable, "-m", "skope", *map(str, words), "--quiet"], check=True, cwd=at)


def generated(folder: Path, *options: object) -> Pixels:
    """Of a dataset that is generated, the image with the most vehicles, the last of several."""
    skope("gen", *options, "--size", "1280x720", "--out", folder)
    dataset = open_dataset(folder)
    vehicles: Counter[str] = Counter()
    for file in map(dataset.read, dataset.splits):
        names = {image.id: image.file_name for image in file.images}
        vehicles.update(names[one.image_id] for one in file.annotations if not one.ignored)
    return read_image(folder / max(vehicles, key=lambda name: (vehicles[name], name)))


def weather(name: str, sky: str, time: str) -> Callable[[Places], Pixels]:
    """What makes a picture of one junction in some weather."""

    def draw(places: Places) -> Pixels:
        options = ("--site", SITE, "--weather", sky, "--time-of-day", time, "--frames", 2)
        return generated(places.work / name, *options)

    return draw


def own_road(places: Places) -> Pixels:
    """The example's road in the rush hour."""
    folder = places.work / "own_road"
    shutil.copytree(ROOT / "examples/own_road", folder)
    site = folder / "site.toml"
    usual, busy = "vehicles_per_hour = 900", "vehicles_per_hour = 2400"
    text = site.read_text(encoding="utf-8")
    if usual not in text:
        sys.exit(f"{site}: does not say {usual!r}")
    site.write_text(text.replace(usual, busy), encoding="utf-8")
    return generated(folder / "data", "--site", site, "--frames", 24)


def vehicle_sheet(places: Places) -> Pixels:
    skope("gen", "vehicles", "show", "suv", "--out", places.work / "vehicles")
    return narrowed(read_image(places.work / "vehicles" / "suv.png"), 1350)


def keypoints(places: Places) -> Pixels:
    """Of each kind of body the two views from three quarters, with its keypoints."""
    rows = []
    for model in ("suv", "van", "truck", "bus"):
        skope("gen", "vehicles", "show", model, "--out", places.work / "vehicles")
        sheet = read_image(places.work / "vehicles" / f"{model}.png")
        # Plain and labelled rows by turns, three views in each; a line of text above.
        high, wide = sheet.shape[1] // 3 * 400 // 640, sheet.shape[1] * 2 // 3
        top = sheet.shape[0] - 3 * (high + 3)
        rows.append(sheet[top : top + high, :wide])
    return narrowed(np.vstack(rows), 1000)


def birdseye(places: Places) -> Pixels:
    return narrowed(read_image(places.run / "tracks" / "birdseye.png"), 1500)


def footage_overlay(places: Places) -> Pixels:
    video = cv2.VideoCapture(str(places.run / "seen" / "overlay.mp4"))
    video.set(cv2.CAP_PROP_POS_FRAMES, OVERLAY_FRAME)
    there, frame = video.read()
    if not there:
        sys.exit(f"{places.run / 'seen' / 'overlay.mp4'}: has no frame {OVERLAY_FRAME}: run `make demo`")
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def gallery(places: Places) -> Pixels:
    skope("gen", "report", queue(places), "--out", "gallery", at=places.work)
    return photographed(places.work / "gallery" / "index.html", 1240, 860)


def report(places: Places) -> Pixels:
    skope("eval", "--data", queue(places), "--split", "hard", "--checkpoint", "road33", "--out", "eval", at=places.work)
    return photographed(places.work / "eval" / "report.html", 1100, 1000)


def queue(places: Places) -> str:
    """The name of a dataset of vehicles before a signal, which reports show as it is given."""
    skope("gen", "--site", "t01_mill_south", "--frames", 8, "--size", "1280x720", "--out", "queue", at=places.work)
    return "queue"


def photographed(page: Path, width: int, height: int) -> Pixels:
    """The upper part of a page."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "page.png"
        flags = ["--headless=new", "--no-sandbox", "--hide-scrollbars", f"--user-data-dir={folder}/profile"]
        flags += [f"--window-size={width},{height}", f"--screenshot={path}", page.resolve().as_uri()]
        subprocess.run(["chromium", *flags], check=True, capture_output=True)
        return read_image(path)


def narrowed(pixels: Pixels, width: int) -> Pixels:
    scale = min(1.0, width / pixels.shape[1])
    return np.asarray(cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), dtype=np.uint8)


PICTURES: Final[dict[str, Callable[[Places], Pixels]]] = {
    "noon": weather("noon", "clear", "noon"),
    "low_sun": weather("low_sun", "clear", "low_sun"),
    "rain_night": weather("rain_night", "rain", "night"),
    "fog": weather("fog", "fog", "noon"),
    "own_road": own_road,
    "vehicle_sheet": vehicle_sheet,
    "keypoints": keypoints,
    "birdseye": birdseye,
    "footage_overlay": footage_overlay,
    "gallery": gallery,
    "report": report,
}
NEEDS_BROWSER: Final = ("gallery", "report")


def write(path: Path, pixels: Pixels) -> None:
    """As JPEG, in the best quality that `MOST_BYTES` allow."""
    for quality in range(90, 40, -5):
        made, data = cv2.imencode(".jpg", cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
        if made and len(data) <= MOST_BYTES:
            break
    with replacing(path) as temporary:
        temporary.write_bytes(data.tobytes())
    print(f"{path}: {pixels.shape[1]}x{pixels.shape[0]}, {len(data) // 1000} kB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PICTURES)}; all by default")
    parser.add_argument("--out", type=Path, default=ROOT / "docs")
    parser.add_argument("--run", type=Path, default=ROOT / "runs/demo", help="what `make demo` made")
    options = parser.parse_args()
    names = options.names or list(PICTURES)
    if unknown := set(names) - PICTURES.keys():
        parser.error(f"no picture is called {', '.join(sorted(unknown))}; there are {', '.join(PICTURES)}")
    if set(names) & set(NEEDS_BROWSER) and shutil.which("chromium") is None:
        parser.error(f"{', '.join(NEEDS_BROWSER)}: chromium is not installed")
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        places = Places(Path(folder), options.run)
        for name in names:
            write(options.out / f"{name}.jpg", PICTURES[name](places))


if __name__ == "__main__":
    main()
