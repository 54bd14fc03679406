"""Files of others, as people send them: read as they were meant, with a word on what was guessed, or refused."""

import io
import json
import os
import stat
import unicodedata
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from skope.dataset.folder import open_dataset, read_image
from skope.dataset.image_selection import held_back, ignoring, recordings
from skope.dataset.picture_headers import PictureHeader, read_header
from skope.schema import AnnotationFile
from tests.gen.formats.foreign_files import BOX, SIZE, category, document, jpeg, picture, save, vehicle, write

COCO = ("--from", "coco")
NUMBERED = [f"{i:06d}.jpg" for i in range(1, 4)]


def convert(skope: Any, *arguments: object, code: int = 0) -> str:
    """Run `skope gen convert`; returns all that it said."""
    found, out, err = skope("gen", "convert", *arguments)
    assert found == code, err
    assert code == 0 or err.splitlines()[-1].startswith("skope: ")
    return str(out + err)


def tracked(made: dict[str, Any]) -> None:
    for row in made["annotations"]:
        row["attributes"] = {"track_id": 1}


def train(root: str) -> AnnotationFile:
    return open_dataset(Path(root)).read("train")


def pictures_of(root: Path) -> dict[str, int]:
    return {path.name: int(cv2.imread(str(path)).mean()) for path in sorted(root.rglob("*.jpg"))}


# -------------------------------------------------------------------------------------------------------------- links


@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("deep", [False, True])
def test_links_are_followed(skope: Any, *, absolute: bool, deep: bool) -> None:
    """Pictures that are links, or lie below a folder that is one; the originals keep time and size."""
    write(Path("in"), NUMBERED)
    store = Path("disk") / "x"
    store.parent.mkdir()
    if deep:
        Path("in/images").rename(store)
        Path("in/images").symlink_to(store.resolve() if absolute else "../disk/x")
    else:
        store.mkdir()
        for path in sorted(Path("in/images").iterdir()):
            path.rename(store / path.name)
            path.symlink_to((store / path.name).resolve() if absolute else f"../../disk/x/{path.name}")
    before = {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in store.iterdir()}
    convert(skope, "in", "out/deeper", *COCO)
    made = sorted(Path("out/deeper/images").iterdir())
    assert [path.name for path in made] == NUMBERED
    for path in made:
        assert not path.is_symlink()
        assert path.samefile(store / path.name)
    assert {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in store.iterdir()} == before
    assert skope("gen", "check", "out/deeper")[0] == 0


def test_links_to_nothing_are_refused(skope: Any) -> None:
    write(Path("in"), NUMBERED)
    Path("in/images/000002.jpg").unlink()
    Path("in/images/000002.jpg").symlink_to("gone.jpg")
    assert "images[1]: file_name: no 000002.jpg" in convert(skope, "in", "out", *COCO, code=2)
    assert not Path("out").exists()


def test_a_joined_dataset_has_each_picture_once(skope: Any) -> None:
    """One of the two was moved to another disk with links left behind, where names lead from elsewhere nowhere."""
    for name, seed in (("one", 0), ("two", 50)):
        write(Path(f"in_{name}"), NUMBERED, seed=seed)
        convert(skope, f"in_{name}", name, *COCO)
    Path("disk").mkdir()
    for path in sorted(Path("one/images").iterdir()):
        path.rename(Path("disk") / path.name)
        path.symlink_to(f"../../disk/{path.name}")
    code, _, err = skope("gen", "merge", "one", "two", "far/below/both")
    assert code == 0, err
    data = open_dataset(Path("far/below/both"))
    images = data.read("train").images
    assert len({image.file_name for image in images}) == 6
    originals = [picture(seed) for seed in (0, 1, 2, 50, 51, 52)]
    for image, original in zip(images, originals, strict=True):
        assert np.abs(data.image(image).astype(int) - original[..., ::-1]).mean() < 6
    assert {image.recording for image in images} == {"in_one", "in_two"}


