"""The published layout: zips made here by hand are read exactly, each way of breaking one is told, our own return."""

import io
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skope import keypoints
from skope.dataset import coco
from skope.dataset.folder import open_dataset
from skope.errors import UserError
from skope.files.json_files import read_json, write_json
from skope.gen.formats import source_files
from skope.gen.inspect.check import check
from skope.video.write import write_video
from tests.samples import make_dataset

POINTS = [(4.25 * i - 2, 1.5 * i + 0.5, i % 3 != 1) for i in range(33)]
"""Of the vehicle in frame 1, relative to its crop; the first lies left of it, the second is hidden."""
KEYPOINT = "\n".join(["40,50", "42.5,51.25", "90,110.75", *(f"{x},{y},{int(v)}" for x, y, v in POINTS)])
METADATA = "\n".join(["7,12", *(f"{40 + i},{50.5 + 2 * i}" for i in range(8))])
FRAMES = 3

Members = dict[str, bytes | str]


def video(tmp_path: Path, frames: int = FRAMES) -> bytes:
    path = tmp_path / "original.avi"
    shades = [np.full((120, 160, 3), 40 + 60 * i, np.uint8) for i in range(frames)]
    write_video(path, shades, 10.0)
    return path.read_bytes()


@pytest.fixture
def members(tmp_path: Path) -> Members:
    return {
        "scene_5/original.avi": video(tmp_path),
        "scene_5/1/keypoint_0.csv": "\ufeff" + KEYPOINT,  # as spreadsheets write it
        "scene_5/1/metadata_0.csv": METADATA,
        "scene_5/2/": "",
        "scene_5/readme.txt": "of no interest",
    }


def write_zip(path: Path, members: Members) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


def test_a_published_scene_is_read_exactly(skope: Any, members: Members) -> None:
    write_zip(Path("in/scene_5.zip"), members)
    code, out, err = skope("gen", "convert", "in", "out", "--from", "skope3d", "-q")
    assert (code, out, err) == (0, "wrote out; next: skope gen check out\n", "")
    data = open_dataset(Path("out"))
    assert (data.scheme.name, data.splits, data.licence) == (
        "skope3d",
        ("train",),
        "CC BY-NC-SA 4.0 (as its users state it)",
    )
    file = data.read("train")
    assert [(i.frame_index, i.time_s, i.site, i.width, i.height) for i in file.images] == [
        (1, 0.1, "scene_5", 160, 120),
        (2, 0.2, "scene_5", 160, 120),
    ]
    # Each frame has its own pixels.
    assert [int(np.rint(data.image(image).mean() / 10)) * 10 for image in file.images] == [100, 160]
    (vehicle,) = file.annotations
    assert (vehicle.image_id, vehicle.track_id, vehicle.model) == (1, 7, "12")
    assert vehicle.bbox.tolist() == [42.5, 51.25, 47.5, 59.5]
    assert np.array_equal(vehicle.box_3d_pixels, [[40 + i, 50.5 + 2 * i] for i in range(8)])
    for i, (x, y, visible) in enumerate(POINTS):
        inside = 40 + x < 160 and 50 + y < 120
        expected = [40 + x, 50 + y, 1 + visible] if inside else [0, 0, 0]
        assert vehicle.keypoints[i].tolist() == expected, i
    assert (vehicle.vehicle_type, vehicle.color, vehicle.box_3d, vehicle.keypoints_3d) == (None,) * 4
    assert read_json(Path("out/dataset.json"))["counts"]["by_site"] == {
        "scene_5": {"images": 2, "ground_truth": 1, "ignored": 0}
    }
    # The points of this scene are strewn about.
    assert {str(finding).rpartition(", ")[2] for finding in check(data)} == {"far outside its vehicle's box"}


def test_frames_may_be_counted_from_one(skope: Any, members: Members) -> None:
    members["scene_5/3/"] = ""
    write_zip(Path("scene_5.zip"), members)
    assert skope("gen", "convert", "scene_5.zip", "out", "--from", "skope3d", "-q")[0] == 0
    data = open_dataset(Path("out"))
    file = data.read("train")
    assert [(i.frame_index, i.time_s) for i in file.images] == [(1, 0.0), (2, 0.1), (3, 0.2)]
    assert [int(np.rint(data.image(image).mean() / 10)) * 10 for image in file.images] == [40, 100, 160]


