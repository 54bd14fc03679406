"""The picture of tracks from above: the road under them, labels that can be read, and footage that is gone."""

import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from skope.camera.ground_plane import Ground
from skope.camera.model import Camera
from skope.dataset import coco
from skope.dataset.folder import read_image
from skope.pictures.median import median_of
from skope.schema import AnnotationFile
from skope.tracking import birdseye, birdseye_video, map_signs
from skope.tracking.ground_view import GroundView, empty_road
from skope.tracks.track import Track
from skope.video.write import write_video
from tests.samples import make_image
from tests.sightings import drive

CAMERA = Camera.looking([3, -2, 7], yaw=0.4, pitch_down=math.radians(15))
GROUND = Ground(height=0.5, slope=(0.02, -0.01), about=(1.0, 2.0))


def track(number: int, places: Any, *, size: tuple[float, float, float] = (4.5, 1.8, 1.5)) -> Track:
    """A track through `places` (M, 2) on z = 0, ten a second."""
    xy = np.asarray(places, dtype=np.float64)
    velocity = np.gradient(xy, 0.1, axis=0)
    count = len(xy)
    return Track(
        number=number,
        body_type="car",
        class_name="car",
        class_confidence=0.9,
        length=size[0],
        width=size[1],
        height=size[2],
        frames=np.arange(count),
        times_s=np.arange(count) / 10,
        position=np.column_stack([xy, np.zeros(count)]),
        velocity=velocity,
        acceleration=np.zeros((count, 2)),
        heading=np.arctan2(velocity[:, 1], velocity[:, 0]),
        covariance=np.tile(0.01 * np.eye(2), (count, 1, 1)),
        speed_sigma=np.full(count, 0.2),
        located=np.ones(count, dtype=bool),
        boxes=np.full((count, 4), np.nan),
        scores=np.full(count, np.nan),
        truth_ids=np.full(count, -1),
    )


def view(**changes: Any) -> GroundView:
    values = {"camera": CAMERA, "ground": GROUND, "low": np.zeros(2), "high": np.array([40.0, 30.0]), "cell_m": 0.25}
    return GroundView(**{**values, **changes})


def test_a_mark_on_the_road_is_where_it_lies_from_above() -> None:
    x, y = 20.1, 6.1
    z = 0.5 + 0.02 * (x - 1) - 0.01 * (y - 2)
    ((column, row),), _, _ = CAMERA.project([[x, y, z]])
    picture = np.full((CAMERA.height, CAMERA.width, 3), 255, dtype=np.uint8)
    picture[int(row) - 4 : int(row) + 5, int(column) - 4 : int(column) + 5] = 0
    rows, columns = np.nonzero(view().pale(picture)[..., 0] < 250)
    assert (columns.mean() + 0.5) * 0.25 == pytest.approx(x, abs=0.3)
    assert 30 - (rows.mean() + 0.5) * 0.25 == pytest.approx(y, abs=0.3)


def test_the_field_of_view_ends_at_the_image_and_behind_the_camera() -> None:
    around = view(low=np.array([-20.0, -20.0]), high=np.array([40.0, 30.0]))
    assert around.seen.any()
    behind = view(low=np.array([-20.0, -22.0]), high=np.array([2.0, -3.0]))
    assert not behind.seen.any()
    black = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    assert (behind.pale(black) == 255).all()


