"""A dataset folder while it is being made: what is done, what is missing, and the merge at the end.

`.work/` holds the parameters and one small JSON file per finished frame, written after the frame's image and depth:
whatever moment a run is killed at, the frames with such a file are whole. It is removed when the dataset is.
"""

import fcntl
import json
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skope import coco
from skope.dataset import CARD
from skope.depth import depth_png
from skope.errors import UserError
from skope.files import read_json, replacing, write_json, write_text
from skope.gen.annotate import Tally
from skope.gen.recording import Recording, RecordingPlan
from skope.gen.render import View
from skope.schema import Annotation, Image

JPEG_QUALITY = 95


class Store:
    """The dataset folder at `root`."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._work = root / ".work"

    @property
    def complete(self) -> bool:
        return (self.root / CARD).is_file()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from making the same dataset; the lock ends with the process."""
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            with (self.root / ".lock").open("w") as file:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise UserError(f"{self.root}: another `skope gen` is writing to this folder") from None
                try:
                    yield
                finally:
                    (self.root / ".lock").unlink(missing_ok=True)
        except OSError as error:
            raise UserError(f"{self.root}: cannot be written: {error.strerror or error}") from None

    def begin(self, parameters: dict[str, Any]) -> None:
        """Start or go on; a folder that was begun with other parameters is refused, naming them."""
        begun = self._begun()
        if begun is None:
            if any(path.name != ".lock" for path in self.root.iterdir()):
                raise UserError(f"{self.root}: holds other files and no dataset; choose an empty folder with --out")
            write_json(self._work / "parameters.json", parameters)
            return
        wanted = json.loads(json.dumps(parameters))
        different = [name for name in sorted(begun.keys() | wanted) if begun.get(name) != wanted.get(name)]
        if different:
            was = ", ".join(f"{name} = {_short(begun.get(name))}, now {_short(wanted.get(name))}" for name in different)
            raise UserError(
                f"{self.root}: was begun with other parameters ({was}); "
                "repeat those, choose another --out, or remove it"
            )
        for leftover in self.root.rglob(".*.part*"):
            leftover.unlink(missing_ok=True)

    def _begun(self) -> dict[str, Any] | None:
        for path, key in ((self.root / CARD, "parameters"), (self._work / "parameters.json", None)):
            if path.is_file():
                value: dict[str, Any] = read_json(path)
                return value.get(key, {}) if key else value
        return None

    def recording_path(self, plan: RecordingPlan) -> Path:
        return self.root / "recordings" / f"{plan.site.name}_{plan.name}.npz"

    def _label_path(self, plan: RecordingPlan, frame: int) -> Path:
        return self._work / "frames" / plan.site.name / f"{plan.name}_{frame:06d}.json"

    def missing(self, plan: RecordingPlan) -> list[int]:
        """Frames of a recording that are not done."""
        return [frame for frame in range(plan.frames) if not self._label_path(plan, frame).is_file()]

    def add(
        self,
        plan: RecordingPlan,
        recording: Recording,
        frame: int,
        view: View,
        annotations: list[Annotation],
        tally: Tally,
    ) -> None:
        """Write a frame: image, depth, then its labels, which make it count."""
        name = recording.image_name(frame)
        image = Image(
            id=0,
            file_name=f"images/{name}.jpg",
            width=recording.camera.width,
            height=recording.camera.height,
            depth_file_name=f"depth/{name}.png",
            town=recording.town,
            site=recording.site,
            recording=recording.name,
            frame_index=frame,
            time_s=float(recording.times_s[frame]),
            split=recording.split,
            weather=recording.weather,
            sun_elevation_deg=recording.conditions.sun_elevation_deg,
            camera=recording.camera,
        )
        self._write(image.file_name, _jpeg(view.rgb))
        self._write(f"depth/{name}.png", depth_png(view.depth))
        labels = {
            "image": coco.image_to_dict(image),
            "annotations": [coco.annotation_to_dict(annotation) for annotation in annotations],
            "tally": vars(tally),
        }
        write_text(self._label_path(plan, frame), json.dumps(labels, allow_nan=False))

    def _write(self, name: str, data: bytes) -> None:
        with replacing(self.root / name) as temporary:
            temporary.write_bytes(data)

    def merge(self, plans: list[RecordingPlan]) -> "Counts":
        """Write the annotation files; ids count through the whole dataset in the order of the plans."""
        counts = Counts()
        splits: dict[str, tuple[list[Any], list[Any]]] = {}
        for plan in plans:
            images, annotations = splits.setdefault(plan.site.split, ([], []))
            for frame in range(plan.frames):
                labels = read_json(self._label_path(plan, frame))
                counts.images += 1
                images.append({**labels["image"], "id": counts.images})
                for annotation in labels["annotations"]:
                    counts.vehicles += 1
                    annotations.append({**annotation, "id": counts.vehicles, "image_id": counts.images})
                counts.add(plan, labels)
        for split, (images, annotations) in splits.items():
            coco.write_rows(self.root / "annotations" / f"{split}.json", {"split": split}, images, annotations)
        return counts

    def finish(self, card: dict[str, Any], readme: str) -> None:
        """Write the card, which makes the dataset complete, and remove what was only needed on the way."""
        write_text(self.root / "README.md", readme)
        write_json(self.root / CARD, card)
        shutil.rmtree(self._work, ignore_errors=True)


class Counts:
    """Counts for the card: images, ground truth and ignored vehicles by split, site, type and reason."""

    def __init__(self) -> None:
        self.images = self.vehicles = 0
        self.by: dict[str, dict[str, Counter[str]]] = {"split": {}, "site": {}, "vehicle_type": {}}
        self.tally: Counter[str] = Counter()
        self.ignored: Counter[str] = Counter()

    def add(self, plan: RecordingPlan, labels: dict[str, Any]) -> None:
        places = [("split", plan.site.split), ("site", plan.site.name)]
        for group, name in places:
            self.by[group].setdefault(name, Counter())["images"] += 1
        for annotation in labels["annotations"]:
            kind = "ignored" if annotation["iscrowd"] else "ground_truth"
            for group, name in (*places, ("vehicle_type", annotation["vehicle_type"])):
                self.by[group].setdefault(name, Counter())[kind] += 1
        tally = dict(labels["tally"])
        self.ignored.update(tally.pop("ignored"))
        self.tally.update(tally)

    def to_dict(self) -> dict[str, Any]:
        return {
            "images": self.images,
            "ground_truth": sum(counter["ground_truth"] for counter in self.by["split"].values()),
            "ignored": dict(sorted(self.ignored.items())),
            "by_split": self._table("split", "images", "ground_truth", "ignored"),
            "by_site": self._table("site", "images", "ground_truth", "ignored"),
            "by_vehicle_type": self._table("vehicle_type", "ground_truth", "ignored"),
        }

    def _table(self, group: str, *columns: str) -> dict[str, dict[str, int]]:
        return {name: {column: counter[column] for column in columns} for name, counter in self.by[group].items()}


def _jpeg(rgb: NDArray[np.uint8]) -> bytes:
    ok, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert ok
    return data.tobytes()


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
