"""Frames per second of `skope gen`, and of pybullet's renderers on the same scene in the same run.

skope writes whole frames (JPEG, depth, annotations); the peers draw colour, depth and ids of the whole scene with one
`getCameraImage` a frame, and for the labels every vehicle once more by itself. One process per core, each with one
thread, all at work at the same time; figures are medians over processes. Run: make bench
"""

import argparse
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np

from skope.gen.recording import Recording
from skope.gen.simulate import RecordingPlan, simulate
from skope.gen.towns import site
from skope.gen.vehicles import build

STAGES = {
    "skope.gen.render.gl.renderer": {"GLRenderer": ["render"]},
}


def plan_of(options: argparse.Namespace) -> RecordingPlan:
    width, height = map(int, options.size.split("x"))
    return RecordingPlan(
        site=site(options.site), index=0, frames=options.frames, interval=0.5, size=(width, height), fov_deg=110, seed=0
    )


def with_vehicles(recording: Recording, count: int) -> Recording:
    """The recording with the `count` vehicles that are nearest to the camera of those in the image, in each frame."""
    from skope.gen.render.windows import window_of

    keep = []
    for frame in range(len(recording)):
        moment = recording.moment(frame)
        first = int(np.searchsorted(recording.frame, frame))
        away = np.linalg.norm(moment.T_world_chassis[:, :3, 3] - recording.camera.position, axis=1)
        shown = [
            i
            for i in away.argsort(kind="stable")
            if window_of(
                build(moment.vehicles[i].model, moment.vehicles[i].shape), moment.T_world_chassis[i], recording.camera
            )
        ]
        chosen = np.unique(np.linspace(0, len(shown) - 1, count).round().astype(int)) if shown else []
        keep += sorted(first + shown[k] for k in chosen)
    names = ("frame", "vehicle", "T_world_chassis", "T_world_wheels", "velocity", "lamps")
    return replace(recording, **{name: getattr(recording, name)[keep] for name in names})


# -------------------------------------------------------------------------------------------------------------- skope


def skope_frames(recording: Recording, plan: RecordingPlan, root: Path, renderer: str) -> Callable[[int], None]:
    """What `skope gen` does for each frame."""
    from skope.gen.annotate import Rules, annotate
    from skope.gen.render import make_renderer
    from skope.gen.store import Store

    store, draws = Store(root), make_renderer(renderer, recording)

    def frame_to_disk(frame: int) -> None:
        view = draws.render(frame)
        annotations, tally = annotate(recording.moment(frame), view, recording.camera, Rules(), image_id=0)
        store.add(plan, recording, frame, view, annotations, tally)

    return frame_to_disk


def stage_times(recording: Recording, plan: RecordingPlan, root: Path) -> dict[str, float]:
    """Milliseconds a frame by stage; waiting for the device after each of them, the sum is a little larger."""
    from skope.gen import store
    from skope.gen.render.gl import renderer as gl

    times: dict[str, float] = {}
    nested: list[float] = []

    def timed(owner: Any, name: str, label: str) -> None:
        plain = getattr(owner, name)

        @wraps(plain)
        def run(*args: Any, **keywords: Any) -> Any:
            begun = time.perf_counter()
            nested.append(0.0)
            value = plain(*args, **keywords)
            gl.device().context.finish()
            spent = time.perf_counter() - begun
            times[label] = times.get(label, 0.0) + spent - nested.pop()
            if nested:
                nested[-1] += spent
            return value

        setattr(owner, name, run)

    for owner, name, label in (
        *((gl.GLRenderer, name, label) for name, label in gl.STAGES.items()),
        (store, "encode_depth", "write"),
    ):
        timed(owner, name, label)
    return times


if __name__ == "__main__":
    pass