def test_an_output_folder_may_be_a_link(skope: Any) -> None:
    write(Path("in"), NUMBERED)
    Path("big").mkdir()
    Path("out").symlink_to("big")
    convert(skope, "in", "out", *COCO)
    assert (Path("out").is_symlink(), Path("big/dataset.json").is_file()) == (True, True)
    Path("nowhere").symlink_to("gone")
    assert "nowhere: is a link to what is not there" in convert(skope, "in", "nowhere", *COCO, code=2)


def test_two_pictures_never_share_a_name(skope: Any) -> None:
    """Of a dataset that somebody wrote by hand, with images inside and outside of images/."""
    write(Path("in"), NUMBERED)
    convert(skope, "in", "data", *COCO)
    path = Path("data/annotations/train.json")
    held = json.loads(path.read_text())
    held["images"][1]["file_name"] = "000001.jpg"
    path.write_text(json.dumps(held))
    save(Path("data/000001.jpg"), jpeg(9))
    code, _, err = skope("gen", "convert", "data", "there", "--to", "coco")
    assert (code, "two different files would have this name" in err) == (2, True)
    assert not Path("there").exists()


# ----------------------------------------------------------------------------------------------------- what is claimed


def test_types_are_named_by_classes(skope: Any) -> None:
    classes = [category(1, "Sedan"), category(2, "box-truck"), category(3, "bus")]
    write(
        Path("in"),
        NUMBERED,
        categories=classes,
        change=lambda d: [row.update(category_id=i) for i, row in enumerate(d["annotations"], start=1)],
    )
    said = convert(skope, "in", "out", *COCO)
    assert [a.vehicle_type for a in train("out").annotations] == ["sedan", "box_truck", "bus"]
    assert "warning" not in said


def test_classes_that_become_one_are_told(skope: Any) -> None:
    classes = [category(1, "car"), category(2, "lorry"), category(3, "bus")]
    write(Path("in"), NUMBERED, categories=classes)
    said = convert(skope, "in", "out", *COCO, "-q")
    assert "warning" in said
    assert "classes car, lorry become `vehicle`" in said
    write(Path("single"), NUMBERED, categories=[category(1, "car")])
    assert "warning" not in convert(skope, "single", "there", *COCO)


@pytest.mark.parametrize(
    ("fields", "image", "beside", "expected"),
    [
        ({"licenses": [{"id": 3, "name": "CC BY-NC-ND 2.0"}]}, 3, "", "CC BY-NC-ND 2.0"),
        ({"licenses": [{"id": 3, "name": "", "url": "http://creativecommons.org/licenses/by-nd/2.0/"}]}, None, "",
         "CC BY-ND 2.0"),
        ({"licenses": [{"id": 1, "name": "Attribution-NonCommercial-NoDerivs License"}]}, 1, "", "CC BY-NC-ND"),
        ({"licenses": [{"id": 1, "name": "CC BY 4.0"}, {"id": 2, "name": "CC BY-ND 4.0"}]}, 1, "", "CC BY 4.0"),
        ({"licenses": [{"id": 1, "name": "CC BY 4.0"}, {"id": 2, "name": "CC BY-ND 4.0"}]}, None, "",
         "CC BY 4.0 | CC BY-ND 4.0"),
        ({"licenses": [{"id": 1, "name": "CC BY 4.0"}]}, 7, "", "CC BY 4.0"),
        ({"licenses": [{"name": "", "id": 0, "url": ""}]}, 0, "", "not stated"),
        ({"info": {"license": "cc-by-nc 4.0"}}, None, "", "CC BY-NC 4.0"),
        ({"licenses": [{"id": 1, "name": "CC BY-ND 4.0"}]}, 1, "CC BY 4.0\n", "CC BY 4.0 | CC BY-ND 4.0"),
        ({"licenses": "none"}, "x", "\ufeffODbL 1.0\r\n", "ODbL 1.0"),
        ({}, None, "MIT License\n\n" + "Permission is hereby granted. " * 20, "MIT License"),
    ],
)  # fmt: skip
def test_licences_are_read(skope: Any, fields: dict[str, Any], image: Any, beside: str, expected: str) -> None:
    write(Path("in"), NUMBERED, change=lambda d: [row.update(license=image) for row in d["images"]], **fields)
    if beside:
        save(Path("in/LICENSE.txt"), beside.encode())
    convert(skope, "in", "out", *COCO)
    assert open_dataset(Path("out")).licence == expected


