"""Generated clips with their complete truth, for scores of `skope eval traffic`.

    python scripts/research/traffic_clips.py make --out clips                                    # many cores and a GPU
    python scripts/research/traffic_clips.py detect clips --checkpoint NEW.safetensors --gpus 0,1,2,3
    python scripts/research/traffic_scores.py counts clips                                       # a CPU

A clip's folder has the video, its labels, truth.npz with the position of each road user in each frame (including
invisible ones), site.toml with the gates, and the detections. Gates are placed by a rule that uses only the road
network and the camera: one across each arm of a junction, 10 to 40 m from it, or across a road without a junction
that near; wholly inside the image, with some road before and behind.

The clips are four sites by day, at night and in rain, and one of them also at 25 frames per second. `--only` selects
clips by name, separated by commas; `--seconds` and `--size` make smaller ones. Finished work is not repeated. `make`
runs `truth` for each clip; it simulates the same traffic as `skope gen video` with the same options.

`road33` was trained on t03_circle_mast, and on none of the others (split extra).
"""

import argparse
import math
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

import numpy as np

from skope.camera.model import Camera
from skope.dataset.folder import PREDICTIONS_FILE
from skope.errors import UserError
from skope.files.atomic import replacing
from skope.files.json_files import read_json, write_json
from skope.gen.bystanders import bystander
from skope.gen.bystanders.bystander import CATEGORY_OF
from skope.gen.labels.annotate import box_around
from skope.gen.labels.ignore_rules import Rules
from skope.gen.pipeline.config import from_preset
from skope.gen.pipeline.write_footage import plan_of
from skope.gen.scene.recording import Recording, RecordingPlan, vehicle_body
from skope.gen.simulation.simulate import simulate
from skope.gen.towns.road_graph import RoadGraph, beside, edges_at
from skope.gen.towns.sites import site
from skope.schema import VEHICLE_CATEGORY
from skope.site.gates_zones_lanes import Gate
from skope.tracking.tracks import OF_BODY_TYPE
from skope.tracks.track import Track
from skope.traffic.gates import signed_distances
from skope.types import Array

CLIP: Final = "clip.json"
"""The options that a clip was made with; written last."""
LABELS: Final = "labels.json"
SEEN: Final = "seen"
NOISE_PX: Final = "2"
PER_GPU: Final = 2


@dataclass(frozen=True)
class Clip:
    """A clip to make."""

    site: str
    light: str
    fps: float = 10.0
    seconds: float = 180.0

    @property
    def name(self) -> str:
        """Name of the clip's folder."""
        return f"{self.site}_{self.light}" + ("" if self.fps == 10 else f"_{self.fps:g}")


SITES: Final = {
    "t05_third_median": "a signalled crossing with turning movements and its queue",
    "t03_circle_mast": "a roundabout with four arms",
    "t05_park_pole": "an avenue of several lanes",
    "t06_plaza_opening": "the opening of a median before a plaza",
}
SEEDS: Final = {"t03_circle_mast": 1}
"""Seeds other than 0; with 0 the roundabout is one jam, and no vehicle crosses a gate in the image."""
LIGHTS: Final = {"day": ("clear", "noon"), "night": ("clear", "night"), "rain": ("rain", "noon")}
CLIPS: Final = (
    Clip("t05_third_median", "day", fps=25.0, seconds=120.0),  # the longest one first
    *(Clip(site, light) for site in SITES for light in LIGHTS),
)
CHECKS: Final = (
    *(Clip("t06_willow_turn", "day"), Clip("t02_elm_corner", "day")),
    *(Clip("t06_harlan_long", "night"), Clip("t02_cedar_pole", "rain")),
)
"""Clips of other sites, to check the rates that are fitted on `CLIPS` (skope/traffic/event_probability.py)."""
TRUTH: Final = "truth.npz"
FOV_DEG: Final = 80.0
STILL_M: Final = 2.0
"""Road users that move less than this are stationary."""