@pytest.mark.parametrize("filling", ["0", "-1", "0.0", "-1.000"])
def test_files_written_as_whole_arrays_are_read_alike(skope: Any, members: Members, filling: str) -> None:
    write_zip(Path("plain.zip"), members)
    rows = KEYPOINT.split("\n")
    members[K0] = "\n".join([*(f"{row},{filling}" for row in rows[:3]), *rows[3:]])
    write_zip(Path("whole.zip"), members)
    for name in ("plain", "whole"):
        assert skope("gen", "convert", f"{name}.zip", name, "--from", "skope3d", "-q")[0] == 0
    plain, whole = (open_dataset(Path(name)).read("train").annotations for name in ("plain", "whole"))
    assert np.array_equal(plain[0].keypoints, whole[0].keypoints)
    assert np.array_equal(plain[0].bbox, whole[0].bbox)


def test_points_are_mapped_by_name(skope: Any, members: Members) -> None:
    write_zip(Path("scene_5.zip"), members)
    write_json(Path("map.json"), {"skope3d_16": "wheel_rear_left", "skope3d_03": "roof_rear_left"})
    arguments = ("gen", "convert", "scene_5.zip", "out", "--from", "skope3d", "--map", "map.json", "--split", "extra")
    assert skope(*arguments, "-q")[0] == 0
    data = open_dataset(Path("out"))
    assert (data.scheme.name, data.splits) == ("skope33", ("extra",))
    (vehicle,) = data.read("extra").annotations
    x, y, visible = POINTS[16]
    index = keypoints.INDEX["wheel_rear_left"]
    assert vehicle.keypoints[index].tolist() == [40 + x, 50 + y, 1 + visible]
    # Roof and logo are known by themselves; the logo is outside this image.
    assert np.flatnonzero(vehicle.keypoints[:, 2]).tolist() == [0, 1, 2, 3, index]
    assert "6 of 33 keypoints are mapped" in data.card["label_rules"][1]


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ([], "map.json: expected an object like"),
        ({"skope3d_33": "front_logo"}, "'skope3d_33' is not one of skope3d_00 to skope3d_32"),
        ({"skope3d_16": "wheel"}, "skope3d_16: 'wheel' is not a keypoint of skope33"),
        ({"skope3d_16": ["wheel"]}, "skope3d_16: ['wheel'] is not a keypoint of skope33"),
        ({"skope3d_00": "roof_rear_left"}, "skope3d_00: is roof_front_right, not roof_rear_left"),
        ({"skope3d_04": "mirror_left", "skope3d_05": "mirror_left"}, "two points are mapped to mirror_left"),
    ],
)
def test_a_wrong_map_is_told(skope: Any, members: Members, table: Any, said: str) -> None:
    write_zip(Path("scene_5.zip"), members)
    write_json(Path("map.json"), table)
    code, out, err = skope("gen", "convert", "scene_5.zip", "out", "--from", "skope3d", "--map", "map.json", "-q")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
    assert {path.name for path in Path().iterdir()} == {"scene_5.zip", "map.json", "original.avi"}


def put(name: str, content: bytes | str) -> Callable[[Members], None]:
    return lambda members: members.update({name: content})


def drop(name: str) -> Callable[[Members], None]:
    return lambda members: members.pop(name) and None


def line(text: str, number: int, content: str) -> str:
    rows = text.split("\n")
    rows[number - 1] = content
    return "\n".join(rows)