def test_what_may_not_be_derived_from_is_not_joined(skope: Any) -> None:
    mixed = [{"id": 1, "name": "CC BY 4.0"}, {"id": 2, "name": "CC BY-ND 4.0"}]
    for name, licences in (("free", mixed[:1]), ("mixed", mixed)):
        write(Path(f"in_{name}"), [f"{name}{i}.jpg" for i in range(2)], licenses=licences)
        convert(skope, f"in_{name}", name, *COCO)
    for order in (("free", "mixed"), ("mixed", "free")):
        code, _, err = skope("gen", "merge", *order, "both")
        assert (code, "'CC BY-ND 4.0' cannot be combined with 'CC BY 4.0'" in err) == (2, True)


def test_points_and_boxes_that_cannot_be_are_told(skope: Any) -> None:
    """A point at 0, 0 is one that a program did not have; one far away stays, for somebody to look at."""

    def spoil(made: dict[str, Any]) -> None:
        first, second, third = made["annotations"]
        first["keypoints"][:6] = [0, 0, 2, 0, 0, 1]
        second["keypoints"][:3] = [150, 80, 2]
        third["bbox"] = [60, 50, 0.004, 40]

    write(Path("in"), NUMBERED, change=spoil)
    said = convert(skope, "in", "out", *COCO, "-q")
    assert "warning: 1 vehicle with keypoints at 0, 0, far from the box: read as unlabelled" in said
    assert "warning: 1 vehicle with keypoints marked visible far outside the box" in said
    assert "warning: 1 vehicle left out, without area inside the image" in said
    assert said.count("annotations[0]") == said.count("annotations[1]") == said.count("annotations[2]") == 1
    one, two = train("out").annotations
    assert (one.num_keypoints, two.num_keypoints) == (31, 33)
    code, out, _ = skope("gen", "check", "out")
    assert code == 1
    assert "point 0 is marked visible at 150, 80, far outside its vehicle's box" in out
    path = Path("out/annotations/train.json")
    path.write_text(path.read_text().replace('"bbox":[40.0,30.0,60.0,40.0]', '"bbox":[40.0,30.0,60.0,0.0]', 1))
    assert "bbox: has no area: width 60, height 0" in skope("gen", "check", "out")[1]


def test_points_near_the_box_are_not_doubted(skope: Any) -> None:
    x, y, w, h = BOX
    near = [x - 5, y, 2, x + w + 5.5, y + h, 2, x, y - 5.9, 2]
    write(Path("in"), NUMBERED, change=lambda d: d["annotations"][0]["keypoints"].__setitem__(slice(0, 9), near))
    assert "warning" not in convert(skope, "in", "out", *COCO)
    assert skope("gen", "check", "out")[0] == 0


# ------------------------------------------------------------------------------------------ names, folders and splits


def archive(name: str, frames: range, tracks: dict[int, range], seed: int) -> None:
    """A video task of CVAT, whose frames and tracks count from 0."""
    made = document([f"frame_{i:06d}.jpg" for i in frames])
    made["annotations"] = [
        vehicle(0, i + 1, attributes={"track_id": track, "keyframe": True})
        for track, seen in tracks.items()
        for i in seen
    ]
    for number, row in enumerate(made["annotations"], start=1):
        row["id"] = number
    with zipfile.ZipFile(name, "w") as file:
        for i in frames:
            file.writestr(f"images/default/frame_{i:06d}.jpg", jpeg(seed + i))
        file.writestr("annotations/person_keypoints_default.json", json.dumps(made))


def test_two_videos_share_no_vehicle(skope: Any) -> None:
    archive("north.zip", range(12), {0: range(12), 1: range(12)}, seed=0)
    archive("south.zip", range(12), {0: range(4), 1: range(7, 12)}, seed=100)
    convert(skope, "north.zip", "south.zip", "both", "--from", "cvat")
    for name in ("north", "south"):
        convert(skope, f"{name}.zip", name, "--from", "cvat")
    assert skope("gen", "merge", "north", "south", "joined")[0] == 0
    for root in ("both", "joined"):
        file = train(root)
        films = recordings(file)
        assert [(images[0].recording, len(images)) for images in films] == [("north", 12), ("south", 12)]
        assert [image.frame_index for image in films[1]] == list(range(12))
        learnt, validated = held_back(file, 0.34)
        kept = [a for a in ignoring(learnt, validated).annotations if not a.ignored]
        assert len(validated.images) == 8
        assert len(kept) == 4  # the south's second vehicle; the north's were learnt
        assert "distinct vehicles" in skope("gen", "stats", root)[1]
    assert skope("gen", "convert", "both", "mot", "--to", "mot")[0] == 0
    assert sorted(path.name for path in Path("mot/train").iterdir()) == ["north", "south"]