def test_far_road_is_paler_than_near_road() -> None:
    black = np.zeros((CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    ahead = np.array([math.cos(0.4), math.sin(0.4)])
    levels = []
    for distance in (20, 400):
        middle = np.array([3.0, -2.0]) + distance * ahead
        levels.append(view(low=middle - 1, high=middle + 1, ground=Ground()).pale(black).mean())
    assert levels[0] < 130
    assert levels[1] == 255


def test_what_drives_is_not_on_the_empty_road(tmp_path: Path) -> None:
    frames = [np.full((48, 96, 3), 120, dtype=np.uint8) for _ in range(20)]
    for i, pixels in enumerate(frames):
        pixels[16:32, 4 * i : 4 * i + 16] = 255
    write_video(tmp_path / "v.mp4", frames, 10)
    images = tuple(replace(make_image(i), time_s=(i - 1) / 10) for i in range(1, 21))
    for info in ({"video": "v.mp4"}, {"found_at": "../v.mp4"}):
        folder = tmp_path if "video" in info else tmp_path / "seen"
        folder.mkdir(exist_ok=True)
        road = empty_road(folder, AnnotationFile(images=images, annotations=(), info=info))
        assert road is not None
        assert np.abs(road.astype(int) - 120).max() < 12
    assert empty_road(tmp_path, AnnotationFile(images=images, annotations=())) is None


def test_labels_lie_neither_on_each_other_nor_on_vehicles() -> None:
    figure = Figure(figsize=(8, 6), dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, 80), ylim=(0, 60))
    tracks = [
        track(5 * row + column + 1, np.array([25 + 5.5 * column, 25 + 2.5 * row]) + np.arange(20)[:, None] * [0.4, 0.0])
        for row in range(4)
        for column in range(5)
    ]
    map_signs.draw_labels(axes, tracks, tracks, {t.number: 0 for t in tracks}, [])
    boxes = [text.get_window_extent() for text in axes.texts]
    assert len(boxes) > 10
    vehicles = [axes.transData.transform(map_signs.vehicle_points(t, 0, map_signs.MAP_SYMBOLS.outline)) for t in tracks]
    for a, b in itertools.combinations(boxes, 2):
        assert not a.overlaps(b)
    for box, corners in itertools.product(boxes, vehicles):
        inside = (corners > [box.x0, box.y0]) & (corners < [box.x1, box.y1])
        assert not inside.all(axis=1).any()


@pytest.mark.parametrize("count", [0, 1, 3])
def test_any_number_of_tracks_makes_a_picture(tmp_path: Path, count: int) -> None:
    tracks = [track(i + 1, np.array([10, 3.5 * i]) + np.arange(30)[:, None] * [0.2 * i, 0.1]) for i in range(count)]
    road = np.full((CAMERA.height, CAMERA.width, 3), 90, dtype=np.uint8)
    birdseye.draw(tmp_path / "b.png", tracks, CAMERA, GROUND if count else None, road)
    assert read_image(tmp_path / "b.png").shape[1] == 1500


def test_the_map_is_of_what_is_known_well() -> None:
    near, far = track(1, [[10.0, 0.0], [20.0, 0.0]]), track(2, [[20.0, 5.0], [500.0, 5.0]])
    far = replace(far, covariance=np.array([0.5**2, 900.0])[:, None, None] * np.eye(2))
    low, high = birdseye.extent([near, far], CAMERA.position[:2])
    assert high[0] < 100
    for x, y in ([3, -2], [10, 0], [20, 5]):
        assert low[0] < x < high[0]
        assert low[1] < y < high[1]
    _, all_far = birdseye.extent([replace(far, covariance=np.tile(900.0 * np.eye(2), (2, 1, 1)))], CAMERA.position[:2])
    assert all_far[0] > 500


def test_the_video_moves_what_drives_over_the_road() -> None:
    """One vehicle, 10 m in a second; the rest of the pictures stays as it is."""
    drives = track(1, np.array([10.0, 0.0]) + np.arange(11)[:, None] * [1.0, 0.0])
    road = np.full((CAMERA.height, CAMERA.width, 3), 90, dtype=np.uint8)
    pictures = list(birdseye_video.birdseye_frames([drives], drives.times_s.tolist(), CAMERA, GROUND, road))
    assert len(pictures) == 11
    first, last = pictures[0].astype(int), pictures[-1].astype(int)
    height, width = first.shape[:2]
    assert (height % 2, width % 2, max(height, width)) == (0, 0, 1200)
    low, high = birdseye.extent([drives], CAMERA.position[:2])
    scale = width / (high - low)[0]
    changed = np.argwhere((np.abs(first - last).sum(axis=-1) > 30)[60:])
    columns = np.percentile(changed[:, 1], [0, 100]) / scale + low[0]
    assert columns[0] == pytest.approx(10 - 2.25, abs=0.5)
    assert columns[1] > 20 + 2.25 - 0.5
    nothing = list(birdseye_video.birdseye_frames([], [0.0, 0.1], CAMERA, None, None))
    assert len(nothing) == 2


def test_footage_that_is_gone_is_told_and_tracks_are_written(skope: Any) -> None:
    coco.write(Path("road.json"), replace(drive(1, 10), info={"video": "gone.mp4"}))
    code, out, _ = skope("eval", "track", "--annotations", "road.json", "--noise", 1, "--out", "t")
    assert code == 0
    assert "birdseye.png has no picture of the road: gone.mp4: no such file" in out
    assert Path("t/birdseye.png").is_file()


def test_the_median_of_blocks_is_that_of_whole_frames() -> None:
    rng = np.random.default_rng(0)
    for count in (1, 4, 5):
        frames = [rng.integers(0, 256, (131, 7, 3), dtype=np.uint8) for _ in range(count)]
        np.testing.assert_array_equal(median_of(frames), np.sort(np.stack(frames), axis=0)[count // 2])
