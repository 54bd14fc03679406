"""Footage of a site: the video shows what its labels are of."""

from pathlib import Path
from typing import Any

import cv2
import pytest

from skope.dataset import coco
from tests.gen.test_generation_site import BASE, EXAMPLE, toml

SHORT = ("--fps", "5", "--seconds", "0.2", "--quiet", "--renderer", "pybullet", "--out", "out")


def test_video_and_labels_have_one_size(skope: Any) -> None:
    assert skope("gen", "video", "t01_main_west", "--size", "96x54", *SHORT)[0] == 0
    capture = cv2.VideoCapture("out/t01_main_west.mp4")
    size = tuple(int(capture.get(what)) for what in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    (image,) = coco.read(Path("out/t01_main_west.json")).images
    assert size == (image.width, image.height) == (96, 54)


@pytest.mark.parametrize("size", ["97x55", "96x55", "97x54"])
def test_odd_sizes_are_refused(skope: Any, size: str) -> None:
    code, out, error = skope("gen", "video", "t01_main_west", "--size", size, *SHORT)
    assert (code, out) == (2, "")
    assert error == f"skope: --size: expected an even width and height for a video, got {size}\n"
    assert not Path("out").exists()


def test_an_odd_camera_of_a_site_file_is_refused(skope: Any, tmp_path: Path) -> None:
    (tmp_path / "junction.net.xml").write_bytes((EXAMPLE / "junction.net.xml").read_bytes())
    camera = {**BASE["camera"], "size": [97, 55]}  # type: ignore[dict-item]
    (tmp_path / "site.toml").write_text(toml({**BASE, "camera": camera}))
    code, out, error = skope("gen", "video", "site.toml", *SHORT)
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert error.startswith("skope: site.toml: camera.size: expected an even width and height")


def test_footage_is_made_again_and_other_footage_refused(skope: Any) -> None:
    call = ("gen", "video", "t01_main_west", "--size", "96x54", *SHORT)
    assert skope(*call)[0] == 0
    before = {path.name: path.read_bytes() for path in Path("out").iterdir()}
    assert skope(*call)[0] == 0
    assert {path.name: path.read_bytes() for path in Path("out").iterdir()} == before
    code, _, error = skope(*call, "--seed", "1")
    assert (code, error.count("\n")) == (2, 1)
    assert "out/t01_main_west.mp4: exists and belongs to other footage (seed = 0, now 1)" in error
    Path("out/t01_main_west.json").unlink()
    assert skope(*call)[0] == 2
    assert Path("out/t01_main_west.mp4").read_bytes() == before["t01_main_west.mp4"]


def test_footage_labels_people_where_it_is_asked_for(skope: Any) -> None:
    call = ("gen", "video", "t01_mill_corner", "--size", "320x180", *SHORT, "--road-users", "--overlay")
    assert skope(*call, "--seconds", "0.4", "--seed", "3")[0] == 0
    file = coco.read(Path("out/t01_mill_corner.json"))
    assert file.categories == ("vehicle", "bicycle", "motorcycle", "pedestrian")
    assert file.road_users
    assert {user.image_id for user in file.road_users} == {image.id for image in file.images} == {1, 2}
    ids = [label.id for label in (*file.annotations, *file.road_users)]
    assert sorted(ids) == list(range(1, len(ids) + 1))
    assert file.info["options"]["road_users"] is True