def test_one_recording_named_by_two_files_is_two(skope: Any) -> None:
    """As of two tasks of one camera, each of which counts its tracks from 0."""
    for task, first in (("a", 1), ("b", 5)):
        names = [f"gate/hour_{i:02d}.jpg" for i in range(first, first + 3)]
        write(Path(task), names, annotations="annotations/person_keypoints_default.json")
    convert(skope, "a", "b", "out", "--from", "cvat")
    found = [(images[0].site, images[0].recording, len(images)) for images in recordings(train("out"))]
    assert found == [("gate", "hour", 3), ("gate", "hour_2", 3)]


@pytest.mark.parametrize("listed", ["sorted", "reversed", "shuffled"])
def test_frames_come_in_the_order_of_their_numbers(skope: Any, listed: str) -> None:
    names = sorted(f"{i}.jpg" for i in range(1, 13))
    if listed != "sorted":
        names = names[::-1] if listed == "reversed" else [names[i] for i in np.random.default_rng(0).permutation(12)]
    write(Path("in"), names)
    assert "12 numbered images read as the frames of 1 recording" in convert(skope, "in", "out", *COCO)
    (film,) = recordings(train("out"))
    assert [image.file_name for image in film] == [f"images/{i}.jpg" for i in range(1, 13)]


def test_names_without_numbers_keep_the_files_order(skope: Any) -> None:
    names = ["zebra.jpg", "ant.jpg", "mole.jpg"]
    write(Path("in"), names)
    assert "numbered" not in convert(skope, "in", "out", *COCO)
    (film,) = recordings(train("out"))
    assert [Path(image.file_name).name for image in film] == names


def roboflow(root: Path) -> None:
    for split, first, count in (("train", 1, 4), ("valid", 50, 2), ("test", 80, 2)):
        names = [f"van_{i:04d}_jpg.rf.{i * 7919:08x}.jpg" for i in range(first, first + count)]
        write(root, [f"{split}/{name}" for name in names], annotations="unused", images="", seed=first)
        (root / "unused").unlink()
        save(root / split / "_annotations.coco.json", document(names))


@pytest.mark.parametrize("form", ["folder", "zip", "files", "one"])
def test_splits_by_folders_stay_apart(skope: Any, form: str) -> None:
    roboflow(Path("rf"))
    sources = ["rf"]
    if form == "zip":
        with zipfile.ZipFile("rf.zip", "w") as file:
            for path in Path("rf").rglob("*"):
                file.write(path, path.relative_to("rf").as_posix())
        sources = ["rf.zip"]
    elif form != "folder":
        sources = [f"rf/{split}/_annotations.coco.json" for split in ("train", "valid", "test")]
        sources = sources[1:2] if form == "one" else sources
    said = convert(skope, *sources, "out", *COCO)
    data = open_dataset(Path("out"))
    counts = {split: len(data.read(split).images) for split in data.splits}
    assert counts == ({"val": 2} if form == "one" else {"train": 4, "val": 2, "test": 2})
    assert "valid/_annotations.coco.json: split val, from the name of its folder (--split overrides it)" in said
    assert "/test" not in str(data.card)


def test_subsets_of_cvat_are_our_splits(skope: Any) -> None:
    for subset in ("Train", "Validation", "Test"):
        save(Path(f"in/images/{subset}/j.jpg"), jpeg(len(subset)))
        save(Path(f"in/annotations/person_keypoints_{subset}.json"), document(["j.jpg"]))
    said = convert(skope, "in", "out", "--from", "cvat")
    data = open_dataset(Path("out"))
    assert data.splits == ("test", "train", "val")
    assert "split val, from the name Validation" in said
    for subset, split in (("Train", "train"), ("Validation", "val"), ("Test", "test")):
        image = data.image(data.read(split).images[0])
        assert np.array_equal(image, read_image(Path(f"in/images/{subset}/j.jpg")))