K0, M0 = "scene_5/1/keypoint_0.csv", "scene_5/1/metadata_0.csv"


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (drop("scene_5/original.avi"), "has no member scene_5/original.avi"),
        (drop(M0), "scene_5/1: vehicle 0 has no metadata file"),
        (drop(K0), "scene_5/1: vehicle 0 has no keypoint file"),
        (put("scene_6/original.avi", b""), "expected one folder with original.avi and frames, got 2"),
        (put("scene_5/original.avi", b"RIFF"), "scene_5/original.avi: not a video that can be decoded"),
        (put("scene_5/9/", ""), "frame 9 cannot be decoded; the annotations go to 9"),
        (put(K0, KEYPOINT.rsplit("\n", 1)[0]), f"{K0}: expected 36 rows, got 35"),
        (put(K0, KEYPOINT + "\n1,2,1"), f"{K0}: expected 36 rows, got 37"),
        (put(K0, line(KEYPOINT, 5, "1,2")), f"{K0}: line 5: expected 3 values, got '1,2'"),
        (put(K0, line(KEYPOINT, 1, "1,2,1")), f"{K0}: line 1: expected 2 values, got '1,2,1'"),
        (put(K0, line(KEYPOINT, 2, "1,2,0,0")), f"{K0}: line 2: expected 2 values, got '1,2,0,0'"),
        (put(K0, line(KEYPOINT, 5, "1,2,-1")), f"{K0}: line 5: visible is 0 or 1, got -1"),
        (put(M0, line(METADATA, 2, "1,2,0")), f"{M0}: line 2: expected 2 values, got '1,2,0'"),
        (put(K0, line(KEYPOINT, 1, "1,2,3")), f"{K0}: line 1: expected 2 values, got '1,2,3'"),
        (put(K0, line(KEYPOINT, 5, "1,two,1")), f"{K0}: line 5: expected numbers, got '1,two,1'"),
        (put(K0, line(KEYPOINT, 5, "1,nan,1")), f"{K0}: line 5: expected numbers"),
        (put(K0, line(KEYPOINT, 9, "1,1,2")), f"{K0}: line 9: visible is 0 or 1, got 2"),
        (put(K0, line(KEYPOINT, 3, "42.5,110")), f"{K0}: lines 2 and 3: the box is empty"),
        (put(K0, b"\xff\xfe\x00"), f"{K0}: not a CSV file"),
        (put(K0, "1,1\n" * 40000), f"{K0!s}: 160000 bytes, more than 65536"),
        (put(M0, line(METADATA, 1, "-1,3")), f"{M0}: line 1: expected a track id from 0, got '-1'"),
        (put(M0, line(METADATA, 1, "seven,3")), f"{M0}: line 1: expected a track id from 0"),
        (put(M0, METADATA.rsplit("\n", 1)[0]), f"{M0}: expected 9 rows, got 8"),
        (put("scene_5/../../evil.csv", "x"), "its name leads out of the archive"),
        (put("/etc/cron.d/evil", "x"), "its name leads out of the archive"),
        (put("scene_5\\..\\evil", "x"), "its name leads out of the archive"),
    ],
)
def test_a_broken_scene_is_told(skope: Any, members: Members, damage: Callable[[Members], None], said: str) -> None:
    damage(members)
    write_zip(Path("in/scene_5.zip"), members)
    code, out, err = skope("gen", "convert", "in", "out", "--from", "skope3d", "-q")
    assert (code, out) == (2, "")
    (only,) = err.splitlines()
    assert only.startswith("skope: in/scene_5.zip: ")
    assert said in only
    assert {path.name for path in Path().iterdir()} == {"in", "original.avi"}


