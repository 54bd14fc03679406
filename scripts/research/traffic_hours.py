"""Time, memory and size of `skope eval traffic` on hours of synthetic tracks, also when it is killed and resumed.

    python scripts/research/traffic_hours.py --hours 1 --kills 5 --out hours
    python scripts/research/traffic_hours.py --hours 0.8 --kills 0 --recordings 8 --out recordings

It makes tracks of a crossroads with signals, as `skope eval track` writes them, and measures them twice. The second
time the command is killed (SIGKILL) at random moments, also while it writes, and resumed. In the end both folders must
hold the same bytes.

With `--recordings` the same tracks are also measured as several consecutive recordings, like those of a camera that
begins a file each hour. Vehicles on the road at a boundary are left out of both or, with `--cut`, cut in two.
"""

import argparse
import contextlib
import csv
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

import numpy as np

from skope.camera.model import Camera
from skope.files.json_files import write_json
from skope.tracks.csv_file import TRACK_COLUMNS, TRACKS_CSV
from skope.traffic.observation import FOOTAGE_FILE, Observation
from skope.types import Array

PER_HOUR: Final = 800
HALF_M: Final = 100.0
"""Distance from the middle of the crossroads at which tracks begin and end, metres."""
LANE_M: Final = 2.0
GREEN_S: Final = 30.0
"""Duration of green for one road, then the other, seconds."""
CLEAR_S: Final = 0.5
"""Time without arrivals at the end of green, short enough for conflicts, seconds."""
HEADWAY_S: Final = 1.8
SIZES: Final = {"car": (4.4, 1.8), "van": (5.4, 2.0), "lorry": (9.0, 2.5), "bus": (12.0, 2.5)}
SHARES: Final = (0.75, 0.12, 0.09, 0.04)
BEGINS: Final = datetime(2026, 11, 26, 5, tzinfo=UTC)
CLOCKS_CHANGE: Final = datetime.fromisoformat("2026-10-25T00:30:00+02:00")
"""One and a half hours before the hour that occurs twice."""
GAPS: Final = ((0.3, 0.32), (0.55, 0.6))
"""Parts of the footage without frames, as shares of its length."""
MOVED_FROM: Final = 0.9
"""Share of the footage after which the camera looks elsewhere."""
SITE: Final = """time_zone = "Europe/Berlin"

[camera]
size = [1280, 720]
fov_deg = 90.0
position = [0, -90, 25]
yaw_deg = 90.0
pitch_deg = 18.0

[[gates]]
name = "east"
line = [[20, -8], [20, 8]]
directions = ["in", "out"]

[[gates]]
name = "west"
line = [[-20, 8], [-20, -8]]
directions = ["in", "out"]

[[gates]]
name = "north"
line = [[8, 20], [-8, 20]]
directions = ["in", "out"]

[[gates]]
name = "south"
line = [[-8, -20], [8, -20]]
directions = ["in", "out"]

[[zones]]
name = "box"
polygon = [[-8, -8], [8, -8], [8, 8], [-8, 8]]

[[lanes]]
name = "east in"
line = [[100, 2], [9, 2]]
width = 3.5
"""


# -------------------------------------------------------------------------------------------------------------- tracks


def make_tracks(
    folder: Path, hours: float, fps: float, seed: int, clear_s: Sequence[float], *, broken: bool
) -> tuple[int, int]:
    """Write a folder of tracks, without vehicles at the times `clear_s`; returns the number of vehicles and rows.

    If it is `broken`, the footage begins before clocks are changed, has two gaps, and the camera is moved near the end.
    """
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    rows = number = 0
    end_s = hours * 3600
    blind = [(share * end_s, until * end_s) for share, until in (GAPS if broken else ())]
    moved_s = MOVED_FROM * end_s if broken else math.inf
    with (folder / TRACKS_CSV).open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, TRACK_COLUMNS, restval="0", lineterminator="\n")
        writer.writeheader()
        for begin_s, arm in arrivals(rng, hours * 3600):
            way = list(drive(rng, number + 1, begin_s, arm, fps))
            first_s, last_s = float(way[0]["time_s"]), float(way[-1]["time_s"])
            if any(first_s <= at <= last_s for at in clear_s) or last_s >= moved_s:
                continue
            if any(first_s <= until and since <= last_s for since, until in blind):
                continue
            number += 1
            writer.writerows(way)
            rows += len(way)
    times = np.arange(round(end_s * fps)) / fps
    seen = ~np.any([(since <= times) & (times < until) for since, until in blind], axis=0) if blind else slice(None)
    write_footage(folder, times[seen], CLOCKS_CHANGE if broken else BEGINS, moved_s)
    return number, rows