def test_a_picture_in_two_splits_is_told(skope: Any) -> None:
    write(Path("in"), NUMBERED)
    save(Path("in/annotations/test.json"), document(NUMBERED[2:]))
    said = convert(skope, "in", "out", *COCO, "-q")
    assert "warning: 1 image in split train and in test" in said


@pytest.mark.parametrize(
    "stated",
    ["images\\{}", "/home/somebody/p/images/{}", "C:\\Users\\x\\images\\{}", "../../media/{}", "https://a.org/i/{}?x=1",
     "./{}", "elsewhere/{}", "{}"],
)  # fmt: skip
def test_pictures_are_found_in_a_folder_that_is_named(skope: Any, stated: str) -> None:
    made = write(Path("in"), NUMBERED)
    for row, name in zip(made["images"], NUMBERED, strict=True):
        row["file_name"] = stated.format(name)
    save(Path("in/annotations/train.json"), made)
    said = convert(skope, "in", "out", *COCO, "--images", "in/images")
    data = open_dataset(Path("out"))
    assert [Path(image.file_name).name for image in data.read("train").images] == NUMBERED
    for image, name in zip(data.read("train").images, NUMBERED, strict=True):
        assert np.array_equal(data.image(image), read_image(Path("in/images") / name))
    assert ("warning: 3 images found by the end of the name" in said) == (stated not in ("{}", "./{}"))


def test_without_that_folder_the_way_out_is_told(skope: Any) -> None:
    made = write(Path("in"), NUMBERED)
    for stated in ("/home/somebody/images/000001.jpg", "../x/000001.jpg", "D:\\000001.jpg"):
        made["images"][0]["file_name"] = stated
        save(Path("in/annotations/train.json"), made)
        said = convert(skope, "in", "out", *COCO, code=2)
        assert "is not a path inside a folder; give the folder of the images with --images" in said
    # A backslash alone is no way out of anything.
    made["images"][0]["file_name"] = "images\\000001.jpg"
    save(Path("in/annotations/train.json"), made)
    convert(skope, "in", "out", *COCO)