def test_an_archive_that_is_none_is_told(skope: Any, members: Members) -> None:
    path = write_zip(Path("scene_5.zip"), members)
    data = path.read_bytes()

    def refused(content: bytes, said: str) -> None:
        path.write_bytes(content)
        code, out, err = skope("gen", "convert", path, "out", "--from", "skope3d", "-q")
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert said in err
        assert not Path("out").exists()

    refused(data[: len(data) // 2], "scene_5.zip: a truncated zip archive (its end is missing)")
    refused(b"hello", "scene_5.zip: not a zip archive")
    at = data.index(KEYPOINT.encode()) + 20
    refused(data[:at] + b"9" + data[at + 1 :], f"member {K0}: cannot be unpacked: Bad CRC-32")
    code, _, err = skope("gen", "convert", "gone.zip", "out", "--from", "skope3d", "-q")
    assert (code, "gone.zip: no such file" in err) == (2, True)
    Path("empty").mkdir()
    code, _, err = skope("gen", "convert", "empty", "out", "--from", "skope3d", "-q")
    assert (code, "empty: no scene_K.zip there" in err) == (2, True)


def archived(*infos: tuple[zipfile.ZipInfo, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as file:
        for info, content in infos:
            info.compress_type = zipfile.ZIP_DEFLATED
            file.writestr(info, content)
    return stream.getvalue()


def test_bombs_links_and_twins_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.zip"

    def refused(content: bytes, said: str) -> None:
        path.write_bytes(content)
        with pytest.raises(UserError, match=said), source_files.opened(path):
            pass

    refused(archived((zipfile.ZipInfo("scene_1/original.avi"), bytes(8 << 20))), "would unpack to 8388608: rejected")
    link = zipfile.ZipInfo("scene_1/original.avi")
    link.external_attr = 0o120777 << 16
    refused(archived((link, b"/etc/passwd")), "is a link")
    with pytest.warns(UserWarning, match="Duplicate name"):
        twins = archived((zipfile.ZipInfo("a/b"), b"1"), (zipfile.ZipInfo("a/b"), b"2"))
    refused(twins, "a/b is a duplicate")
    secret = bytearray(archived((zipfile.ZipInfo("a/b"), b"1")))
    secret[secret.index(b"PK\x01\x02") + 8] |= 1
    refused(bytes(secret), "is encrypted")
    # The directory says less than there is: no more is unpacked than it says, and that does not check.
    content = bytes(np.random.default_rng(0).integers(0, 256, 5000, dtype=np.uint8))
    liar = bytearray(archived((zipfile.ZipInfo("a/b"), content)))
    entry = liar.index(b"PK\x01\x02")
    liar[entry + 24 : entry + 28] = (100).to_bytes(4, "little")
    path.write_bytes(bytes(liar))
    with (
        source_files.opened(path) as opened,
        pytest.raises(UserError, match="member a/b: cannot be unpacked"),
    ):
        opened.read("a/b", 1000)


def test_our_export_returns(skope: Any) -> None:
    ours = make_dataset(Path("ours"), images=3)
    write_json(ours / "dataset.json", {**read_json(ours / "dataset.json"), "licence": "CC0 1.0: take it"})
    assert skope("gen", "convert", "ours", "zips", "--to", "skope3d", "-q")[0] == 0
    assert {p.name for p in Path("zips").iterdir()} == {
        *("scene_1.zip", "scene_2.zip", "scenes.csv", "map.json", "LICENCE.txt")
    }
    # Both splits have the same site and recording, which the layout's own names must keep apart.
    code, _, err = skope("gen", "convert", "zips", "back", "--from", "skope3d", "--map", "zips/map.json", "-q")
    assert (code, "scene_2 is in zips/scene_1.zip too" in err) == (2, True)
    one = Path("zips/scene_2.zip")
    assert skope("gen", "convert", one, "back", "--from", "skope3d", "--map", "zips/map.json", "-q")[0] == 0
    then, now = open_dataset(ours).read("train"), open_dataset(Path("back")).read("train")
    assert open_dataset(Path("back")).licence == "CC0 1.0: take it"
    assert [i.site for i in now.images] == [i.site for i in then.images]
    for a, b in zip(then.annotations, now.annotations, strict=True):
        assert np.abs(a.bbox - b.bbox).max() < 0.011
        assert np.array_equal(a.keypoints[:, 2], b.keypoints[:, 2])
        assert np.abs(a.keypoints - b.keypoints).max() < 0.011
        assert a.track_id == b.track_id
    for a, b in zip(then.images, now.images, strict=True):
        before, after = (open_dataset(root).image(i) for root, i in ((ours, a), (Path("back"), b)))
        assert cv2.PSNR(before, after) > 25


def test_out_must_be_empty_and_flags_must_fit(skope: Any) -> None:
    make_dataset(Path("ours"))
    for arguments, said in (
        (("ours", "ours", "--to", "skope3d"), "ours: holds other files than these; choose another folder"),
        (("ours", "new"), "expected --to or --from with a format"),
        (("ours", "new", "--to", "pascal"), "--to: 'pascal' is not one of folder, shards"),
        (("ours", "new", "--from", "pascal"), "--from: 'pascal' is not one of"),
        (("ours", "ours", "new", "--to", "skope3d"), "expected one dataset folder and a new folder, got 2"),
        (("ours", "new", "--from", "coco", "--to", "shards"), "--to shards: only for datasets made by `skope gen`"),
        (("ours", "new", "--to", "yolo", "--images", "ours"), "--images is for --from coco, --from cvat"),
        (("ours", "new", "--from", "skope3d", "--split", "../train"), "--split: expected letters, digits"),
        (("new", "--to", "skope3d"), "new: expected a source and the new folder"),
        (("ours", "new", "--to", "skope3d", "--split", "easy"), "--split is for --from"),
    ):
        code, out, err = skope("gen", "convert", *arguments, "-q")
        assert (code, out, err.count("\n")) == (2, "", 1), err
        assert said in err
        assert {path.name for path in Path().iterdir()} == {"ours"}


def test_splits_and_sites_return_with_all_scenes(skope: Any) -> None:
    ours = make_dataset(Path("ours"), images=2, splits=("train", "easy", "hard"))
    sites = {"train": "mast", "easy": "bridge", "hard": "pole"}
    for split, site in sites.items():
        path = ours / "annotations" / f"{split}.json"
        file = coco.read(path)
        coco.write(path, replace(file, images=tuple(replace(image, site=site) for image in file.images)))
    assert skope("gen", "convert", "ours", "zips", "--to", "skope3d", "-q")[0] == 0
    assert skope("gen", "convert", "zips", "back", "--from", "skope3d", "-q")[0] == 0
    back = open_dataset(Path("back"))
    assert back.scheme.name == "skope3d"
    assert {split: back.read(split).images[0].site for split in back.splits} == sites
    for split in sites:
        then, now = open_dataset(ours).read(split).annotations, back.read(split).annotations
        assert [a.track_id for a in now] == [a.track_id for a in then]
        assert all(np.abs(a.keypoints - b.keypoints).max() < 0.011 for a, b in zip(then, now, strict=True))
    # Its own places are not taken from anybody who writes paths into them.
    (Path("zips") / "scenes.csv").write_text("scene,split,site,recording\nscene_1,../up,x,00\n")
    code, _, err = skope("gen", "convert", "zips", "again", "--from", "skope3d", "-q")
    assert (code, "zips/scenes.csv: scene_1: split: expected a name" in err) == (2, True)
