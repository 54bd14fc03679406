"""What names say: splits, cameras, recordings and frames, and which pictures are meant."""

import pytest

from skope.files.safe_names import counting_order, is_relative
from skope.gen.formats import file_name_rules
from skope.gen.formats.file_name_rules import Place, endings, named_split, places, slashed, split_of


@pytest.mark.parametrize(
    ("stem", "folders", "expected"),
    [
        ("Train", [], ("train", "name")),
        ("Validation", [], ("val", "name")),
        ("instances_val2017", [], ("val", "name")),
        ("person_keypoints_Test", ["train"], ("test", "name")),
        ("hard", ["train"], ("hard", "name")),
        ("_annotations.coco", ["valid", "export"], ("val", "folder")),
        ("annotations", ["set", "test"], ("test", "folder")),
        ("instances_default", ["north"], ("train", "default")),
        ("result", [], ("train", "default")),
    ],
)
def test_splits(stem: str, folders: list[str], expected: tuple[str, str]) -> None:
    assert split_of(stem, folders) == expected


def test_only_names_of_splits_are_splits() -> None:
    assert [named_split(name) for name in ("trains", "val_de_marne", "contest", "easy", "")] == [None] * 5


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("images\\a.jpg", "images/a.jpg"),
        ("./a.jpg", "a.jpg"),
        (".\\.\\a.jpg", "a.jpg"),
        ("https://example.org/media/my%20car.jpg?token=1#x", "media/my car.jpg"),
        ("file:///home/a/b.jpg", "home/a/b.jpg"),
        ("s3://bucket/c/d.jpg", "c/d.jpg"),
        ("a/b.jpg", "a/b.jpg"),
        ("a//./b.jpg", "a/b.jpg"),
        ("//server/share/b.jpg", "/server/share/b.jpg"),
    ],
)
def test_paths_of_other_systems(name: str, expected: str) -> None:
    assert slashed(name) == expected


def test_endings_never_lead_out() -> None:
    assert endings("C:/Users/a/b.jpg") == ["Users/a/b.jpg", "a/b.jpg", "b.jpg"]
    assert endings("../../up/4/b.jpg") == ["up/4/b.jpg", "4/b.jpg", "b.jpg"]
    assert endings("/etc/passwd") == ["etc/passwd", "passwd"]
    assert endings("a/../b.jpg") == ["b.jpg"]
    assert endings("..") == endings("/") == endings("a\x00b") == []
    assert all(is_relative(ending) for ending in endings("x/./y//z.jpg"))


def test_skopes_own_names() -> None:
    name = "t01_mill_corner/00_000012.jpg"
    assert places([name]) == [Place("t01_mill_corner", ("t01_mill_corner", "00"), "00", 12)]


def test_folders_that_name_no_camera() -> None:
    names = ["images/frame_1.jpg", "images/frame_2.jpg", "cam1/images/7.jpg", "cam1/images/8.jpg", "valid/x.jpg"]
    found = places(names)
    assert [place.site for place in found] == [None, None, "cam1", "cam1", None]
    assert [place.recording for place in found] == [None] * 5
    assert [place.frame for place in found] == [1, 2, 7, 8, None]


def test_photographs_are_no_recordings_of_their_own() -> None:
    studio = places(["images/00000001-IMG_1001.jpg", "images/0000000a-IMG_1002.jpg"])
    assert [(place.recording, place.frame) for place in studio] == [(None, 1001), (None, 1002)]
    flow = places(["van_0001_jpg.rf.1eef8a.jpg", "van_0002_jpg.rf.2f00ba.jpg"])
    assert [(place.recording, place.frame) for place in flow] == [("van", 1), ("van", 2)]
    assert [place.film for place in places(["red 5.jpg", "green 5.jpg", "blue.jpg"])] == [None] * 3


def test_equal_numbers_tell_no_order() -> None:
    assert [place.frame for place in places(["a_1.jpg", "a_01.jpg", "a_2.jpg"])] == [None] * 3


def test_dates_are_one_number() -> None:
    found = places(["cam_2024-05-01_10-00-00.jpg", "cam_2024-05-01_10-01-30.jpg", "cam_2024-05-02_09-00-00.jpg"])
    assert {place.recording for place in found} == {"cam"}
    assert [place.frame for place in found] == [20240501100000, 20240501100130, 20240502090000]


def test_names_become_short_names() -> None:
    assert file_name_rules.as_name("..x" + "ü" * 200) == "x" + "ü" * 45
    assert file_name_rules.source_name(["export.v2", "annotations", "default"]) == "export.v2"
    assert file_name_rules.source_name(["data", "train", "result"]) == "recording"


def test_numbers_count_as_numbers() -> None:
    names = ["a10.jpg", "a9.jpg", "a009.jpg", "b/1.jpg", "a.jpg", "²3.jpg", "1.jpg"]
    assert sorted(names, key=counting_order) == ["1.jpg", "a009.jpg", "a9.jpg", "a10.jpg", "a.jpg", "b/1.jpg", "²3.jpg"]