def test_ends_of_names_may_not_mean_one_picture(skope: Any) -> None:
    made = write(Path("in"), NUMBERED)
    made["images"][0]["file_name"], made["images"][1]["file_name"] = "/a/000001.jpg", "/b/000001.jpg"
    save(Path("in/annotations/train.json"), made)
    said = convert(skope, "in", "out", *COCO, "--images", "in/images", code=2)
    assert "images[1]: file_name: /b/000001.jpg is a duplicate (000001.jpg is /a/000001.jpg too)" in said


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(("said", "stored"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_letters_may_be_composed_or_not(skope: Any, said: str, stored: str, *, packed: bool) -> None:
    names = [unicodedata.normalize(said, f"Straße Grün/é{i}.jpg") for i in (1, 2)]
    made = document(names)
    files = {unicodedata.normalize(stored, f"images/{name}"): jpeg(i) for i, name in enumerate(names)}
    files["annotations/train.json"] = json.dumps(made).encode()
    if packed:
        with zipfile.ZipFile("in.zip", "w") as file:
            for name, content in files.items():
                file.writestr(name, content)
    for name, content in files.items():
        save(Path("in") / name, content)
    convert(skope, "in.zip" if packed else "in", "out", *COCO)
    assert len(open_dataset(Path("out")).read("train").images) == 2
    assert skope("gen", "check", "out")[0] == 0


# -------------------------------------------------------------------------------------------------------------- bytes


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
def test_text_is_read_in_every_unicode(skope: Any, encoding: str, *, packed: bool) -> None:
    made = write(Path("in"), NUMBERED)
    text = json.dumps(made, indent=1, ensure_ascii=False).replace("\n", "\r\n").encode(encoding)
    save(Path("in/annotations/train.json"), text)
    if packed:
        with zipfile.ZipFile("in.zip", "w") as file:
            for path in Path("in").rglob("*"):
                file.write(path, path.relative_to("in").as_posix())
    convert(skope, "in.zip" if packed else "in", "out", *COCO)
    assert len(train("out").images) == 3


def test_what_systems_add_is_left_alone(skope: Any) -> None:
    write(Path("in"), NUMBERED)
    for name in ("annotations/._train.json", "images/._000001.jpg", ".DS_Store", "__MACOSX/annotations/._train.json"):
        save(Path("in") / name, b"\0\5\x16\7")
    convert(skope, "in", "out", *COCO)
    for name in ("images/.DS_Store", "images/Thumbs.db", "annotations/._train.json"):
        save(Path("out") / name, b"\0")
    assert skope("gen", "check", "out")[0] == 0


def zipped(path: str, names: dict[str, bytes], *, raw: bool = False) -> None:
    """Write an archive; `raw` names are bytes as they stand, without the flag that says UTF-8."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        for k, (name, content) in enumerate(names.items()):
            info = zipfile.ZipInfo("x")
            info.filename = chr(ord("A") + k) * len(name.encode()) if raw else name
            file.writestr(info, content)
    data = stream.getvalue()
    for k, name in enumerate(names if raw else ()):
        data = data.replace(bytes([ord("A") + k]) * len(name.encode()), name.encode())
    Path(path).write_bytes(data)


def contents(prefix: str = "", separator: str = "/") -> dict[str, bytes]:
    made = {f"images/{name}": jpeg(i) for i, name in enumerate(NUMBERED)}
    made["annotations/train.json"] = json.dumps(document(NUMBERED)).encode()
    return {(prefix + name).replace("/", separator): content for name, content in made.items()}


@pytest.mark.parametrize("kind", ["backslashes", "dots", "one folder", "mac", "folders", "trailing", "own folder"])
def test_archives_of_other_programs(skope: Any, kind: str) -> None:
    files = {
        "backslashes": contents(separator="\\"),
        "dots": contents("./"),
        "one folder": contents("my export/"),
        "mac": {**contents("e/"), "__MACOSX/e/._images": b"\0", "__MACOSX/e/._train.json": b"\0", "e/.DS_Store": b""},
        "folders": {"images\\": b"", "annotations\\": b"", **contents(separator="\\")},
        "trailing": contents(),
        "own folder": {"./": b"", **contents()},
    }[kind]  # fmt: skip
    zipped("in.zip", files)
    if kind == "trailing":
        with Path("in.zip").open("ab") as file:
            file.write(b"\0" * 4096)
    convert(skope, "in.zip", "out", *COCO)
    assert [Path(image.file_name).name for image in train("out").images] == NUMBERED
    assert skope("gen", "check", "out")[0] == 0


def test_names_in_archives_without_the_flag_of_utf_8(skope: Any) -> None:
    names = ["Übergang_1.jpg", "Übergang_2.jpg"]
    files = {f"images/{name}": jpeg(i) for i, name in enumerate(names)}
    files["annotations/train.json"] = json.dumps(document(names)).encode()
    zipped("in.zip", files, raw=True)
    with zipfile.ZipFile("in.zip") as file:
        assert not any(info.flag_bits & 0x800 for info in file.infolist())
    convert(skope, "in.zip", "out", *COCO)
    assert len(train("out").images) == 2


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("../x.jpg", "its name leads out of the archive"),
        ("a\\..\\..\\x.jpg", "its name leads out of the archive"),
        ("__MACOSX/../../x", "its name leads out of the archive"),
        ("images/a\tb.jpg", "its name cannot be a file's"),
    ],
)
def test_only_what_leads_out_is_said_to(skope: Any, name: str, said: str) -> None:
    zipped("in.zip", {**contents(), name: b"x"})
    assert said in convert(skope, "in.zip", "out", *COCO, code=2)


def oriented(content: bytes, orientation: int, *, form: str = "JPEG") -> bytes:
    """The same stored pixels with an EXIF orientation."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    stream = io.BytesIO()
    with Image.open(io.BytesIO(content)) as image:
        pixels = np.asarray(image.convert("RGB"))
    Image.fromarray(pixels).save(stream, form, exif=exif, **({"quality": 98} if form == "JPEG" else {}))
    return stream.getvalue()


def marked(size: tuple[int, int], x: float, y: float) -> bytes:
    """A grey picture with one white square of 4 px around a place, as PNG."""
    pixels = np.full((size[1], size[0], 3), 60, np.uint8)
    cv2.rectangle(pixels, (int(x) - 2, int(y) - 2), (int(x) + 1, int(y) + 1), (255, 255, 255), -1)
    return bytes(cv2.imencode(".png", pixels)[1])


@pytest.mark.parametrize("form", ["JPEG", "PNG", "WEBP"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_labels_of_stored_pixels_turn_with_the_picture(skope: Any, orientation: int, form: str) -> None:
    """A white spot lies where its keypoint does, and the box around it where the shown picture has it."""
    x, y = 52.0, 34.0
    name = f"a.{form.lower()}"

    def change(made: dict[str, Any]) -> None:
        made["images"][0]["file_name"] = name
        made["annotations"][0]["keypoints"] = [x, y, 2] + [0] * 96

    write(Path("in"), [], change=lambda _: None)
    made = document([name])
    change(made)
    save(Path("in/annotations/train.json"), made)
    save(Path("in/images") / name, oriented(marked(SIZE, x, y), orientation, form=form))
    convert(skope, "in", "out", *COCO, "--stored-pixels")
    data = open_dataset(Path("out"))
    file = data.read("train")
    pixels = data.image(file.images[0])
    assert (pixels.shape[1], pixels.shape[0]) == (SIZE if orientation < 5 else SIZE[::-1])
    (found,) = file.annotations
    (place,) = found.keypoints[found.keypoints[:, 2] > 0, :2]
    white = np.argwhere(pixels.min(axis=2) > 200)[:, ::-1] + 0.5
    assert np.abs(white.mean(axis=0) - place).max() < 0.6
    low, high = found.bbox[:2], found.bbox[:2] + found.bbox[2:]
    assert sorted(found.bbox[2:]) == sorted(BOX[2:])
    assert ((white > low) & (white < high)).all()
    assert skope("gen", "check", "out")[0] == 0


def test_orientations_are_told_and_the_other_reading_offered(skope: Any) -> None:
    write(Path("in"), NUMBERED)
    save(Path("in/images/000001.jpg"), oriented(jpeg(), 3))
    said = convert(skope, "in", "out", *COCO, "-q")
    assert "warning: 1 picture rotated by EXIF: labels are read in the pixels of the picture as shown" in said
    assert "--stored-pixels" in said
    save(Path("in/images/000002.jpg"), oriented(jpeg(), 6))
    said = convert(skope, "in", "there", *COCO, code=2)
    assert "images[1]: width, height: 160x90 is the size of the image as stored" in said
    assert "import the file with --stored-pixels" in said
    convert(skope, "in", "there", *COCO, "--stored-pixels")
    assert skope("gen", "check", "there")[0] == 0


def test_the_size_of_a_picture_is_held_against_the_file(skope: Any) -> None:
    write(Path("in"), NUMBERED)
    save(Path("in/images/000003.jpg"), jpeg(0, (320, 180)))
    said = convert(skope, "in", "out", *COCO, "-q")
    assert "warning: 1 picture of another size than the file states" in said
    assert "images[2]" in said


@pytest.mark.parametrize("form", ["JPEG", "PNG", "WEBP", "TIFF"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_headers_say_what_opencv_shows(form: str, orientation: int) -> None:
    content = oriented(jpeg(), orientation, form=form)
    header = read_header(content)
    assert header is not None
    shown = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)
    assert header.shown == (shown.shape[1], shown.shape[0])
    assert header == PictureHeader(stored=SIZE, orientation=orientation)


def test_no_header_of_what_is_no_picture(tmp_path: Path) -> None:
    for name, content in (("page.jpg", b"<html>403</html>"), ("empty.jpg", b""), ("cut.jpg", jpeg()[:15])):
        (tmp_path / name).write_bytes(content)
        assert read_header(tmp_path / name) is None
        assert read_header(content) is None


def test_what_cameras_append_does_not_truncate(tmp_path: Path) -> None:
    """Films, previews and text behind a picture; a picture that ends early is still named."""
    path = tmp_path / "a.jpg"
    whole = jpeg(1)
    progressive = io.BytesIO()
    Image.fromarray(picture(1)).save(progressive, "JPEG", progressive=True)
    restarts = bytes(cv2.imencode(".jpg", picture(1), [cv2.IMWRITE_JPEG_RST_INTERVAL, 2])[1])
    for content in (whole, progressive.getvalue(), restarts, oriented(whole, 1)):
        path.write_bytes(content + b"SEFT" + b"\xff\x00\xff" * 100 + bytes(5000))
        assert read_image(path).shape == (SIZE[1], SIZE[0], 3)
        for share in (0.5, 0.9, 0.99):
            path.write_bytes(content[: int(share * len(content))] + bytes(5000))
            with pytest.raises(ValueError, match=r"truncated JPEG|not an image"):
                read_image(path)


def test_the_inputs_stay_as_they_were(skope: Any) -> None:
    write(Path("in"), [f"{i}.jpg" for i in range(1, 13)], change=tracked)
    for path in Path("in").rglob("*"):
        os.utime(path, (1_600_000_000, 1_600_000_000))
    before = {
        p: (p.stat().st_mtime_ns, p.stat().st_size, stat.S_IMODE(p.stat().st_mode)) for p in Path("in").rglob("*")
    }
    convert(skope, "in", "out", *COCO)
    for form in ("yolo", "coco", "cvat", "mot"):
        assert skope("gen", "convert", "out", form, "--to", form)[0] == 0
    after = {p: (p.stat().st_mtime_ns, p.stat().st_size, stat.S_IMODE(p.stat().st_mode)) for p in Path("in").rglob("*")}
    assert after == before


def test_annotations_ids_do_not_matter(skope: Any) -> None:
    for i, value in enumerate((2.0, "a1b2", None, 1, [3])):
        write(Path(f"in{i}"), NUMBERED, change=lambda d, value=value: d["annotations"][1].update(id=value))
        convert(skope, f"in{i}", f"out{i}", *COCO)
        assert [a.id for a in train(f"out{i}").annotations] == [1, 2, 3]


# -------------------------------------------------------------------------------------------------------------- exports


def labels_of(path: Path) -> Path:
    """Where Ultralytics looks for the labels of an image: the last /images/ of its path is /labels/."""
    before, _, after = path.resolve().as_posix().rpartition("/images/")
    return Path(f"{before}/labels/{after}").with_suffix(".txt")


def test_labels_lie_where_ultralytics_looks(skope: Any) -> None:
    names = ["cam1/images/a_{}.jpg", "images/images/b_{}.jpg", ".hidden/c_{}.jpg", "labels/d_{}.jpg", "e f/%20#{}.jpg"]
    write(Path("in"), [name.format(i) for name in names for i in range(1, 13)])
    convert(skope, "in", "yolo", *COCO, "--to", "yolo")
    images = [path for path in Path("yolo/images").rglob("*.*") if path.is_file()]
    assert len(images) >= 50
    for path in images:
        assert labels_of(path).read_text().startswith("0 ")
        assert not any(part.startswith(".") for part in path.parts)
    assert len(list(Path("yolo/labels").rglob("*.txt"))) == len(images)


def test_pictures_that_ultralytics_does_not_read_are_named(skope: Any) -> None:
    write(Path("in"), [f"{i}.gif" for i in range(1, 13)])
    said = convert(skope, "in", "yolo", *COCO, "--to", "yolo", code=2)
    assert "Ultralytics does not read .gif" in said


def test_sequences_of_like_names_stay_apart(skope: Any) -> None:
    write(Path("in"), ["a_b/c_1.jpg", "a_b/c_2.jpg", "a/b_c_1.jpg", "a/b_c_2.jpg"], change=tracked)
    convert(skope, "in", "out", *COCO)
    assert skope("gen", "convert", "out", "mot", "--to", "mot")[0] == 0
    sequences = sorted(Path("mot/train").iterdir())
    assert [len(list((path / "img1").iterdir())) for path in sequences] == [2, 2]
