"""What really happened before the camera of a generated clip.

    python scripts/research/traffic_truth.py t06_plaza_opening --seconds 20 --fps 10 --out clips/plaza_day

It simulates what `skope gen video` simulates with the same options, and writes truth.npz: the place of every road user
in every frame, also where the image does not show it.
"""

import argparse
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.errors import UserError
from skope.files.atomic import replacing
from skope.gen.bystanders import bystander
from skope.gen.bystanders.bystander import CATEGORY_OF
from skope.gen.labels.annotate import Rules
from skope.gen.labels.boxes_and_masks import box_around
from skope.gen.pipeline.config import from_preset
from skope.gen.pipeline.write_footage import plan_of
from skope.gen.scene.recording import Recording, RecordingPlan, vehicle_body
from skope.gen.simulation.simulate import simulate
from skope.schema import VEHICLE
from skope.site.gates_zones_lanes import Gate
from skope.tracking.tracks import OF_BODY_TYPE
from skope.tracks.track import Track
from skope.traffic.gates import signed_distances
from skope.types import Array

TRUTH: Final = "truth.npz"
FOV_DEG: Final = 80.0
STILL_M: Final = 2.0
"""Who moves less than this stands."""


# ----------------------------------------------------------------------------------------------------------- recording


def plan_as_video(
    name: str, *, seconds: float, fps: float, size: str, weather: str, time_of_day: str, seed: int
) -> RecordingPlan:
    """The plan that `skope gen video` makes with --road-users."""
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
    """Write the place of each road user in each frame, as labels have it: under the middle of its box."""
    rows = []
    who: dict[int, tuple[str, str, float, float, bool]] = {}
    for frame in range(len(recording)):
        moment = recording.moment(frame)
        for i, recorded in enumerate(moment.vehicles):
            T = moment.T_world_chassis[i]
            if recorded.labelled:
                vehicle = vehicle_body(recorded)
                category, kind = VEHICLE, OF_BODY_TYPE.get(vehicle.vehicle_type, "car")
                center, size = T[:3, 3] + T[:3, 2] * vehicle.size_lwh[2] / 2, vehicle.size_lwh
                if vehicle.trailer is not None:
                    center, size = box_around(vehicle, vehicle.trailer, T, moment.T_world_trailer[i, 0])
            else:
                category = kind = CATEGORY_OF[recorded.model]
                low, high = bystander.build_bystander(recorded.model, recorded.shape).box
                center, size = T[:3, :3] @ ((low + high) / 2) + T[:3, 3], high - low
            who.setdefault(recorded.track_id, (category, kind, float(size[0]), float(size[1]), recorded.parked))
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
            who=np.array([(str(number), *map(str, row)) for number, row in sorted(who.items())]),
        )


@dataclass(frozen=True)
class Truth:
    """What really happened."""

    times_s: Array
    trajectories: Sequence[Track]
    """Of everybody, by number; those who stand all the time are flagged as never moved."""


def read_truth(folder: Path) -> Truth:
    """Read truth.npz; places are exact, so their covariances are zero."""
    with np.load(folder / TRUTH, allow_pickle=False) as file:
        times, frame, track = file["times_s"], file["frame"], file["track"]
        state, who = file["state"].astype(np.float64), file["who"]
    found = [_trajectory(row, times, frame[own], state[own]) for row in who for own in [track == int(row[0])]]
    return Truth(times, [one for one in found if len(one.times_s) > 1])


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
    """How far labels are from the truth's places, metres, at most; an error where they are of other traffic.

    `document` is the file that `skope gen video` wrote.
    """
    at = {
        (one.number, round(float(time_s), 4)): place
        for one in truth.trajectories
        for time_s, place in zip(one.times_s, one.xy, strict=True)
    }
    times = {image["id"]: round(float(image["time_s"]), 4) for image in document["images"]}
    places = [at.get((row["track_id"], times[row["image_id"]])) for row in document["annotations"]]
    pairs = zip(places, document["annotations"], strict=True)
    worst = max((math.dist(p, row["box_3d"]["center"][:2]) for p, row in pairs if p is not None), default=0.0)
    missing = sum(place is None for place in places)
    if worst > 0.05 or missing > 0.01 * len(places):
        raise UserError(f"the truth is of other traffic than the labels: {worst:.2f} m off, {missing} are not in it")
    return worst


# ------------------------------------------------------------------------------------------------------------ counting


def plain_counts(truth: Truth, gates: Sequence[Gate]) -> Mapping[tuple[str, int], list[tuple[int, float]]]:
    """Each time that somebody's middle goes across a gate: (gate, direction) -> numbers and times.

    This is nothing but where the step from one moment to the next cuts the line: it knows no hysteresis, and checks
    what `skope.traffic` makes of the same places.
    """
    out: dict[tuple[str, int], list[tuple[int, float]]] = {(gate.name, k): [] for gate in gates for k in (0, 1)}
    for one in truth.trajectories:
        for gate in gates if "never_moved" not in one.flags else ():
            signed, along = signed_distances(gate, one.xy)
            left = signed > 0
            for i in np.flatnonzero(left[1:] != left[:-1]):
                share = signed[i] / (signed[i] - signed[i + 1])
                if 0 <= along[i] + share * (along[i + 1] - along[i]) < math.dist(*gate.line):
                    time_s = float(one.times_s[i] + share * (one.times_s[i + 1] - one.times_s[i]))
                    out[gate.name, 0 if left[i] else 1].append((one.number, time_s))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("site", help="a site of `skope gen sites`")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--fps", type=float, default=10.0)
    parser.add_argument("--size", default="1280x720")
    parser.add_argument("--weather", default="clear")
    parser.add_argument("--time-of-day", default="noon")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True, help="folder of the clip")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    asked = {name: getattr(options, name) for name in ("seconds", "fps", "size", "weather", "time_of_day", "seed")}
    write_truth(options.out / TRUTH, simulate(plan_as_video(options.site, **asked)))


if __name__ == "__main__":
    main()
