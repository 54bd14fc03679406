"""How right `skope eval traffic` is on generated clips, of which everything is known.

    python scripts/research/traffic_clips.py make --out clips                          # many cores and a GPU
    python scripts/research/traffic_clips.py detect clips --checkpoint NEW.safetensors --gpus 0,1,2,3
    python scripts/research/traffic_clips.py score clips/travel --out scored           # anywhere, on a CPU
    python scripts/research/traffic_clips.py score clips/travel --out scored --true-keypoints  # labels, 2 px of noise

Four sites by day, at night and in rain, and one of them at 25 frames a second too. `detect` packs what `score` needs,
without pictures, in the folder `travel`: CLIP.tar.gz in parts of at most 15 MiB (CLIP.tar.gz.00, ...), with their
SHA-256 in CLIP.parts.json. Bring that folder and give it to `score`. What is finished is not done again. Where time is
short, --only names clips, separated by commas; --seconds and --size make smaller ones.

`road33` has learnt from t03_circle_mast; of the others (split extra), on which it has only been measured, nothing.
"""

import argparse
import hashlib
import io
import os
import shutil
import subprocess
import sys
import tarfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

from traffic_evidence import LABELS, SEEN
from traffic_gates import SITE, gates_of, road_of, write_site
from traffic_scores import RESULTS, score_clip
from traffic_tables import print_tables
from traffic_truth import FOV_DEG, TRUTH, check_labels, read_truth

from skope.dataset.folder import FRAMES_FILE, PREDICTIONS_FILE
from skope.files.atomic import write_bytes
from skope.files.json_files import json_bytes, read_json, write_json

HERE: Final = Path(__file__).parent
PART_BYTES: Final = 15 * 2**20
CLIP: Final = "clip.json"
"""What a clip was made with; written last."""
TRAVEL: Final = "travel"
NOT_NEEDED: Final = (
    *("segmentation", "keypoints_3d", "bbox_visible", "color", "model", "contrast", "area_full", "num_keypoints"),
    *("box_3d", "velocity", "articulation", "parked", "vehicle_type"),
)
"""Of a label, what no score asks for; nor are keypoints of ignored ones."""
OFF: Final = "labels_off_m"
PER_GPU: Final = 2
TRAVELS: Final = (CLIP, SITE, TRUTH, LABELS, f"{SEEN}/{FRAMES_FILE}", f"{SEEN}/{PREDICTIONS_FILE}")


@dataclass(frozen=True)
class Clip:
    """A clip that is made."""

    site: str
    light: str
    fps: float = 10.0
    seconds: float = 180.0

    @property
    def name(self) -> str:
        """What its folder is called."""
        return f"{self.site}_{self.light}" + ("" if self.fps == 10 else f"_{self.fps:g}")


SITES: Final = {
    "t05_third_median": "a signalled crossing with turning movements and its queue",
    "t03_circle_mast": "a roundabout with four arms",
    "t05_park_pole": "an avenue of several lanes",
    "t06_plaza_opening": "the opening of a median before a plaza",
}
SEEDS: Final = {"t03_circle_mast": 1}
"""Others than 0: with that the roundabout is one jam, and nobody crosses a gate before the camera."""
LIGHTS: Final = {"day": ("clear", "noon"), "night": ("clear", "night"), "rain": ("rain", "noon")}
CLIPS: Final = (
    Clip("t05_third_median", "day", fps=25.0, seconds=120.0),  # the longest one begins first
    *(Clip(site, light) for site in SITES for light in LIGHTS),
)
CHECKS: Final = (
    *(Clip("t06_willow_turn", "day"), Clip("t02_elm_corner", "day")),
    *(Clip("t06_harlan_long", "night"), Clip("t02_cedar_pole", "rain")),
)
"""Clips of other sites: what is fitted on the clips above (skope/traffic/event_probability.py) is held against them."""


def chosen(only: str) -> list[Clip]:
    """The clips of these names; without any, those that are fitted on, and for "checks" those that are not."""
    if only == "checks":
        return list(CHECKS)
    known = {clip.name: clip for clip in (*CLIPS, *CHECKS)}
    wrong = [name for name in only.split(",") if only and name not in known]
    if wrong:
        sys.exit(f"--only: {wrong[0]} is none of {', '.join(known)}")
    return [known[name] for name in only.split(",")] if only else list(CLIPS)


# -------------------------------------------------------------------------------------------------------------- making


