"""A small dataset as `skope gen` makes them, written by hand without simulating or rendering, for tests to spoil."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.dataset import coco
from skope.dataset.depth_files import depth_png
from skope.files.json_files import json_bytes, write_json
from skope.gen.labels.annotate import RuleCounts
from skope.gen.labels.ignore_rules import Rules
from skope.gen.output.frames import image_of
from skope.gen.output.writers import FrameFiles, Labels, checksum, count_kind
from skope.gen.pipeline.config import from_preset
from skope.gen.pipeline.dataset_store import Store
from skope.gen.pipeline.generate import finish_rendering
from skope.gen.pipeline.workers import local_pool
from skope.gen.render.frame import RenderedFrame, Silhouette
from skope.gen.scene import recording as recordings
from skope.gen.scene.recording import Recording
from skope.terminal.console import Console
from tests.gen.scenes import standing
from tests.samples import make_annotation

SIZE = (160, 120)
SITES = {"train": "t01_mill_corner", "val": "t01_main_west"}
"""Site of each split."""


class FlatRenderer:
    """Draws grey frames in which no vehicle is seen, at once."""

    def __init__(self, _name: str, recording: Recording, on_light: Callable[[], None] = lambda: None) -> None:
        on_light()
        on_light()
        assert recording.town.network  # as whoever grows scenery does
        self._recording = recording

    def render(self, frame: int) -> RenderedFrame:
        """A grey wall 20 m away, and everything else behind it."""
        height, width = self._recording.camera.height, self._recording.camera.width
        count = len(self._recording.moment(frame).vehicles)
        return RenderedFrame(
            rgb=np.full((height, width, 3), 90, dtype=np.uint8),
            depth=np.full((height, width), 20.0, dtype=np.float32),
            slope=np.zeros((height, width, 2), dtype=np.float32),
            ids=np.zeros((height, width), dtype=np.int32),
            silhouettes=(Silhouette(0, 0, np.zeros((1, 1), dtype=np.bool_)),) * count,
            contrast=np.zeros(count),
        )


def recording(split: str) -> Recording:
    """One frame of an empty road."""
    camera = Camera.looking([0, 0, 6], yaw=0, pitch_down=0.3, size=SIZE)
    return replace(standing(camera, []), site=SITES[split], split=split)


def parameters() -> dict[str, Any]:
    """Those of a dataset of `SITES`, as its card holds them."""
    made = from_preset(
        "demo",
        seed=0,
        renderer="pybullet",
        driver="TinyRenderer",
        rules=Rules(),
        frames=1,
        sites=tuple(SITES.values()),
        size=f"{SIZE[0]}x{SIZE[1]}",
    )
    return dict(json.loads(json.dumps(made.parameters.to_dict())))


def begun(root: Path) -> Path:
    """The folder that `skope gen simulate` leaves: parameters and recordings."""
    takes = [[site, "00", split, 1] for split, site in SITES.items()]
    write_json(root / ".work" / "parameters.json", {"parameters": parameters(), "takes": takes})
    for split, site in SITES.items():
        recordings.save(root / "recordings" / f"{site}_00.npz", recording(split))
    return root


def complete(root: Path) -> Path:
    """A whole dataset: a frame with a vehicle in each of the two splits."""
    store = Store(begun(root))
    labelled(store)
    finish_rendering(store, "pybullet", partial(local_pool, 1), Console(quiet=True))
    return root


def labelled(store: Store) -> None:
    """Add the frames and their labels to what `begun` has written."""
    for number, (split, site) in enumerate(SITES.items(), start=1):
        name = f"{site}/00_000000"
        pixels = np.random.default_rng(number).integers(0, 255, (*SIZE[::-1], 3), dtype=np.uint8)
        files = {
            f"images/{name}.jpg": cv2.imencode(".jpg", pixels)[1].tobytes(),
            f"depth/{name}.png": depth_png(np.full(SIZE[::-1], 20.0, dtype=np.float32)),
        }
        image, depth = files
        vehicle = make_annotation(number, number, (40, 30, 60, 40))
        labels = Labels(
            name=name,
            image=coco.image_to_dict(replace(image_of(recording(split), 0, image), depth_file_name=depth)),
            rows=[json_bytes(coco.annotation_to_dict(vehicle))],
            kinds=[count_kind(vehicle.iscrowd, vehicle.vehicle_type)],
            sha256={path: checksum(data) for path, data in files.items()},
            tally=vars(RuleCounts()),
        )
        store.write_frame(FrameFiles(files, labels))


def respelt(path: Path, change: Callable[[Any], object]) -> None:
    """Change the header of a recording's file."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    header = json.loads(str(arrays.pop("header")))
    change(header)
    np.savez_compressed(path, header=np.array(json.dumps(header)), **arrays)
