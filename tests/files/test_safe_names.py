"""What strangers' files call their things leads to no file outside the folders that a command was given.

First the rules and each way out that was open once; then every field that becomes part of a path is spoilt before every
command that reads it, and the file system is watched: what was opened, made, moved and removed, and what lies there.
"""

import csv
import json
import os
import re
import shutil
import sys
import zipfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest
import typer

from skope import cli
from skope.dataset import coco, shards
from skope.dataset.folder import open_dataset
from skope.errors import UserError
from skope.files import safe_names
from skope.gen.formats.convert import WRITER_NAMES
from skope.gen.output.writers import checksum, unpack_shards
from skope.gen.pipeline.dataset_store import Store
from skope.gen.scene import recording as recordings
from skope.gen.towns import town
from skope.gen.towns.town import OwnRoad, Town
from skope.schema import Result
from skope.train import splits
from tests import hostile
from tests.gen.formats.test_skope3d import video, write_zip
from tests.samples import make_annotation

Spoil = Callable[[Path, Any], object]
"""Writes a value into a field of a folder."""

QUIET = ("--quiet",)
RENDER = ("--workers", "1", "--quiet")
FRAME = "t01_mill_corner/00_000000"
RECORDING = "recordings/t01_mill_corner_00.npz"


# ------------------------------------------------------------------------------------------------------------ watching