def make(options: argparse.Namespace) -> None:
    """All clips at once, each with its truth, its gates and labels that are small enough to travel."""
    clips = chosen(options.only)
    with (
        ThreadPoolExecutor(len(clips)) as threads,
        ProcessPoolExecutor(min(len(clips), os.cpu_count() or 1), get_context("spawn")) as small,
    ):
        jobs = [threads.submit(make_one, clip, options, small) for clip in clips]
        failed = [clip.name for clip, job in zip(clips, jobs, strict=True) if not job.result()]
    if failed:
        sys.exit(f"not made: {', '.join(failed)}")


def make_one(clip: Clip, options: argparse.Namespace, small: ProcessPoolExecutor) -> bool:
    """Whether the clip is there now."""
    folder = options.out / clip.name
    asked = asked_for(clip, options)
    if (folder / CLIP).is_file():
        made = read_json(folder / CLIP)
        if {key: made.get(key) for key in asked} == asked:
            return True
        print(f"{folder}: holds another clip of this name; choose another --out")
        return False
    same = [f"--{key.replace('_', '-')}={asked[key]}" for key in ("seconds", "fps", "size", "weather", "time_of_day")]
    same += ["--seed", str(asked["seed"]), "--out", str(folder)]
    video = ["-m", "skope", "gen", "video", clip.site, "--road-users", "--fov", f"{FOV_DEG:g}", "-q", *same]
    truth = [str(HERE / "traffic_truth.py"), clip.site, *same]
    folder.mkdir(parents=True, exist_ok=True)
    few = {**os.environ, "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}  # many run side by side
    with (folder / "make.log").open("wb") as log:
        started = [
            subprocess.Popen(["nice", "-n", "10", sys.executable, *words], stdout=log, stderr=log, env=few)
            for words in (video, truth)
        ]
        if max([process.wait() for process in started]):
            print(f"{clip.name}: failed; {folder}/make.log says why")
            return False
    off = small.submit(slim, folder, folder / f"{clip.site}.json").result()
    write_site(folder / SITE, gates_of(*road_of(clip.site, options.size)))
    write_json(folder / CLIP, {**asked, OFF: off})
    print(f"{clip.name}: made", flush=True)
    return True


def asked_for(clip: Clip, options: argparse.Namespace) -> dict[str, Any]:
    """What a clip is made with."""
    weather, time_of_day = LIGHTS[clip.light]
    return {
        "name": clip.name,
        "site": clip.site,
        "light": clip.light,
        "fps": clip.fps,
        "seconds": options.seconds or clip.seconds,
        "size": options.size,
        "weather": weather,
        "time_of_day": time_of_day,
        "seed": SEEDS.get(clip.site, 0),
    }


def slim(folder: Path, labels: Path) -> float:
    """Write labels without what no score asks for; how far they are from the truth, metres, at most."""
    document = read_json(labels)
    off = check_labels(read_truth(folder), document)
    for row in document["annotations"]:
        for key in NOT_NEEDED:
            row.pop(key, None)
        points = [0] * len(row["keypoints"]) if row["iscrowd"] else row["keypoints"]
        row["keypoints"] = [int(value) if value == int(value) else round(value, 1) for value in points]
    write_bytes(folder / LABELS, json_bytes(document))
    return off


# ----------------------------------------------------------------------------------------------------------- detecting


def detect(options: argparse.Namespace) -> None:
    """Run the detector on all clips, and pack what travels."""
    gpus: SimpleQueue[str] = SimpleQueue()
    numbers = options.gpus.split(",")
    for gpu in numbers * PER_GPU:
        gpus.put(gpu)

    def one(clip: Clip) -> bool:
        gpu = gpus.get()
        try:
            return detect_one(options.folder / clip.name, clip, gpu, options)
        finally:
            gpus.put(gpu)

    clips = [clip for clip in chosen(options.only) if (options.folder / clip.name / CLIP).is_file()]
    with ThreadPoolExecutor(PER_GPU * len(numbers)) as threads:
        done = dict(zip(clips, threads.map(one, clips), strict=True))
    if not clips or not all(done.values()):
        sys.exit(f"not detected: {', '.join(clip.name for clip, there in done.items() if not there) or 'no clips'}")


def detect_one(folder: Path, clip: Clip, gpu: str, options: argparse.Namespace) -> bool:
    """Whether what was found in the clip is packed now."""
    packed = options.travel or options.folder / TRAVEL
    if (packed / f"{clip.name}.parts.json").is_file():
        return True
    video = ["eval", "predict", str(folder / f"{clip.site}.mp4"), "--checkpoint", str(options.checkpoint)]
    with (folder / "detect.log").open("wb") as log:
        code = subprocess.run(
            [sys.executable, "-m", "skope", *video, "--out", str(folder / SEEN), "-q"],
            stdout=log,
            stderr=log,
            check=False,
            env={**os.environ, "CUDA_VISIBLE_DEVICES": gpu},
        ).returncode
    if code:
        print(f"{clip.name}: failed; {folder}/detect.log says why")
        return False
    size = pack(folder, packed)
    print(f"{clip.name}: {size / 2**20:.1f} MiB to travel", flush=True)
    return True


def pack(folder: Path, out: Path) -> int:
    """Pack a clip's folder, without pictures; returns the bytes."""
    out.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for name in TRAVELS:
            if (folder / name).is_file():
                tar.add(folder / name, f"{folder.name}/{name}")
    whole = buffer.getvalue()
    parts = {}
    for number, first in enumerate(range(0, len(whole), PART_BYTES)):
        part = whole[first : first + PART_BYTES]
        name = f"{folder.name}.tar.gz.{number:02d}"
        write_bytes(out / name, part)
        parts[name] = hashlib.sha256(part).hexdigest()
    write_json(out / f"{folder.name}.parts.json", parts)
    return len(whole)


def unpack(folder: Path, out: Path) -> None:
    """Unpack the clips of a folder whose parts are all there and whole; says which are not."""
    for manifest in sorted(folder.glob("*.parts.json")):
        name = manifest.name.removesuffix(".parts.json")
        if (out / name / CLIP).is_file():
            continue
        whole, parts = bytearray(), read_json(manifest)
        for part, digest in parts.items():
            data = (folder / part).read_bytes() if (folder / part).is_file() else b""
            if hashlib.sha256(data).hexdigest() != digest:
                print(f"{folder / part}: missing or damaged; bring it again")
                break
            whole += data
        else:
            with tarfile.open(fileobj=io.BytesIO(bytes(whole)), mode="r:gz") as tar:
                tar.extractall(out, filter="data")


# ------------------------------------------------------------------------------------------------------------- scoring


def place_gates(folder: Path) -> None:
    """Place a clip's gates by the rule as it is now; what was counted at others is done again.

    A clip that names no site keeps its own.
    """
    made, before = read_json(folder / CLIP), (folder / SITE).read_bytes()
    if "site" not in made:
        return
    write_site(folder / SITE, gates_of(*road_of(made["site"], made["size"])))
    if (folder / SITE).read_bytes() != before:
        for report in folder.glob("*/report"):
            shutil.rmtree(report)


def score(options: argparse.Namespace) -> None:
    """Tables on the terminal, and everything in results.json."""
    work = options.out or options.folder
    unpack(options.folder, work)
    folders = [work / clip.name for clip in chosen(options.only) if (work / clip.name / CLIP).is_file()]
    if not folders:
        sys.exit(f"{work}: no clips")
    for folder in folders:
        place_gates(folder)
    scored: Sequence[Mapping[str, Any]] = [
        score_clip(folder, true_keypoints=options.true_keypoints, clip=read_json(folder / CLIP)) for folder in folders
    ]
    out = work / (RESULTS if not options.true_keypoints else f"true_{RESULTS}")
    write_json(out, {"clips": scored})
    print_tables(scored)
    print(f"wrote {out}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    making = commands.add_parser("make", help="make the clips")
    making.add_argument("--out", type=Path, required=True)
    making.add_argument("--seconds", type=float, default=0.0, help="length of each; default: its own")
    making.add_argument("--size", default="1280x720")
    making.set_defaults(run=make)
    detecting = commands.add_parser("detect", help="run the detector and pack what travels")
    detecting.add_argument("folder", type=Path)
    detecting.add_argument("--checkpoint", default="road33")
    detecting.add_argument("--gpus", default="0", help="numbers of the GPUs, separated by commas")
    detecting.add_argument("--travel", type=Path, help=f"where what travels is packed; default: FOLDER/{TRAVEL}")
    detecting.set_defaults(run=detect)
    scoring = commands.add_parser("score", help="tracks, counts and the truth")
    scoring.add_argument("folder", type=Path, help="of clips, or of what travelled")
    scoring.add_argument("--out", type=Path, help="where clips are unpacked and scored; default: FOLDER")
    scoring.add_argument("--true-keypoints", action="store_true", help="labels with 2 px of noise, no detections")
    scoring.set_defaults(run=score)
    for command in (making, detecting, scoring):
        command.add_argument("--only", default="", help="names of clips, separated by commas, or `checks`")
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
