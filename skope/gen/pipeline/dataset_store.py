"""Dataset folder under construction: finished frames, missing frames, and the final merge.

`.work/` contains the parameters and a small file of labels per finished frame. The label file is written after the
frame's image and depth, so every frame with a label file is complete, whenever a run is killed. `.work/` is removed
when the dataset is complete.
"""

import json
import shutil
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from skope.dataset.folder import CARD_FILE, Dataset, read_card
from skope.errors import UserError
from skope.files import safe_names
from skope.files.atomic import file_in_place_of, locked, no_links_out, read_bytes, write_bytes, writing
from skope.files.json_files import json_bytes, parse_json, read_json, write_json
from skope.gen.output.dataset_card import write_card as write_card
from skope.gen.output.parameters import DatasetPlan, Parameters
from skope.gen.output.writers import Counts, FrameFiles, Labels, frames_of_split, unpack_shards, writer_of
from skope.gen.scene import recording as recordings
from skope.gen.scene.recording import Recording, RecordingInfo

GROWING_PARAMETERS: Final = ("frames", "sites", "recordings")
"""Parameters that may change when a dataset is extended."""


class Store:
    """A dataset folder under construction at `root`: reads and writes its plan, recordings, frames and labels."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._work = root / ".work"
        self._plan_path = self._work / "parameters.json"

    @property
    def complete(self) -> bool:
        """Whether the folder contains a complete dataset."""
        return (self.root / CARD_FILE).is_file() and not self._plan_path.is_file()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the folder, so that no other process makes the same dataset."""
        with writing(self.root):
            self.root.mkdir(parents=True, exist_ok=True)
            no_links_out(self.root)
            with locked(self.root / ".lock", f"{self.root}: another `skope gen` is writing to this folder"):
                yield

    # ------------------------------------------------------------------------------------------------------ beginnings

    def begin(self, wanted: DatasetPlan) -> None:
        """Start a dataset, resume it, or extend a complete one with sites and frames.

        Args:
            wanted: Plan of the requested dataset.

        Raises:
            UserError: The folder contains other files, or a dataset with other parameters (the message names them).
        """
        begun = self._begun(wanted)
        if begun is None:
            self._write_plan(wanted)
            return
        for leftover in self.root.rglob(".*.part*"):
            leftover.unlink(missing_ok=True)
        if self.complete:
            shutil.rmtree(self._work, ignore_errors=True)
            if begun.recordings != wanted.recordings:
                self.reopen()
        elif begun.recordings != wanted.recordings:
            # Existing shards have the frames and ids of the previous plan.
            unpack_shards(self.root)
        if not self.complete:
            self._write_plan(wanted)

    def _begun(self, wanted: DatasetPlan) -> DatasetPlan | None:
        """Return the plan of the folder's dataset, or None. Raises UserError if `wanted` cannot be made there."""
        begun = self.read_plan()
        if begun is not None:
            self._check_same_parameters(begun, wanted)
        elif self.root.is_dir() and any(path.name != ".lock" for path in self.root.iterdir()):
            raise UserError(f"{self.root}: contains other files and no dataset; choose an empty folder with --out")
        return begun

    def frames_left(self, wanted: DatasetPlan) -> dict[RecordingInfo, int]:
        """Count the missing frames of each recording without writing anything.

        Raises UserError if the folder contains other files, or a dataset with other parameters.
        """
        file = file_in_place_of(self.root)
        if file:
            raise UserError(f"{self.root}: cannot be written: {file} is a file")
        begun = self._begun(wanted)
        if begun is None or not self.complete:
            return {info: len(self.missing(info)) for info in wanted.recordings}
        existing = {(info.site, info.name): info.frames for info in begun.recordings}
        return {info: info.frames - existing.get((info.site, info.name), 0) for info in wanted.recordings}

    def read_plan(self) -> DatasetPlan | None:
        """Read the plan of the folder's dataset from `.work/` or, if it is complete, from its card.

        Returns:
            The plan; None for a folder without a dataset.

        Raises:
            UserError: The file with the plan is damaged.
        """
        path = self._plan_path if self._plan_path.is_file() else self.root / CARD_FILE
        if not path.is_file():
            return None
        try:
            return DatasetPlan.from_dict(read_json(path) if path == self._plan_path else read_card(self.root), path)
        except UserError as error:
            raise UserError(
                f"{error}; {self.root} cannot be resumed: choose another folder, or move its content away"
            ) from None

    @property
    def plan(self) -> DatasetPlan:
        """Plan of the dataset in the folder."""
        plan = self.read_plan()
        assert plan is not None
        return plan

    def _write_plan(self, plan: DatasetPlan) -> None:
        write_json(self._plan_path, plan.to_dict())

    def fix_renderer(self, parameters: Parameters) -> None:
        """Save the renderer, driver and versions of a dataset that was simulated without them."""
        self._write_plan(replace(self.plan, parameters=parameters))

    def _check_same_parameters(self, begun: DatasetPlan, wanted: DatasetPlan) -> None:
        was, now = begun.parameters, wanted.parameters
        if not was.renderer:  # simulated on another machine, to be rendered here
            was = replace(was, renderer=now.renderer, driver=now.driver, versions=now.versions)
        larger = {(info.site, info.name): info.frames for info in wanted.recordings}
        grows = all(larger.get((info.site, info.name), 0) >= info.frames for info in begun.recordings)
        before, asked = was.to_dict(), now.to_dict()
        names = sorted(before.keys() | asked.keys())
        different = [
            name for name in names if before.get(name) != asked.get(name) and not (grows and name in GROWING_PARAMETERS)
        ]
        if different:
            list_ = ", ".join(
                f"{name} = {_short_json(before.get(name))}, now {_short_json(asked.get(name))}" for name in different
            )
            raise UserError(
                f"{self.root}: was started with other parameters ({list_}); "
                "use the same parameters, choose another --out, or move the folder away"
            )

    def reopen(self, broken: Container[str] = (), lost: Container[str] = ()) -> None:
        """Turn a complete dataset back into one under construction, with one label file per frame.

        Args:
            broken: File names of images to render again; their labels are removed.
            lost: Splits to render again; the labels of all their frames are removed.

        Raises:
            UserError: The dataset is stored in shards.
        """
        plan = self.plan
        sound = Dataset(self.root, read_card(self.root))
        if sound.sharded:
            raise UserError(
                f"{self.root}: is complete and in shards; to extend it, convert it to a folder with `skope gen convert`"
            )
        for split in (split for split in sound.splits if split not in lost):
            for frame in frames_of_split(sound, split):
                if frame.labels.image["file_name"] not in broken:
                    self._write_labels(frame.labels)
        # From this line on, the folder counts as under construction.
        self._write_plan(plan)

    # -------------------------------------------------------------------------------------------------------- progress

    def recording_path(self, info: RecordingInfo) -> Path:
        return self.root / "recordings" / f"{info.site}_{info.name}.npz"

    def _label_path(self, frame_name: str) -> Path:
        return self._work / "frames" / f"{frame_name}.jsonl"

    def recorded(self, info: RecordingInfo) -> bool:
        """Return whether the recording exists, is intact and has all its frames."""
        path = self.recording_path(info)
        return path.is_file() and recordings.sound(path) and recordings.length(path) == info.frames

    def write_recording(self, info: RecordingInfo, data: bytes) -> None:
        """Write a recording (`data` is its .npz file); it may replace a shorter one of the same name.

        Frames that were rendered from the shorter one are kept if the new one starts with it, else they are rendered
        again.
        """
        path = self.recording_path(info)
        if path.is_file() and not _starts_like(recordings.unpacked_recording(data, path), path):
            self.discard_frames(info.frame_name(frame) for frame in range(info.frames))
        write_bytes(path, data)

    def discard_frames(self, frame_names: Iterable[str]) -> None:
        """Remove the labels of frames, so that they are rendered again."""
        for name in frame_names:
            self._label_path(name).unlink(missing_ok=True)

    def missing(self, info: RecordingInfo) -> list[int]:
        """Return the numbers of a recording's frames that are not rendered yet."""
        return [frame for frame in range(info.frames) if not self._label_path(info.frame_name(frame)).is_file()]

    def write_frame(self, frame: FrameFiles) -> None:
        """Write a frame: first its files, then its labels, which mark it as complete."""
        for path, data in frame.files.items():
            assert isinstance(data, bytes)
            write_bytes(self.root / path, data)
        self._write_labels(frame.labels)

    def _write_labels(self, labels: Labels) -> None:
        head = {"image": labels.image, "kinds": labels.kinds, "tally": labels.tally, "sha256": labels.sha256}
        head["bytes"] = sum(map(len, labels.rows))
        write_bytes(self._label_path(labels.name), b"\n".join([json_bytes(head), *labels.rows]))

    def _read_labels(self, name: str) -> Labels:
        """Read the labels of a frame by name. Raises UserError if the file is damaged."""
        path = self._label_path(name)
        first, *rows = read_bytes(path).split(b"\n")
        try:
            head = parse_json(first)
            whole = head["bytes"] == sum(map(len, rows))
            kinds = [(status, type_, category) for status, type_, category in head["kinds"]]
            for key in head["image"].keys() & {"file_name", "depth_file_name"}:
                safe_names.relative(f"{path}: {key}", head["image"][key])
        except UserError:
            raise
        except (ValueError, KeyError, TypeError):
            whole = False
        if not whole:
            raise UserError(f"{path}: is damaged; move it away, and its frame is rendered again")
        return Labels(name, head["image"], rows, kinds, head["sha256"], head["tally"])

    # ------------------------------------------------------------------------------------------------------------ end

    def merge(self) -> Counts:
        """Write the annotation files or shards, and the manifest; return the counts of images and vehicles."""
        plan = self.plan
        writer = writer_of(plan.parameters.format, self.root, categories=plan.parameters.categories)
        for info in plan.recordings:
            writer.add_file(self.recording_path(info).relative_to(self.root))
            writer.add(info.split, self._frames(info))
        return writer.finish()

    def _frames(self, info: RecordingInfo) -> Iterator[FrameFiles]:
        for frame in range(info.frames):
            labels = self._read_labels(info.frame_name(frame))
            yield FrameFiles({name: self.root / name for name in labels.sha256}, labels)

    def finish(self, content: Mapping[str, Any]) -> None:
        """Write the card and remove `.work/`, which makes the dataset complete."""
        write_card(self.root, content)
        self._plan_path.unlink()
        shutil.rmtree(self._work, ignore_errors=True)


def _starts_like(recording: Recording, shorter: Path) -> bool:
    try:
        return recording.starts_like(recordings.load(shorter))
    except UserError:  # damaged, or of another version
        return False


def _short_json(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