_EVENTS = {
    **dict.fromkeys(("open", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.listdir", "os.scandir"), 1),
    **dict.fromkeys(("os.rename", "os.link", "os.symlink", "shutil.copyfile", "shutil.move", "shutil.copytree"), 2),
    "shutil.rmtree": 1,
}
"""Events of Python's that say which files are touched, with how many paths each has."""
_seen: set[Path] | None = None
"""Paths that were touched since watching began; None while nobody watches."""


def _note(event: str, arguments: tuple[Any, ...]) -> None:
    if _seen is not None and event in _EVENTS:
        paths = (Path(os.fsdecode(a)) for a in arguments[: _EVENTS[event]] if isinstance(a, str | bytes | os.PathLike))
        # What has no folder is relative to one that was opened before.
        _seen.update(Path(os.path.normpath(path.absolute())) for path in paths if path.parent != Path())


sys.addaudithook(_note)


@contextmanager
def watching() -> Iterator[set[Path]]:
    """The absolute paths that are touched meanwhile."""
    global _seen
    _seen = set()
    try:
        yield _seen
    finally:
        _seen = None


# --------------------------------------------------------------------------------------------------------------- rules


@pytest.mark.parametrize("value", ["t01_mill_corner", "00", "Ulmer Straße 3", "a.b-c", "x" * 100, "日本"])
def test_names_that_are_names(value: str) -> None:
    assert safe_names.name("site", value) == value
    assert safe_names.relative("file_name", value) == value


@pytest.mark.parametrize(
    "value",
    [
        *("", ".", "..", "/", "a/b", "../a", "a\\b", "a\x00b", "a\nb", "a\u2028b", "\x7f", "C:", "c:a", ".hidden"),
        *("x" * 101, "ß" * 51, "\ud800", None, 7, True, ["a"], {"a": 1}),
    ],
)
def test_names_that_are_none(value: Any) -> None:
    with pytest.raises(UserError, match=r"^site: expected a name .*, got .{1,60}$"):
        safe_names.name("site", value)


@pytest.mark.parametrize(
    "value", ["a.jpg", "images/a b/00_000000.jpg", "./a.jpg", "a//b.jpg", ".a/.b", "a/..b", "\udcff"]
)
def test_paths_that_stay(value: str) -> None:
    assert safe_names.relative("file_name", value) == value


@pytest.mark.parametrize(
    "value",
    [
        *("", ".", "./.", "..", "../a", "a/..", "a/../b", "/a", "//a", "a\\..\\b", "\\\\host\\a", "C:/a", "a/C:b"),
        *("a\x00", "a/\n", "x" * 256, "x/" * 1500, "a/\ud800", None, 7, ["a"]),
    ],
)
def test_paths_that_leave(value: Any) -> None:
    with pytest.raises(UserError, match=r"^file_name: expected a path inside the dataset folder, got .{1,60}$"):
        safe_names.relative("file_name", value)


# ----------------------------------------------------------------------------------------- ways out that were open once


def edited(path: Path, change: Callable[[Any], object]) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def labels_edited(path: Path, change: Callable[[Any], object]) -> None:
    """The same for the first line of a frame's labels."""
    head, *rows = path.read_bytes().split(b"\n")
    row = json.loads(head)
    change(row)
    path.write_bytes(b"\n".join([json.dumps(row).encode(), *rows]))


def signed(root: Path, name: str) -> None:
    """Have the manifest say the checksum that a file has now."""
    data = checksum((root / name).read_bytes())
    edited(root / "manifest.json", lambda manifest: manifest["sha256"].update({name: data}))


def below(root: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() if path.is_file() else b"" for path in root.rglob("*")}


@pytest.fixture
def flat(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skope.gen.pipeline.workers.make_renderer", hostile.FlatRenderer)


@pytest.fixture
def begun(skope: Any, flat: None) -> Path:
    return hostile.begun(Path("in/deep/ours"))


@pytest.fixture
def ours(skope: Any, flat: None) -> Path:
    return hostile.complete(Path("in/deep/ours"))


@pytest.fixture
def scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where temporary files go."""
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    # Networks lie there, which are known by their paths.
    for known in (town._network_file, town._scratch):
        known.cache_clear()
    yield tmp_path / "scratch"
    for known in (town._network_file, town._scratch):
        known.cache_clear()


def test_repair_removes_nothing_that_a_manifest_names_elsewhere(skope: Any, ours: Path) -> None:
    victim = Path("in/deep/victim.txt")
    victim.write_text("dear")
    edited(ours / "manifest.json", lambda m: m["sha256"].update({"recordings/../../victim.txt": "0"}))
    skope("gen", "check", ours, "--repair", *RENDER)
    assert victim.read_text() == "dear"
    # What is sound was made again, and the manifest with it.
    assert skope("gen", "check", ours, *QUIET) == (0, f"{ours}: no findings\n", "")


def test_repair_writes_nothing_where_a_site_leads_elsewhere(skope: Any, ours: Path) -> None:
    edited(ours / "annotations/train.json", lambda a: a["images"][0].update(site="../../../escaped"))
    signed(ours, "annotations/train.json")
    skope("gen", "check", ours, "--repair", *RENDER)
    assert not list(Path().rglob("escaped"))
    assert skope("gen", "check", ours, *QUIET)[0] == 0


@pytest.mark.parametrize("form", ["mot", "shards"])
def test_exports_write_nothing_where_a_site_leads_elsewhere(skope: Any, ours: Path, form: str) -> None:
    edited(ours / "annotations/train.json", lambda a: a["images"][0].update(site="../../escaped"))
    before = below(Path())
    code, out, err = skope("gen", "convert", ours, "out/deep/there", "--to", form, *QUIET)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "annotations/train.json: images[0]: site: expected a name" in err
    assert below(Path()).keys() - before.keys() <= {Path("out"), Path("out/deep")}


def test_a_place_whose_title_leads_elsewhere_is_not_written(skope: Any, begun: Path, scratch: Path) -> None:
    made = hostile.recording("train")
    corner = OwnRoad(title="corner", network=b"<net/>", style="", camera=made.camera)
    recordings.save(begun / RECORDING, replace(made, town=Town.of(corner)))

    evil = replace(corner)
    object.__setattr__(evil, "title", "../escaped")
    hostile.respelt(begun / RECORDING, lambda h: h.update(town=evil.name, place={**h["place"], "title": evil.title}))
    code, _, err = skope("gen", "render", begun, "--renderer", "pybullet", *RENDER)
    assert not list(scratch.parent.rglob("escaped*"))
    assert (code, f"{begun / RECORDING}: title: expected a name" in err) == (2, True)


def test_the_header_of_a_recording_leads_no_frame_elsewhere(skope: Any, begun: Path) -> None:
    hostile.respelt(begun / RECORDING, lambda header: header.update(site="../../../escaped"))
    code, _, err = skope("gen", "render", begun, "--renderer", "pybullet", *RENDER)
    assert not list(Path().rglob("escaped"))
    assert (code, f"{begun / RECORDING}: site: expected a name" in err) == (2, True)


def test_takes_write_no_split_elsewhere(skope: Any, begun: Path) -> None:
    edited(begun / ".work/parameters.json", lambda p: p["takes"][0].__setitem__(2, "../../escaped"))
    code, _, err = skope("gen", "render", begun, "--renderer", "pybullet", *RENDER)
    assert not list(Path().rglob("escaped.json"))
    assert (code, "parameters.json: takes[0]: split: expected a name" in err) == (2, True)


def test_labels_remove_no_picture_elsewhere(skope: Any, begun: Path) -> None:
    """Shards take the place of the loose files that labels name."""
    victim = Path("in/deep/victim.jpg")
    victim.write_text("dear")
    edited(begun / ".work/parameters.json", lambda p: p["parameters"].update(format="shards"))
    hostile.labelled(Store(begun))

    def lead_out(head: Any) -> None:
        head["image"]["file_name"] = "../victim.jpg"
        head["sha256"]["../victim.jpg"] = ""

    labels_edited(begun / f".work/frames/{FRAME}.jsonl", lead_out)
    code, _, err = skope("gen", "render", begun, "--renderer", "pybullet", *RENDER)
    assert victim.read_text() == "dear"
    assert (code, f"{FRAME}.jsonl: file_name: expected a path" in err) == (2, True)


def test_shards_are_unpacked_to_nowhere_else(skope: Any, begun: Path) -> None:
    shards.write_shard(begun / "shards/train-000000.tar", [("../../escaped.jpg", b"evil")])
    with pytest.raises(UserError, match=r"train-000000\.json: not an index of a shard"):
        unpack_shards(begun)
    assert not list(Path().rglob("escaped.jpg"))


def test_folders_that_are_links_are_neither_filled_nor_emptied(skope: Any, ours: Path) -> None:
    Path("photos").mkdir()
    Path("photos/mine.jpg").write_text("dear")
    shutil.rmtree(ours / "images")
    (ours / "images").symlink_to(Path("photos").resolve())
    code, _, err = skope("gen", "check", ours, "--repair", *RENDER)
    assert [path.name for path in Path("photos").rglob("*")] == ["mine.jpg"]
    assert (code, f"{ours}/images: is a link that leads out of {ours}" in err) == (2, True)


def test_a_lock_that_is_a_link_empties_nothing(skope: Any, ours: Path) -> None:
    Path("mine.txt").write_text("dear")
    (ours / ".lock").symlink_to(Path("mine.txt").resolve())
    (ours / f"images/{FRAME}.jpg").unlink()
    assert skope("gen", "check", ours, "--repair", *RENDER)[0] == 2
    assert Path("mine.txt").read_text() == "dear"


def test_a_temporary_file_that_is_a_link_fills_nothing(skope: Any, begun: Path) -> None:
    Path("mine.txt").write_text("dear")
    path = begun / f"images/{FRAME}.jpg"
    path.parent.mkdir(parents=True)
    path.with_name(f".{path.stem}.{os.getpid()}.part.jpg").symlink_to(Path("mine.txt").resolve())
    assert skope("gen", "render", begun, "--renderer", "pybullet", *RENDER)[0] == 0
    assert (Path("mine.txt").read_text(), path.is_symlink()) == ("dear", False)


def test_annotation_files_are_no_folders_above(skope: Any, ours: Path) -> None:
    """A file that is called like the folder above but for its suffix is hidden, and no split."""
    (ours / "annotations/train.json").rename(ours / "annotations/...json")
    assert open_dataset(ours).splits == ("val",)
    assert skope("gen", "convert", ours, "there", "--to", "mot", *QUIET)[0] == 0
    assert {path.name for path in Path("there").iterdir()} == {"val", "LICENCE.txt"}


@pytest.mark.parametrize("form", ["coco", "cvat"])
def test_the_mark_of_depth_in_a_shard_leads_nowhere(skope: Any, ours: Path, form: str) -> None:
    """What is taken out of a name must leave no way up behind."""
    name = "..depth./..depth./..depth./..depth./escaped.jpg"
    shards.write_shard(ours / "s.tar", [(name, b"evil")])
    edited(ours / "annotations/train.json", lambda a: a["images"][0].update(file_name=f"s.tar/{name}"))
    skope("gen", "convert", ours, "out/deep/there", "--to", form, *QUIET)
    assert all(Path("out/deep/there") in path.parents for path in Path().rglob("escaped.jpg"))


def test_images_of_a_folder_are_not_looked_for_above_it(skope: Any, ours: Path) -> None:
    (ours / f"images/{FRAME}.jpg").rename(ours.parent / "elsewhere.jpg")
    edited(ours / "annotations/train.json", lambda a: a["images"][0].update(file_name="elsewhere.jpg"))
    code, _, err = skope("gen", "convert", ours, "there", "--from", "coco", *QUIET)
    assert (code, "images[0]: file_name: no elsewhere.jpg in" in err) == (2, True)


@pytest.mark.parametrize("suffix", ["gltf", "obj"])
def test_models_are_read_from_their_own_folder(skope: Any, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    Path("model").mkdir()
    Path("secret.bin").write_bytes(b"\0" * 36)
    gltf = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 36, "uri": "../secret.bin"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    text = {"gltf": json.dumps(gltf), "obj": "mtllib ../secret.bin\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"}[suffix]
    path = Path(f"model/car.{suffix}")
    path.write_text(text)
    with watching() as seen:
        assert skope("gen", "vehicles", "add", path.resolve(), *QUIET)[0] == 2
    assert path.resolve() in seen
    assert Path("secret.bin").resolve() not in seen


# ------------------------------------------------------------------------------------------- every field, every command

OUT_OF_ORDER = ("../x", "..\\x", "", ".", "a/../../x", "a\x00b", "x" * 300, "..", "../../x", 7, None)
TEXT = (7, None, "a\x00b")
"""Those that are good names where all is text, and names end at a zero."""
OTHERS = ("folder", "member", "mtllib")
"""Fields that errors need not name."""
_OWN = ("there", ".there.", ".between.")
FIELDS = ("file_name", "depth_file_name", "site", "recording", "town", "split")


@cache
def command() -> Any:
    """The command line, which takes longer to build than to use."""
    return typer.main.get_command(cli.app)


class Yard:
    """Folders in folders: what is given and what is written may be touched, and nothing around them."""

    def __init__(self, root: Path, skope: Any) -> None:
        self.root, self._skope = root, skope
        self.given, self.out = root / "outer/in/ours", root / "outer/out/there"
        self.values = (*OUT_OF_ORDER, str(root / "outer/x"))
        folders = (root, root / "outer", self.given.parent, self.out.parent)
        for folder in folders:
            folder.mkdir(parents=True, exist_ok=True)
            # What the values lead to is there: it could be read, and removed.
            for name in ("x", "x.npz", "x_00.npz", "x.json", "x.jpg", "x.png", "x.txt", "x-000000.tar"):
                (folder / name).write_text("dear")
        self._folders = {*folders, root.parent}
        # As text: thousands of commands are watched, each of which opens dozens of files.
        self._touched = (f"{self.given}{os.sep}", *(f"{self.out.parent}{os.sep}{name}" for name in _OWN))
        self._before = self._around()

    def _inside(self, path: Path) -> bool:
        """Whether a path may be touched: results are written beside their place first."""
        return path == self.given or str(path).startswith(self._touched)

    def _around(self) -> dict[Path, tuple[int, bytes]]:
        found = {}
        for folder, below, names in os.walk(self.root):
            below[:] = [name for name in below if not self._inside(Path(folder, name))]
            files = (Path(folder, name) for name in names)
            found |= {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files if not self._inside(path)}
        return found

    @contextmanager
    def watched(self) -> Iterator[None]:
        """What is around must be left alone meanwhile: neither read nor changed."""
        with watching() as seen:
            yield
        root = str(self.root)
        assert {path for path in seen if str(path).startswith(root) and not self._inside(path)} <= self._folders
        assert self._around() == self._before

    def run(self, *arguments: object) -> tuple[int, str]:
        """Exit code of a command and what it says; IN and OUT stand for the two folders."""
        shutil.rmtree(self.out, ignore_errors=True)
        folders = {"IN": str(self.given), "OUT": str(self.out)}
        parts = [re.sub(r"^(IN|OUT)\b", lambda match: folders[match[1]], str(argument)) for argument in arguments]
        with self.watched():
            code, out, err = self._skope(*parts)
        assert err.count("\n") == (code == 2), (parts, err)
        return code, out + err


@pytest.fixture
def yard(tmp_path: Path, skope: Any, flat: None, monkeypatch: pytest.MonkeyPatch) -> Yard:
    monkeypatch.setattr(cli, "app", command())
    return Yard(tmp_path / "yard", skope)


def spoilt(yard: Yard, make: Callable[[Path], object], spoils: dict[str, Spoil]) -> Iterator[tuple[str, Any]]:
    """Every field with every value in turn, in what `make` writes to the given folder."""
    make(yard.given)
    whole = below(yard.given)
    for field, spoil in spoils.items():
        for value in yard.values:
            spoil(yard.given, value)
            yield field, value
            for path in sorted(below(yard.given).keys() - whole.keys()):
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
            for path, data in whole.items():
                if path.suffix and (not path.is_file() or path.read_bytes() != data):
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.write_bytes(data)
            shards._index.cache_clear()


def refused(
    yard: Yard,
    make: Callable[[Path], object],
    spoils: dict[str, Spoil],
    *arguments: object,
    plain: Collection[object] = (),
) -> None:
    """Each value in each field ends in one line, but for `plain` ones and those of fields that there need not be."""
    for field, value in spoilt(yard, make, spoils):
        code, said = yard.run(*arguments, *QUIET)
        free = value in plain or (value is None and field in FIELDS)
        named = field in OTHERS or field.split()[-1] in said
        assert (code == 2 and named) or (code in (0, 2) and free), (field, value, said)


def in_json(name: str, *keys: str | int) -> Spoil:
    """Writes to what `keys` lead to in a JSON file."""

    def spoil(root: Path, value: Any) -> None:
        def change(document: Any) -> None:
            for key in keys[:-1]:
                document = document[key]
            document[keys[-1]] = value

        edited(root / name, change)

    return spoil


def images(name: str) -> dict[str, Spoil]:
    """Fields of the first image of an annotation file."""
    return {field: in_json(name, "images", 0, field) for field in FIELDS}


def takes(name: str) -> dict[str, Spoil]:
    """Fields of the first take that a card or a begun folder names."""
    return {f"take's {field}": in_json(name, "takes", 0, k) for k, field in enumerate(("site", "name", "split"))}


def in_manifest(root: Path, value: Any) -> None:
    edited(root / "manifest.json", lambda manifest: manifest["sha256"].update({value: "0"}))


def in_header(field: str) -> Spoil:
    """Writes to the header of a recording of somebody's own road; a vehicle is there only then."""

    def spoil(root: Path, value: Any) -> None:
        def change(header: Any) -> None:
            if field == "model":
                header["vehicles"] = [{"track_id": 1, "model": value, "shape": {}, "color": "blue"}]
            elif field == "title":
                header["place"]["title"] = value
            else:
                header[field] = value

        made = hostile.recording("train")
        corner = OwnRoad(title="corner", network=b"", style="", camera=made.camera)
        recordings.save(root / RECORDING, replace(made, town=Town.of(corner)))
        hostile.respelt(root / RECORDING, change)

    return spoil


def in_labels(field: str) -> Spoil:
    def spoil(root: Path, value: Any) -> None:
        def change(head: Any) -> None:
            head["image"][field] = value
            head["sha256"][str(value)] = ""

        labels_edited(root / f".work/frames/{FRAME}.jsonl", change)

    return spoil


HEADER = {f"header's {field}": in_header(field) for field in ("site", "name", "split", "town", "model", "title")}


def with_results(root: Path) -> None:
    """A dataset and results for the image of its split val."""
    hostile.complete(root)
    vehicle = make_annotation(1, 2, (40, 30, 60, 40))
    result = Result(image_id=2, bbox=vehicle.bbox, keypoints=vehicle.keypoints.clip(max=(160, 120, 1)), score=0.9)
    coco.write_results(root / "predictions.json", [result])
    shutil.copy(root / "annotations/val.json", root / "frames.json")


_SCORED = ("--predictions", "IN/predictions.json", "--out", "OUT")
COMMANDS: dict[str, tuple[str, ...]] = {
    "show": ("gen", "show", "IN", "--out", "OUT"),
    "stats": ("gen", "stats", "IN"),
    "report": ("gen", "report", "IN", "--out", "OUT"),
    "against": ("gen", "check", "IN", "--against", "IN"),
    "import": ("gen", "convert", "IN", "OUT", "--from", "coco"),
    "import to mot": ("gen", "convert", "IN", "OUT", "--from", "coco", "--to", "mot"),
    **{form: ("gen", "convert", "IN", "OUT", "--to", form) for form in WRITER_NAMES if form != "folder"},
    "eval": ("eval", "--data", "IN", "--split", "val", *_SCORED),
    "files": (
        "eval",
        "--annotations",
        "IN/annotations/val.json",
        "--predictions",
        "IN/predictions.json",
        "--out",
        "OUT",
    ),
    "pose": ("eval", "pose", "IN", "--out", "OUT"),
    "track": ("eval", "track", "IN", "--out", "OUT"),
}


READERS = ("stats", "report", "against", "kitti", "skope3d", "eval", "file", "pose", "track")


@pytest.mark.parametrize("name", COMMANDS)
def test_images_of_annotation_files(yard: Yard, name: str) -> None:
    others = {"pose": "frames.json", "track": "frames.json", "kitti": "annotations/train.json"}
    make = hostile.complete if "import" in name else with_results
    if name in READERS:  # they read the file as all others do, and make no names of what it says
        yard.values = yard.values[::4]
    refused(yard, make, images(others.get(name, "annotations/val.json")), *COMMANDS[name])


@pytest.mark.parametrize("name", ["stats", "shards", "eval"])
def test_takes_of_cards(yard: Yard, name: str) -> None:
    refused(yard, with_results, takes("dataset.json"), *COMMANDS[name])


def test_keys_of_manifests(yard: Yard) -> None:
    refused(yard, hostile.complete, {"sha256": in_manifest}, *COMMANDS["shards"], plain=(7, None))


def test_what_recordings_and_begun_folders_say(yard: Yard) -> None:
    def make(root: Path) -> None:
        hostile.labelled(Store(hostile.begun(root)))
        (root / f".work/frames/{hostile.SITES['val']}/00_000000.jsonl").unlink()

    labels = {f"label's {field}": in_labels(field) for field in ("file_name", "depth_file_name")}
    spoils = takes(".work/parameters.json") | labels
    refused(yard, make, spoils, "gen", "render", "IN", "--renderer", "pybullet", "--workers", "1")


def test_headers_of_recordings(yard: Yard) -> None:
    refused(yard, hostile.begun, HEADER, "gen", "render", "IN", "--renderer", "pybullet", "--workers", "1")


@pytest.mark.parametrize("what", ["images", "takes", "manifest", "headers"])
def test_checks_and_repairs(yard: Yard, what: str) -> None:
    """A check finds what is wrong; a repair makes it good or ends in one line."""
    name = "annotations/val.json"
    spoils = {
        "images": images(name),
        "takes": takes("dataset.json"),
        "manifest": {"sha256": in_manifest},
        "headers": HEADER,
    }[what]
    for field, value in spoilt(yard, hostile.complete, spoils):
        if what == "images":
            signed(yard.given, name)
        code, said = yard.run("gen", "check", "IN", *QUIET)
        assert code in (1, 2) or (value is None and field in FIELDS), (field, value, said)
        (yard.given / f"images/{FRAME}.jpg").unlink()  # so that there is something to make again
        code, said = yard.run("gen", "check", "IN", "--repair", *RENDER)
        assert code in (0, 2), (field, value, said)


def test_images_that_are_learnt(yard: Yard) -> None:
    for field, value in spoilt(yard, hostile.complete, images("annotations/train.json")):
        missing = nullcontext() if value is None and field in FIELDS[1:] else pytest.raises(UserError, match=field)
        with missing, yard.watched():
            splits.read(yard.given, exclude_types=(), val_fraction=0.0, max_images=None)


def test_images_that_are_merged(yard: Yard) -> None:
    def make(root: Path) -> None:
        hostile.complete(root / "a")
        shutil.copytree(root / "a", root / "b")

    refused(yard, make, images("b/annotations/val.json"), "gen", "merge", "IN/a", "IN/b", "OUT")


@pytest.mark.parametrize("name", ["show", "coco", "folder"])
def test_what_shards_say(yard: Yard, name: str) -> None:
    shard = "shards/train-000000.tar"

    def make(root: Path) -> None:
        hostile.complete(root.parent / "there")
        assert yard._skope("gen", "convert", root.parent / "there", root, "--to", "shards", *QUIET)[0] == 0
        shutil.rmtree(root.parent / "there")

    def in_image(field: str) -> Spoil:
        def spoil(root: Path, value: Any) -> None:
            members = {name: shards.read_member(root / shard, name) for name in shards.members_of(root / shard)}
            labels = json.loads(members[f"{FRAME}.json"])
            labels["image"][field] = value
            shards.write_shard(root / shard, {**members, f"{FRAME}.json": json.dumps(labels).encode()}.items())
            shards._index.cache_clear()

        return spoil

    def in_index(root: Path, value: Any) -> None:
        edited((root / shard).with_suffix(".json"), lambda index: index.update({str(value): index.pop(f"{FRAME}.jpg")}))
        shards._index.cache_clear()

    spoils = {**{field: in_image(field) for field in FIELDS}, "member": in_index}
    refused(
        yard,
        make,
        spoils,
        "gen",
        *(("show", "IN", "--out", "OUT") if name == "show" else ("convert", "IN", "OUT", "--to", name)),
    )


def test_names_in_archives(yard: Yard) -> None:
    """Of CVAT: of the members, and in its annotation file."""
    document = "annotations/person_keypoints_val.json"

    def make(root: Path) -> None:
        hostile.complete(root)

    def packed(root: Path, extra: str, field: str = "", value: Any = None) -> None:
        rows = json.loads((root / "annotations/val.json").read_text())
        rows["images"][0].update({field: value} if field else {})
        picture = rows["images"][0]["file_name"] if not field else "images/t01_main_west/00_000000.jpg"
        with zipfile.ZipFile(root / "a.zip", "w") as file:
            file.writestr(document, json.dumps(rows))
            file.write(root / picture, picture)
            file.writestr(zipfile.ZipInfo(extra), b"")

    spoils: dict[str, Spoil] = {
        field: partial(lambda root, value, field: packed(root, "extra", field, value), field=field) for field in FIELDS
    }
    spoils["member"] = lambda root, value: packed(root, str(value))
    refused(yard, make, spoils, "gen", "convert", "IN/a.zip", "OUT", "--from", "cvat", plain=TEXT)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_names_of_scenes(yard: Yard, tmp_path: Path) -> None:
    """Of the published layout: of the folder in the archive, and in the table beside our own."""
    film = video(tmp_path)

    def packed(root: Path, scene: str = "scene_5", **row: Any) -> None:
        root.mkdir(exist_ok=True)
        write_zip(root / "a.zip", {f"{scene}/original.avi": film, f"{scene}/0/": ""})
        cells = {"scene": "scene_5", "split": "train", "site": "a", "recording": "00"} | row
        with (root / "scenes.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(cells))
            writer.writeheader()
            writer.writerow(cells)

    def in_table(field: str) -> Spoil:
        return lambda root, value: packed(root, **{field: value})

    spoils = {field: in_table(field) for field in ("split", "site", "recording")}
    spoils["folder"] = lambda root, value: packed(root, str(value))
    refused(yard, packed, spoils, "gen", "convert", "IN/a.zip", "OUT", "--from", "skope3d", plain=TEXT)


def test_files_of_models(yard: Yard) -> None:
    def make(root: Path) -> None:
        root.mkdir()
        (root / "car.obj").write_text("")

    def library(root: Path, value: Any) -> None:
        (root / "car.obj").write_text(f"mtllib {value}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")

    refused(yard, make, {"mtllib": library}, "gen", "vehicles", "add", "IN/car.obj")