def plan_as_video(
    name: str, *, seconds: float, fps: float, size: str, weather: str, time_of_day: str, seed: int
) -> RecordingPlan:
    """Return the plan that `skope gen video` makes with --road-users."""
    asked = from_preset(
        "demo",
        seed=seed,
        renderer="gl",
        driver="",
        rules=Rules(),
        frames=1,
        sites=(name,),
        size=size,
        fov_deg=FOV_DEG,
        road_users=True,
    )
    plan = plan_of(asked.plans()[0], fps, seconds)
    return replace(plan, site=replace(plan.site, weather=weather, time_of_day=time_of_day, conditions={}))


def write_truth(path: Path, recording: Recording) -> None:
    """Write the position of each road user in each frame, as in labels: below the middle of its box."""
    rows = []
    road_users: dict[int, tuple[str, str, float, float, bool]] = {}
    for frame in range(len(recording)):
        moment = recording.moment(frame)
        for i, recorded in enumerate(moment.vehicles):
            T = moment.T_world_chassis[i]
            if recorded.labelled:
                vehicle = vehicle_body(recorded)
                category, kind = VEHICLE_CATEGORY, OF_BODY_TYPE.get(vehicle.vehicle_type, "car")
                center, size = T[:3, 3] + T[:3, 2] * vehicle.size_lwh[2] / 2, vehicle.size_lwh
                if vehicle.trailer is not None:
                    center, size = box_around(vehicle, vehicle.trailer, T, moment.T_world_trailer[i, 0])
            else:
                category = kind = CATEGORY_OF[recorded.model]
                low, high = bystander.build_bystander(recorded.model, recorded.shape).box
                center, size = T[:3, :3] @ ((low + high) / 2) + T[:3, 3], high - low
            road_users.setdefault(recorded.track_id, (category, kind, float(size[0]), float(size[1]), recorded.parked))
            yaw = math.atan2(T[1, 0], T[0, 0])
            rows.append((frame, recorded.track_id, *center[:2], yaw, *moment.velocity[i][:2]))
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            times_s=recording.times_s,
            frame=table[:, 0].astype(np.int32),
            track=table[:, 1].astype(np.int32),
            state=table[:, 2:].astype(np.float32),
            who=np.array([(str(number), *map(str, row)) for number, row in sorted(road_users.items())]),
        )


@dataclass(frozen=True)
class Truth:
    """The tracks of all road users."""

    times_s: Array
    trajectories: Sequence[Track]
    """By number; road users that never move have the flag `never_moved`."""


def read_truth(folder: Path) -> Truth:
    """Read truth.npz; its positions are exact, so their covariances are zero."""
    with np.load(folder / TRUTH, allow_pickle=False) as file:
        times, frame, track = file["times_s"], file["frame"], file["track"]
        state, road_users = file["state"].astype(np.float64), file["who"]
    found = [
        _trajectory(row, times, frame[of_track], state[of_track])
        for row in road_users
        for of_track in [track == int(row[0])]
    ]
    return Truth(times, [trajectory for trajectory in found if len(trajectory.times_s) > 1])


def _trajectory(row: Sequence[str], times: Array, frame: Array, state: Array) -> Track:
    number, category, kind, length, width, parked = row
    n = len(frame)
    moves = n > 0 and float(np.ptp(state[:, :2], axis=0).max()) > STILL_M
    return Track(
        number=int(number),
        category=str(category),
        class_name=str(kind),
        class_confidence=1.0,
        times_s=times[frame],
        position=np.column_stack([state[:, :2], np.zeros(n)]),
        velocity=state[:, 3:5],
        heading=state[:, 2],
        covariance=np.zeros((n, 2, 2)),
        speed_sigma=np.zeros(n),
        located=np.ones(n, dtype=bool),
        length=float(length),
        width=float(width),
        flags=() if moves and parked == "False" else ("never_moved",),
    )


def check_labels(truth: Truth, document: Mapping[str, Any]) -> float:
    """Return the largest distance of labels from the true positions, metres.

    Raises UserError if the labels are of other traffic. `document` is the file that `skope gen video` wrote.
    """
    at = {
        (trajectory.number, round(float(time_s), 4)): position
        for trajectory in truth.trajectories
        for time_s, position in zip(trajectory.times_s, trajectory.xy, strict=True)
    }
    times = {image["id"]: round(float(image["time_s"]), 4) for image in document["images"]}
    places = [at.get((row["track_id"], times[row["image_id"]])) for row in document["annotations"]]
    pairs = zip(places, document["annotations"], strict=True)
    worst = max((math.dist(p, row["box_3d"]["center"][:2]) for p, row in pairs if p is not None), default=0.0)
    missing = sum(position is None for position in places)
    if worst > 0.05 or missing > 0.01 * len(places):
        raise UserError(f"truth and labels show different traffic: {worst:.2f} m apart, {missing} labels without truth")
    return worst


