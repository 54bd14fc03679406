"""A dataset folder while it is being made: what is done, what is missing, and the merge at the end.

`.work/` holds the parameters and a small file of labels per finished frame, written after the frame's image and depth:
whatever moment a run is killed at, the frames with such a file are whole. It is removed when the dataset is.
"""

import json
import shutil
from collections.abc import Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any, Final

from skope import names
from skope.dataset import CARD, Dataset, check_takes, read_card
from skope.errors import UserError
from skope.files import (
    json_bytes,
    locked,
    no_links_out,
    parse_json,
    read_bytes,
    read_json,
    replacing,
    unwritable,
    write_bytes,
    write_json,
)
from skope.gen.output.card import check_parameters
from skope.gen.output.card import write as write_card
from skope.gen.output.counts import Counts
from skope.gen.output.frames import FrameFiles
from skope.gen.output.writers import Labels, frames_of_split, numbered, unpack_shards, writer_of
from skope.gen.scene import recording as recordings
from skope.gen.scene.recording import Recording, Take

_GROWS: Final = ("frames", "sites", "recordings")
"""Parameters that a dataset can be extended by."""
_LATER: Final = ("renderer", "driver", "versions")
"""Parameters that may be open until rendering begins."""


class Store:
    """The dataset folder at `root`."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._work = root / ".work"
        self._plan_path = self._work / "parameters.json"

    @property
    def complete(self) -> bool:
        return (self.root / CARD).is_file() and not self._plan_path.is_file()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from making the same dataset."""
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            no_links_out(self.root)
            with locked(self.root / ".lock", f"{self.root}: another `skope gen` is writing to this folder"):
                yield
        except OSError as error:
            raise unwritable(self.root, error) from None

    # ------------------------------------------------------------------------------------------------------ beginnings

    def begin(self, parameters: Mapping[str, Any], takes: Iterable[Take]) -> None:
        """Start, go on, or extend what is complete by sites and frames; other parameters are refused by name."""
        wanted = json.loads(json.dumps({"parameters": parameters, "takes": [astuple(take) for take in takes]}))
        begun = self.begun()
        if begun is None:
            if any(path.name != ".lock" for path in self.root.iterdir()):
                raise UserError(f"{self.root}: holds other files and no dataset; choose an empty folder with --out")
            write_json(self._plan_path, wanted)
            return
        self._compare(begun, wanted)
        for leftover in self.root.rglob(".*.part*"):
            leftover.unlink(missing_ok=True)
        if self.complete:
            shutil.rmtree(self._work, ignore_errors=True)
            if begun["takes"] != wanted["takes"]:
                self.reopen()
        elif begun["takes"] != wanted["takes"]:
            # Shards that were written already hold other frames, and ids, than they will.
            unpack_shards(self.root)
        if not self.complete:
            write_json(self._plan_path, wanted)

    def begun(self) -> dict[str, Any] | None:
        """Parameters and takes ("takes": site, name, split, frames each) of what is here; None where nothing is.

        Raises UserError where that is damaged, or says neither.
        """
        path = self._plan_path if self._plan_path.is_file() else self.root / CARD
        if not path.is_file():
            return None
        try:
            value = read_json(path) if path == self._plan_path else read_card(self.root)
            if not isinstance(value, dict):
                raise UserError(f"{path}: expected an object with parameters and takes")
            check_parameters(path, value.get("parameters"))
            check_takes(path, value.get("takes"))
        except UserError as error:
            raise UserError(
                f"{error}; {self.root} cannot be gone on with: choose another folder, or remove what is there"
            ) from None
        return {name: value[name] for name in ("parameters", "takes")}

    def settle(self, values: Mapping[str, Any]) -> None:
        """Write down parameters that were open."""
        begun = self.begun()
        assert begun is not None
        write_json(self._plan_path, {**begun, "parameters": begun["parameters"] | values})

    def takes(self) -> list[Take]:
        begun = self.begun()
        return [Take(*row) for row in begun["takes"]] if begun else []

    def _compare(self, begun: dict[str, Any], wanted: dict[str, Any]) -> None:
        was, now = begun["parameters"], wanted["parameters"]
        if not was["renderer"]:  # simulated elsewhere, and to be rendered here
            was = was | {name: now[name] for name in _LATER}
        larger = {(site, name): frames for site, name, _, frames in wanted["takes"]}
        grows = all(larger.get((site, name), 0) >= frames for site, name, _, frames in begun["takes"])
        different = [
            name
            for name in sorted(was.keys() | now)
            if was.get(name) != now.get(name) and not (grows and name in _GROWS)
        ]
        if different:
            list_ = ", ".join(f"{name} = {_short(was.get(name))}, now {_short(now.get(name))}" for name in different)
            raise UserError(
                f"{self.root}: was begun with other parameters ({list_}); "
                "repeat those, choose another --out, or remove it"
            )

    def reopen(self, broken: Container[str] = (), lost: Container[str] = ()) -> None:
        """Take a complete dataset apart again, into the labels of its frames.

        Left out, and so made again, are frames whose images are `broken` and all of splits that are `lost`.
        """
        begun = self.begun()
        sound = Dataset(self.root, read_card(self.root))
        if sound.sharded:
            raise UserError(
                f"{self.root}: is complete and in shards; `skope gen convert` it to a folder to go on with it"
            )
        for split in (split for split in sound.splits if split not in lost):
            for frame in frames_of_split(sound, split):
                if frame.image["file_name"] in broken:
                    continue
                self._keep_labels(frame)
        # From here on the folder counts as begun.
        write_json(self._plan_path, begun)

    # ---------------------------------------------------------------------------------------------------- going along

    def recording_path(self, take: Take) -> Path:
        return self.root / "recordings" / f"{take.site}_{take.name}.npz"

    def _label_path(self, frame_name: str) -> Path:
        return self._work / "frames" / f"{frame_name}.jsonl"

    def recorded(self, take: Take) -> bool:
        """Whether the recording is there, sound and with all its frames."""
        path = self.recording_path(take)
        return path.is_file() and recordings.sound(path) and recordings.length(path) == take.frames

    def keep_recording(self, take: Take, data: bytes) -> None:
        """Write a recording; frames that are done stay so when it starts like the shorter one that they come from."""
        path = self.recording_path(take)
        if path.is_file() and not _starts_like(recordings.unpacked(data, path), path):
            self.drop(take.frame_name(frame) for frame in range(take.frames))
        write_bytes(path, data)

    def drop(self, frame_names: Iterable[str]) -> None:
        """Have frames done again."""
        for name in frame_names:
            self._label_path(name).unlink(missing_ok=True)

    def missing(self, take: Take) -> list[int]:
        """Frames of a recording that are not done."""
        return [frame for frame in range(take.frames) if not self._label_path(take.frame_name(frame)).is_file()]

    def keep(self, frame: FrameFiles) -> None:
        """Write a frame: its files, then its labels, which make it count."""
        for path, data in frame.files.items():
            with replacing(self.root / path) as temporary:
                temporary.write_bytes(data)
        self._keep_labels(frame.labels)

    def _keep_labels(self, labels: Labels) -> None:
        head = {"image": labels.image, "kinds": labels.kinds, "tally": labels.tally, "sha256": labels.sha256}
        head["bytes"] = sum(map(len, labels.rows))
        write_bytes(self._label_path(labels.name), b"\n".join([json_bytes(head), *labels.rows]))

    def _labels(self, name: str) -> Labels:
        """What `_keep_labels` wrote; a UserError where that is damaged."""
        path = self._label_path(name)
        first, *rows = read_bytes(path).split(b"\n")
        try:
            head = parse_json(first)
            whole = head["bytes"] == sum(map(len, rows))
            for key in head["image"].keys() & {"file_name", "depth_file_name"}:
                names.relative(f"{path}: {key}", head["image"][key])
        except UserError:
            raise
        except (ValueError, KeyError, TypeError):
            whole = False
        if not whole:
            raise UserError(f"{path}: is damaged; remove it, and its frame is made again")
        return Labels(name, head["image"], rows, [*map(tuple, head["kinds"])], head["sha256"], head["tally"])

    # ------------------------------------------------------------------------------------------------------------ end

    def merge(self, takes: Iterable[Take], form: str) -> Counts:
        """Write what holds the labels, in one of `skope.gen.output.writers.FORMATS`, and the manifest.

        Ids count through the whole dataset in the order of the takes.
        """
        counts, writer = Counts(), writer_of(form, self.root)
        for take in takes:
            writer.add_file(self.recording_path(take).relative_to(self.root))
            writer.add(take.split, self._numbered(take, counts), self.root)
        writer.finish()
        return counts

    def _numbered(self, take: Take, counts: Counts) -> Iterator[Labels]:
        for frame in range(take.frames):
            labels = self._labels(take.frame_name(frame))
            places = {"split": take.split, "site": take.site, "weather": labels.image["weather"]}
            counts.add(places, labels.kinds, labels.tally)
            counts.images += 1
            rows = [numbered(row, counts.vehicles + k, counts.images) for k, row in enumerate(labels.rows, start=1)]
            counts.vehicles += len(rows)
            yield replace(labels, image={**labels.image, "id": counts.images}, rows=rows)

    def finish(self, content: Mapping[str, Any]) -> None:
        """Write the card, and remove what was only needed on the way, which makes the dataset complete."""
        write_card(self.root, content)
        self._plan_path.unlink()
        shutil.rmtree(self._work, ignore_errors=True)


def _starts_like(recording: Recording, shorter: Path) -> bool:
    try:
        return recording.starts_like(recordings.load(shorter))
    except UserError:  # it is broken, or of another version
        return False


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
