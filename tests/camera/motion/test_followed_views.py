"""Views of a camera that was knocked, in videos that are parts of a picture moved by known amounts."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from skope.camera.motion.followed_views import with_homographies
from skope.camera.motion.view_changes import ViewChange
from skope.camera.motion.view_registration import REGISTRATION_LIMITS, read_views, register, transformed, view_numbers
from skope.dataset import coco
from skope.keypoints import SKOPE33
from skope.schema import AnnotationFile, Image
from skope.tracking.ground_view import empty_road
from skope.video.footage import open_footage
from tests.camera.motion.test_image_shift import SIZE, picture, with_traffic
from tests.camera.motion.test_view_registration import CORNERS, turned_and_zoomed

FPS = 10.0
KNOCKED = turned_and_zoomed(3, 0.5, 1.5)
"""A turn by which the image moves by 24 px."""


def write_video(path: Path, views: list[tuple[NDArray[np.float64], str]]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), FPS, SIZE)
    for k, (H, name) in enumerate(views):
        writer.write(with_traffic(picture(H, name), np.random.default_rng(k), k)[..., ::-1])
    writer.release()
    return path


def knocked(before: int, moving: int, after: int) -> list[tuple[NDArray[np.float64], str]]:
    """Views of a camera that stands still, turns step by step, swings beyond its new view and stands still again."""
    turns = [(k + 1) / moving for k in range(moving)]
    swing = [1.3, 0.8, 1.0]
    return [
        *[(np.eye(3), "noon.jpg")] * before,
        *[(turned_and_zoomed(3 * share, 0.5 * share, 1.5 * share), "noon.jpg") for share in turns[:-1] + swing],
        *[(KNOCKED, "noon.jpg")] * (after - len(swing)),
    ]


def test_a_knocked_camera_is_followed_from_where_it_stands_still(tmp_path: Path) -> None:
    footage = open_footage(str(write_video(tmp_path / "a.avi", knocked(30, 5, 35))))
    told = ViewChange(3.2, cut=False, shift=0.03)  # looks tell it to half a second
    (change,) = with_homographies(footage, [told], 6.8)
    assert change.from_first is not None
    off = np.linalg.norm(transformed(change.from_first.matrix, CORNERS) - transformed(KNOCKED, CORNERS), axis=1)
    assert off.max() < 0.5
    assert change.time_s == pytest.approx(3.0)
    assert change.settled_s == pytest.approx(3.6)
    assert "followed from 3.6 s on" in str(change)
    (first, second) = read_views("a", {"view_changes": [change.to_dict()]})
    assert second.from_first is not None
    assert second.from_first.matrix == pytest.approx(change.from_first.matrix)
    assert view_numbers([first, second], [0.0, 2.9, 3.0, 3.5, 3.6, 9.0]).tolist() == [
        0,
        0,
        REGISTRATION_LIMITS.moving_view,
        REGISTRATION_LIMITS.moving_view,
        1,
        1,
    ]


def test_views_are_followed_past_a_cut_to_another_scene(tmp_path: Path) -> None:
    """A cut to another view, which is not followed, and the first view again, which is."""
    views = [(np.eye(3), "noon.jpg"), (np.eye(3), "own_road.jpg"), (KNOCKED, "noon.jpg")]
    footage = open_footage(str(write_video(tmp_path / "a.avi", [view for view in views for _ in range(35)])))
    changes = [ViewChange(3.5, cut=True, shift=0.0), ViewChange(7.0, cut=True, shift=0.0)]
    lost, again = with_homographies(footage, changes, 10.4)
    assert lost == changes[0]
    assert lost.to_dict() == {"time_s": 3.5, "cut": True, "shift": 0.0}
    assert "not reliably known" in str(lost)
    assert again.from_first is not None
    off = transformed(again.from_first.matrix, CORNERS) - transformed(KNOCKED, CORNERS)
    assert np.abs(off).max() < 0.5
    assert not again.cut
    assert again.shift * SIZE[0] == pytest.approx(22, abs=3)


def test_footage_that_is_not_there_any_more_is_not_followed(tmp_path: Path) -> None:
    footage = open_footage(str(write_video(tmp_path / "a.avi", knocked(10, 2, 10))))
    (tmp_path / "a.avi").unlink()
    changes = [ViewChange(1.0, cut=False, shift=0.03)]
    assert with_homographies(footage, changes, 2.0) == changes


def test_predict_says_where_the_first_view_lies(skope: Any, random_run: Path, tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.avi", knocked(36, 5, 40))
    code, out, error = skope("eval", "predict", video, "--checkpoint", random_run, "--min-size", 64, "--out", "p")
    assert code == 0, error
    assert "the view moves by" in out
    _, second = read_views("a", coco.read(Path("p/frames.json")).info)
    assert second.from_first is not None
    off = transformed(second.from_first.matrix, CORNERS) - transformed(KNOCKED, CORNERS)
    assert np.abs(off).max() < 0.5
    assert (second.begin_s, second.settled_s) == pytest.approx((3.6, 4.2))


def test_the_empty_road_is_of_one_view(tmp_path: Path) -> None:
    """Also where most of the footage shows another one."""
    views = [(np.eye(3), "noon.jpg")] * 10 + [(KNOCKED, "noon.jpg")] * 30
    write_video(tmp_path / "a.avi", views)
    images = tuple(Image(id=k + 1, file_name=f"{k}", width=640, height=360, time_s=k / FPS) for k in range(40))
    info = {"found_at": "a.avi", "view_changes": [{"time_s": 1.0, "cut": False, "shift": 0.03}]}
    file = AnnotationFile(images=images, annotations=(), info=info, name="a", scheme=SKOPE33)
    road = empty_road(tmp_path, file)
    assert road is not None
    found = register(road, with_traffic(picture(np.eye(3)), np.random.default_rng(0), 0))
    assert found is not None
    assert transformed(found.matrix, CORNERS) == pytest.approx(CORNERS, abs=0.5)