def plain_counts(truth: Truth, gates: Sequence[Gate]) -> Mapping[tuple[str, int], list[tuple[int, float]]]:
    """Find the crossings of road users' middles over gates: (gate, direction) -> numbers and times.

    A crossing is a step between two moments that cuts the line. This has no hysteresis and checks what `skope.traffic`
    computes from the same positions.
    """
    out: dict[tuple[str, int], list[tuple[int, float]]] = {(gate.name, k): [] for gate in gates for k in (0, 1)}
    for trajectory in truth.trajectories:
        for gate in gates if "never_moved" not in trajectory.flags else ():
            signed, along = signed_distances(gate, trajectory.xy)
            left = signed > 0
            for i in np.flatnonzero(left[1:] != left[:-1]):
                share = signed[i] / (signed[i] - signed[i + 1])
                if 0 <= along[i] + share * (along[i + 1] - along[i]) < math.dist(*gate.line):
                    time_s = float(trajectory.times_s[i] + share * (trajectory.times_s[i + 1] - trajectory.times_s[i]))
                    out[gate.name, 0 if left[i] else 1].append((trajectory.number, time_s))
    return out


SITE: Final = "site.toml"
FROM_JUNCTION_M: Final = (10.0, 40.0)
STEP_M: Final = 2.5
BESIDE_M: Final = 3.0
"""A gate ends this far beyond the outermost lanes: it covers the pavements, where people walk up to 2.1 m away."""
BEFORE_M: Final = 7.0
"""Length of road before and behind a gate that must be in the image."""
HIGHEST_M: Final = 1.5
"""Height above the road that must be in the image."""
MARGIN: Final = 0.03
"""Least distance from the edge of the image, as a share of its size."""
FARTHEST_M: Final = 80.0
USUAL_M: Final = 35.0
"""Preferred distance of a gate from the camera if no junction is near."""


@dataclass(frozen=True)
class _GatePosition:
    """A possible position of a gate."""

    line: Array
    """(2, 2) first and second end; traffic towards the junction comes from its left."""
    from_junction: float
    """Metres along the road; infinite without a junction."""
    from_camera: float


def gates_of(graph: RoadGraph, camera: Camera, level: float) -> list[Gate]:
    """Place gates across the arms that a camera sees, by the rule above."""
    arms: dict[frozenset[str], list[Any]] = {}
    for edge in graph.edges:
        arms.setdefault(frozenset((edge.getFromNode().getID(), edge.getToNode().getID())), []).append(edge)
    chosen = []
    for edges in arms.values():
        places = [
            position for position in _gate_positions(graph, edges, camera.position) if _seen(position, camera, level)
        ]
        near = [position for position in places if FROM_JUNCTION_M[0] <= position.from_junction <= FROM_JUNCTION_M[1]]
        if near:
            chosen.append(min(near, key=lambda position: (position.from_junction, position.from_camera)))
        elif places:
            chosen.append(min(places, key=lambda position: abs(position.from_camera - USUAL_M)))
    chosen.sort(key=lambda position: position.from_camera)
    return [
        Gate(
            name=f"arm{number}",
            line=tuple((round(float(x), 2), round(float(y), 2)) for x, y in position.line),
            directions=("in", "out"),
        )
        for number, position in enumerate(chosen, start=1)
    ]