def write_footage(folder: Path, times: Array, start_time: datetime, moved_s: float = math.inf) -> None:
    watched = Observation(
        times_s=times[times < moved_s],
        camera_moved_s=times[times >= moved_s],
        source=f"{folder.name}.mp4",
        common_scale_sigma=0.01,
        camera=Camera.looking([0.0, -90.0, 25.0], yaw=math.pi / 2, pitch_down=0.3, size=(1280, 720)),
        start_time=start_time,
    )
    write_json(folder / FOOTAGE_FILE, watched.to_dict())


def split_tracks(whole: Path, folders: Sequence[Path], part_s: float, fps: float) -> None:
    """Write the tracks of a folder as consecutive recordings of `part_s` seconds each."""
    with contextlib.ExitStack() as files:
        writers = []
        for k, folder in enumerate(folders):
            folder.mkdir(parents=True)
            write_footage(folder, np.arange(round(part_s * fps)) / fps, BEGINS + timedelta(seconds=k * part_s))
            file = files.enter_context((folder / TRACKS_CSV).open("w", encoding="utf-8", newline=""))
            writers.append(csv.writer(file, lineterminator="\n"))
            writers[-1].writerow(TRACK_COLUMNS)
        for row in csv.DictReader(files.enter_context((whole / TRACKS_CSV).open(encoding="utf-8", newline=""))):
            k = min(int((float(row["time_s"]) + 1e-6) // part_s), len(folders) - 1)
            writers[k].writerow({**row, "time_s": f"{float(row['time_s']) - k * part_s:.4f}"}.values())


def arrivals(rng: np.random.Generator, seconds: float) -> Iterator[tuple[float, int]]:
    """Yield the arrival times of vehicles and their arms, in order; vehicles of one green follow each other."""
    mean = PER_HOUR / 3600 * GREEN_S / 2
    for phase in range(int(seconds // GREEN_S)):
        came = []
        for arm in (phase % 2, phase % 2 + 2):
            count = min(int(rng.poisson(mean)), int((GREEN_S - CLEAR_S) / HEADWAY_S) - 1)
            gaps = HEADWAY_S + rng.exponential((GREEN_S - CLEAR_S - count * HEADWAY_S) / (count + 1), count)
            came += [(phase * GREEN_S + float(at), arm) for at in np.cumsum(gaps) if at < GREEN_S - CLEAR_S]
        yield from sorted(came)


def drive(rng: np.random.Generator, number: int, begin_s: float, arm: int, fps: float) -> Iterator[dict[str, str]]:
    """Yield the rows of a vehicle that drives straight on or turns right, with errors of some centimetres."""
    name = str(rng.choice(list(SIZES), p=SHARES))
    speed = float(rng.normal(12, 0.3))
    way = straight_on(speed, fps) if rng.random() < 0.8 else to_the_right(speed, fps)
    turn = np.pi / 2 * arm
    cosine, sine = math.cos(turn), math.sin(turn)
    way = way @ np.array([[cosine, sine], [-sine, cosine]])
    positions = way + np.cumsum(rng.normal(0, 0.004, way.shape), axis=0)
    velocity = np.gradient(positions, 1 / fps, axis=0)
    heading = np.degrees(np.arctan2(velocity[:, 1], velocity[:, 0]))
    length, width = SIZES[name]
    first = math.ceil(begin_s * fps)
    for i in range(len(way)):
        yield {
            "track": str(number),
            "category": "vehicle",
            "class": name,
            "class_confidence": "0.92",
            "body_type": "",
            "frame": str(first + i),
            "time_s": f"{(first + i) / fps:.4f}",
            "detected": "1",
            "located": str(int(i % 5 != 3)),
            **{axis: f"{v:.3f}" for axis, v in zip("xy", positions[i], strict=True)},
            "heading_deg": f"{heading[i]:.2f}",
            **{axis: f"{v:.3f}" for axis, v in zip(("vx", "vy"), velocity[i], strict=True)},
            "ax": "",
            "ay": "",
            "sigma_speed": "0.150",
            "sigma_xx": "0.006400",
            "sigma_xy": "0.000000",
            "sigma_yy": "0.006400",
            "length": str(length),
            "width": str(width),
            "height": "",
            "flags": "",
        }


def straight_on(speed: float, fps: float) -> Array:
    """Return the path (M, 2) from the east to the west, on the right."""
    x = np.arange(HALF_M, -HALF_M, -speed / fps)
    return np.stack([x, np.full_like(x, LANE_M)], axis=1)


def to_the_right(speed: float, fps: float) -> Array:
    """Return the path (M, 2) from the east to the north."""
    radius, end = 6.0, LANE_M + 6.0
    length = 2 * (HALF_M - end) + radius * np.pi / 2
    at = np.arange(0, length, speed / fps)
    angle = np.clip((at - (HALF_M - end)) / radius, 0, np.pi / 2)
    after = np.maximum(at - (HALF_M - end) - radius * np.pi / 2, 0)
    x = np.where(at < HALF_M - end, HALF_M - at, end - radius * np.sin(angle))
    y = np.where(at < HALF_M - end, LANE_M, end - radius * np.cos(angle) + after)
    return np.stack([x, y], axis=1)


# ----------------------------------------------------------------------------------------------------------- measuring


def started(tracks: Sequence[Path], site: Path, out: Path) -> subprocess.Popen[bytes]:
    words = [
        "eval",
        "traffic",
        *map(str, tracks),
        "--site",
        str(site),
        "--export",
        "otanalytics",
        "--out",
        str(out),
        "-q",
    ]
    return subprocess.Popen([sys.executable, "-m", "skope", *words], stdout=subprocess.DEVNULL)


def finished(process: subprocess.Popen[bytes]) -> tuple[int, float]:
    """Wait for a process; returns its exit code and peak memory, MB."""
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    return process.returncode, used.ru_maxrss / 1024


def killed(process: subprocess.Popen[bytes], out: Path, draw: random.Random, seconds: float) -> str:
    """Kill a run after a random time, or when a random number of files has been begun; returns a description."""
    begun = time.monotonic()
    files = len(list(out.rglob("*")))
    if draw.random() < 0.5:
        after = draw.uniform(0.05, 0.95) * seconds
        while time.monotonic() - begun < after and process.poll() is None:
            time.sleep(0.002)
    else:
        # Files that are being written have other names, with `.part` in them.
        wanted = draw.randint(1, 12)
        seen = set[str]()
        while len(seen) < wanted and process.poll() is None:
            seen |= {path.name for path in out.rglob(".*.part*")}
            time.sleep(0.0005)
    process.send_signal(signal.SIGKILL)
    code = finished(process)[0] if process.returncode is None else process.returncode
    left = len(list(out.rglob(".*.part*")))
    outcome = "finished before" if code == 0 else f"killed after {time.monotonic() - begun:.1f} s"
    return f"{outcome}; files {files} -> {len(list(out.rglob('*')))}, {left} half-written"


def contents(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def measured(tracks: Sequence[Path], site: Path, out: Path) -> tuple[dict[str, bytes], float, str]:
    """Measure a report: its contents, its seconds, and cells of a table with seconds, memory and sizes."""
    begun = time.monotonic()
    code, peak = finished(started(tracks, site, out))
    seconds = time.monotonic() - begun
    if code:
        sys.exit(f"skope eval traffic ended with {code}")
    found = contents(out)
    sizes = {name: len(data) / 1e6 for name, data in found.items()}
    largest = ", ".join(f"{name} {size:.2f}" for name, size in sorted(sizes.items(), key=lambda item: -item[1])[:4])
    read = sum(path.stat().st_size for folder in tracks for path in folder.iterdir()) / 1e6
    return found, seconds, f"{read:.1f} | {seconds:.1f} | {peak:.0f} | {sum(sizes.values()):.1f} | {largest}"


def counted(report: dict[str, bytes]) -> dict[str, int]:
    """Return the counts of a report by gate and direction."""
    rows = csv.DictReader(report["counts.csv"].decode("utf-8-sig").splitlines())
    found = Counter[str]()
    for row in rows:
        if row["class"] == row["lane"] == "all":
            found[f"{row['gate']} {row['direction']}"] += int(row["count"] or 0)
    return dict(found)


def compare_recordings(options: argparse.Namespace, whole: dict[str, bytes], site: Path) -> None:
    """Measure the tracks as several recordings, and print the differences from the unbroken one."""
    folders = [options.out / "recordings" / f"{k:02}" for k in range(options.recordings)]
    split_tracks(options.out / "tracks", folders, options.hours * 3600 / options.recordings, options.fps)
    parts, _, cells = measured(folders, site, options.out / "of_recordings")
    print(f"| {options.recordings} recordings | | | {cells} |", flush=True)
    for name in ("counts.csv", "turning_movements.csv", "speeds.csv", "delays.csv", "occupancy.csv", "headways.csv"):
        unbroken, joined = (report[name].decode().splitlines() for report in (whole, parts))
        same = (
            "the same bytes"
            if unbroken == joined
            else f"{len(unbroken)} and {len(joined)} lines, {len({*unbroken} ^ {*joined})} differ"
        )
        print(f"{name}: {same}")
    print("counts, unbroken:", counted(whole))
    print("counts, recordings:", counted(parts))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=1.0, help="hours of footage, 8 for a working day")
    parser.add_argument("--fps", type=float, default=10.0)
    parser.add_argument("--kills", type=int, default=5, help="how often the second run is killed; 0: no second run")
    parser.add_argument("--recordings", type=int, default=1, help="also measure the tracks as this many recordings")
    parser.add_argument("--cut", action="store_true", help="keep vehicles that are on the road when a recording ends")
    parser.add_argument("--broken", action="store_true", help="add gaps, a change of clocks and a moved camera")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="a new folder")
    options = parser.parse_args()
    out = options.out
    tracks, site = out / "tracks", out / "site.toml"
    cuts = [k * options.hours * 3600 / options.recordings for k in range(1, options.recordings)]
    clear_s = [] if options.cut else cuts
    vehicles, rows = make_tracks(tracks, options.hours, options.fps, options.seed, clear_s, broken=options.broken)
    site.write_text(SITE, encoding="utf-8")

    whole, seconds, cells = measured([tracks], site, out / "whole")
    print("| hours | vehicles | rows | tracks, MB | seconds | peak MB | report, MB | largest |")
    print(f"| {options.hours} | {vehicles} | {rows} | {cells} |", flush=True)
    if options.recordings > 1:
        compare_recordings(options, whole, site)
    if not options.kills:
        return

    draw = random.Random(options.seed)
    for _ in range(options.kills):
        print(killed(started([tracks], site, out / "killed"), out / "killed", draw, seconds), flush=True)
    code, _ = finished(started([tracks], site, out / "killed"))
    again = contents(out / "killed")
    different = sorted(name for name in whole.keys() | again.keys() if whole.get(name) != again.get(name))
    if code or different:
        sys.exit(f"the resumed run ended with {code}; different: {', '.join(different) or 'nothing'}")
    print(f"{len(whole)} files: the same bytes")
    shutil.rmtree(out / "killed")


if __name__ == "__main__":
    main()