def _gate_positions(graph: RoadGraph, edges: Sequence[Any], eye: Array) -> Iterator[_GatePosition]:
    """Yield the possible gates along an arm from both of its ends, each across all lanes."""
    lanes = np.concatenate([graph.lane_points[str(edge.getID())][:, :2] for edge in edges])
    half = max(lane.getWidth() for edge in edges for lane in edge.getLanes()) / 2
    edge = edges[0]
    length = edge.getLength()
    for s in np.arange(STEP_M, length, STEP_M):
        at, heading = beside(edge, float(s), 0.0)
        at = graph.world(at)
        ahead = graph.world([math.cos(heading), math.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        near = np.abs((lanes - at) @ ahead) < 1.0
        aside = ((lanes - at) @ left)[near]
        if not len(aside):
            continue
        low, high = aside.min() - half - BESIDE_M, aside.max() + half + BESIDE_M
        for node, away, sign in ((edge.getToNode(), length - s, 1), (edge.getFromNode(), s, -1)):
            # Traffic along `ahead` has the line's first end on its right, and so comes from the line's left.
            ends = (low, high) if sign > 0 else (high, low)
            line = np.array([at + left * end for end in ends])
            yield _GatePosition(
                line, float(away) if _is_junction(node) else math.inf, math.dist(line.mean(axis=0), eye[:2])
            )


def _is_junction(node: Any) -> bool:
    """Return whether three or more arms meet at a node."""
    neighbours = {n.getID() for edge in edges_at(node) for n in (edge.getFromNode(), edge.getToNode())} - {node.getID()}
    return len(neighbours) > 2


def _seen(position: _GatePosition, camera: Camera, level: float) -> bool:
    along = position.line[1] - position.line[0]
    ahead = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    points = [
        [*(end + ahead * shift), level + height]
        for end in position.line
        for shift in (-BEFORE_M, BEFORE_M)
        for height in (0.0, HIGHEST_M)
    ]
    pixels, _, valid = camera.project(np.array(points))
    size = np.array([camera.width, camera.height])
    inside = ((pixels > MARGIN * size) & (pixels < (1 - MARGIN) * size)).all()
    return bool(valid.all() and inside and position.from_camera < FARTHEST_M)


def write_site(path: Path, gates: Sequence[Gate]) -> None:
    """Write a site file with these gates and nothing else."""
    rows = []
    for gate in gates:
        line = [list(end) for end in gate.line]
        rows.append(f'[[gates]]\nname = "{gate.name}"\nline = {line}\ndirections = {list(gate.directions or ())}\n')
    path.write_text("\n".join(rows).replace("'", '"'))


def road_of(name: str, size: str) -> tuple[RoadGraph, Camera, float]:
    """Return the network, camera and road height of a site; `size` of the image as 1280x720."""
    width, height = map(int, size.split("x"))
    here = site(name)
    graph, camera = RoadGraph.of(here.town), here.camera((width, height), FOV_DEG)
    yaw = camera.angles[0]
    return graph, camera, graph.road_level(camera.position[:2] + 25 * np.array([math.cos(yaw), math.sin(yaw)]))


def chosen(only: str) -> list[Clip]:
    """Return the clips with these names, `CHECKS` for "checks", `CLIPS` without names."""
    if only == "checks":
        return list(CHECKS)
    known = {clip.name: clip for clip in (*CLIPS, *CHECKS)}
    wrong = [name for name in only.split(",") if only and name not in known]
    if wrong:
        sys.exit(f"--only: {wrong[0]} is not one of {', '.join(known)}")
    return [known[name] for name in only.split(",")] if only else list(CLIPS)


def make(options: argparse.Namespace) -> None:
    """Make all clips in parallel, each with its truth and its gates."""
    clips = chosen(options.only)
    with ThreadPoolExecutor(len(clips)) as threads:
        made = list(threads.map(lambda clip: make_clip(clip, options), clips))
    if not all(made):
        sys.exit(
            f"not made: {', '.join(clip.name for clip, was_made in zip(clips, made, strict=True) if not was_made)}"
        )


def make_clip(clip: Clip, options: argparse.Namespace) -> bool:
    """Make a clip unless it exists; returns whether it exists now."""
    folder = options.out / clip.name
    asked = asked_for(clip, options)
    if (folder / CLIP).is_file():
        if read_json(folder / CLIP) == asked:
            return True
        print(f"{folder}: contains a different clip of this name; choose another --out")
        return False
    same = [f"--{key.replace('_', '-')}={asked[key]}" for key in ("seconds", "fps", "size", "weather", "time_of_day")]
    same += ["--seed", str(asked["seed"]), "--out", str(folder)]
    video = ["-m", "skope", "gen", "video", clip.site, "--road-users", "--fov", f"{FOV_DEG:g}", "-q", *same]
    folder.mkdir(parents=True, exist_ok=True)
    few = {**os.environ, "OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}  # many run in parallel
    with (folder / "make.log").open("wb") as log:
        started = [
            subprocess.Popen(["nice", "-n", "10", sys.executable, *words], stdout=log, stderr=log, env=few)
            for words in (video, [__file__, "truth", clip.site, *same])
        ]
        if max([process.wait() for process in started]):
            print(f"{clip.name}: failed; see {folder}/make.log")
            return False
    (folder / f"{clip.site}.json").replace(folder / LABELS)
    check_labels(read_truth(folder), read_json(folder / LABELS))
    write_site(folder / SITE, gates_of(*road_of(clip.site, options.size)))
    write_json(folder / CLIP, asked)
    print(f"{clip.name}: made", flush=True)
    return True


def asked_for(clip: Clip, options: argparse.Namespace) -> dict[str, Any]:
    """Return the options that a clip is made with."""
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


def detect(options: argparse.Namespace) -> None:
    """Run the detector on all clips."""
    gpus: SimpleQueue[str] = SimpleQueue()
    numbers = options.gpus.split(",")
    for gpu in numbers * PER_GPU:
        gpus.put(gpu)

    def detect_clip(clip: Clip) -> bool:
        gpu, folder = gpus.get(), options.folder / clip.name
        words = ["eval", "predict", str(folder / f"{clip.site}.mp4"), "--checkpoint", str(options.checkpoint)]
        with (folder / "detect.log").open("wb") as log:
            code = subprocess.run(
                [sys.executable, "-m", "skope", *words, "--out", str(folder / SEEN), "-q"],
                stdout=log,
                stderr=log,
                check=False,
                env={**os.environ, "CUDA_VISIBLE_DEVICES": gpu},
            ).returncode
        gpus.put(gpu)
        print(f"{clip.name}: {'failed; see its detect.log' if code else 'detected'}", flush=True)
        return not code

    clips = [clip for clip in chosen(options.only) if (options.folder / clip.name / CLIP).is_file()]
    new = [clip for clip in clips if not (options.folder / clip.name / SEEN / PREDICTIONS_FILE).is_file()]
    with ThreadPoolExecutor(PER_GPU * len(numbers)) as threads:
        done = list(threads.map(detect_clip, new))
    if not clips or not all(done):
        sys.exit(f"{options.folder}: not all clips are detected")


def simulate_truth(options: argparse.Namespace) -> None:
    """Simulate a clip and write its truth."""
    options.out.mkdir(parents=True, exist_ok=True)
    asked = {name: getattr(options, name) for name in ("seconds", "fps", "size", "weather", "time_of_day", "seed")}
    write_truth(options.out / TRUTH, simulate(plan_as_video(options.site, **asked)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    making = commands.add_parser("make", help="make the clips")
    making.add_argument("--out", type=Path, required=True)
    making.add_argument("--seconds", type=float, default=0.0, help="length of each clip; 0: its own")
    making.set_defaults(run=make)
    detecting = commands.add_parser("detect", help="run the detector")
    detecting.add_argument("folder", type=Path)
    detecting.add_argument("--checkpoint", default="road33")
    detecting.add_argument("--gpus", default="0", help="numbers of the GPUs, separated by commas")
    detecting.set_defaults(run=detect)
    for command in (making, detecting):
        command.add_argument("--only", default="", help="names of clips, separated by commas, or `checks`")
    truth = commands.add_parser("truth", help="write the truth of one clip")
    truth.add_argument("site", help="a site of `skope gen sites`")
    truth.add_argument("--seconds", type=float, default=30.0)
    truth.add_argument("--fps", type=float, default=10.0)
    truth.add_argument("--weather", default="clear")
    truth.add_argument("--time-of-day", default="noon")
    truth.add_argument("--seed", type=int, default=0)
    truth.add_argument("--out", type=Path, required=True, help="folder of the clip")
    truth.set_defaults(run=simulate_truth)
    for command in (making, truth):
        command.add_argument("--size", default="1280x720")
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
