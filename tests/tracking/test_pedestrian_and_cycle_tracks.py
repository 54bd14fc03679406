"""People on foot and on two wheels on the road: where a pixel says that they stand, and who is who."""

import csv
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sumolib

from skope import schema
from skope.camera.ground_plane import Ground
from skope.camera.model import Camera
from skope.dataset import coco
from skope.pose.keypoint_views import read_scene
from skope.schema import AnnotationFile, RoadUserResult
from skope.tracking.ground_points import GroundDetection, GroundPoint, ground_detections, ground_points
from skope.tracking.pedestrian_and_cycle_tracks import FOOT_TRACKS, follow_road_users, of_body
from skope.tracks.track import Track
from tests.conftest import files_of
from tests.samples import make_road_user
from tests.sightings import CAMERA, drive

Walk = Callable[[float], tuple[float, float]]
BICYCLE, MOTORCYCLE, PEDESTRIAN = 2, 3, 4


def on_road(x: float, y: float) -> np.ndarray:
    """World place `x` metres before the camera and `y` to its left."""
    yaw = CAMERA.angles[0]
    ahead, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    return np.asarray(CAMERA.position[:2] + x * ahead + y * left)


# ------------------------------------------------------------------------------------------------------ ground points


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.05, -0.03)])
def test_a_pixel_is_taken_to_the_road_as_certainly_as_it_is_known(slope: tuple[float, float]) -> None:
    """The covariance is that of places that many noisy pixels are taken to."""
    ground = Ground(height=0.4, slope=slope, about=(5.0, 1.0), height_sigma=0.0)
    place = on_road(18.0, 3.0)
    height = 0.4 + (place - ground.about) @ slope
    pixel, _, _ = CAMERA.project(np.array([*place, height]))
    (point,) = ground_points(CAMERA, ground, pixel[None], np.array([[1.5, 1.5]]))
    assert point is not None
    assert point.position == pytest.approx(place, abs=1e-6)
    assert point.height == pytest.approx(height)
    noisy = pixel + np.random.default_rng(0).normal(0, 1.5, (4000, 2))
    others = [
        point.position for point in ground_points(CAMERA, ground, noisy, np.full((4000, 2), 1.5)) if point is not None
    ]
    assert point.covariance == pytest.approx(np.cov(np.array(others).T), rel=0.12, abs=2e-4)


def test_a_bumpy_road_makes_places_uncertain_along_the_line_of_sight() -> None:
    pixel, _, _ = CAMERA.project(np.array([*on_road(20.0, 0.0), 0.0]))
    (point,) = ground_points(CAMERA, Ground(height_sigma=0.1), pixel[None], np.array([[0.01, 0.01]]))
    assert point is not None
    values, vectors = np.linalg.eigh(point.covariance)
    # Over 20 m from a camera 7 m high, 0.1 m of height are 0.1 * 20 / 7 of distance.
    assert math.sqrt(values[1]) == pytest.approx(0.1 * 20 / 7, rel=0.02)
    assert abs(vectors[:, 1] @ (on_road(1.0, 0.0) - on_road(0.0, 0.0))) == pytest.approx(1.0, abs=1e-3)


def test_above_the_horizon_and_far_away_there_are_no_places() -> None:
    far, _, _ = CAMERA.project(np.array([*on_road(400.0, 0.0), 0.0]))
    near, _, _ = CAMERA.project(np.array([*on_road(10.0, 0.0), 0.0]))
    pixels = np.array([far, [CAMERA.width / 2, 5.0], near])
    points = ground_points(CAMERA, Ground(), pixels, np.ones((3, 2)))
    assert [point is not None for point in points] == [False, False, True]


# ------------------------------------------------------------------------------------------------------------- tracks


def sight(place: np.ndarray, category: int, link: int | None = None, *, known: bool = True) -> GroundDetection:
    point = GroundPoint(place, 0.1**2 * np.eye(2), 0.0) if known else None
    links = () if link is None else ((category, link),)
    return GroundDetection(category, np.array([10.0, 10, 20, 40]), 0.9, links, {category: 0.9}, point)


def walked(
    people: Sequence[tuple[int, Walk]], times: Sequence[float], *, links: bool = False, seed: int = 0
) -> list[list[GroundDetection]]:
    rng = np.random.default_rng(seed)
    return [
        [
            sight(np.array(walk(t)) + rng.normal(0, 0.1, 2), category, i if links else None)
            for i, (category, walk) in enumerate(people)
        ]
        for t in times
    ]


def straight(x: float, y: float, vx: float, vy: float) -> Walk:
    return lambda t: (x + vx * t, y + vy * t)


@pytest.mark.parametrize("fps", [2.0, 10.0, 25.0])
def test_each_is_followed_under_one_number(fps: float) -> None:
    """Two who pass each other on foot, and a bicycle that overtakes one of them."""
    people = [
        (PEDESTRIAN, straight(0, 0, 1.4, 0)),
        (PEDESTRIAN, straight(8, 1.5, -1.3, 0)),
        (BICYCLE, straight(-3, 0.2, 5.0, 0)),
    ]
    times = np.arange(0, 6, 1 / fps).tolist()
    tracks = follow_road_users(walked(people, times), times, first_number=7)
    assert [track.number for track in tracks] == [7, 8, 9]
    assert sorted(track.category for track in tracks) == ["bicycle", "pedestrian", "pedestrian"]
    for category, walk in people:
        own = [t for t in tracks if t.category == schema.CATEGORY_NAMES[category - 1]]
        errors = [np.abs(t.position[:, :2] - [walk(time) for time in t.times_s]).max() for t in own]
        (best,) = [t for t, error in zip(own, errors, strict=True) if error == min(errors)]
        assert len(best.frames) == len(times)
        assert min(errors) < 0.35
        expected = np.linalg.norm(np.subtract(walk(1.0), walk(0.0)))
        assert np.median(best.speed) == pytest.approx(expected, abs=0.15)
        turn = math.atan2(*np.subtract(walk(1.0), walk(0.0))[::-1])
        known = best.heading[np.isfinite(best.heading)]
        assert len(known) > 0.8 * len(times)
        assert np.abs((known - turn + math.pi) % (2 * math.pi) - math.pi).max() < 0.5


def test_sigmas_are_as_large_as_errors() -> None:
    errors: list[float] = []
    sigmas: list[float] = []
    times = np.arange(0, 4, 0.1).tolist()
    for seed in range(20):
        walk = straight(0, 0, 1.2, 0.4)
        (track,) = follow_road_users(walked([(PEDESTRIAN, walk)], times, seed=seed), times)
        errors += np.linalg.norm(track.position[:, :2] - [walk(t) for t in times], axis=1).tolist()
        sigmas += track.position_sigma.tolist()
    # Two directions, each about as certain as the worst one.
    assert np.sqrt(np.mean(np.square(errors)) / 2) == pytest.approx(np.sqrt(np.mean(np.square(sigmas))), rel=0.35)


def test_the_height_of_a_road_user_is_one_error_of_its_whole_track() -> None:
    """0.1 m of height for pedestrians and 0.06 m for cyclists, seen from 5 m over (0, 0): along the line of sight."""
    times = np.arange(0, 4, 0.1).tolist()
    both = [(PEDESTRIAN, straight(20, 0, 0, 0)), (BICYCLE, straight(20, 9, 0, 0))]
    for track in follow_road_users(walked(both, times), times):
        body = of_body(track, np.array([0.0, 0.0, 5.0]))
        height_sigma_m = 0.1 if track.category == "pedestrian" else 0.06
        # A cyclist's body is up to half a wheelbase behind the foot of its box.
        slack = 1e-6 if track.category == "pedestrian" else height_sigma_m * 0.7 / 5
        assert body.body_error == pytest.approx(track.xy * height_sigma_m / 5, abs=slack)
        assert np.array_equal(body.covariance, track.covariance)


@pytest.mark.parametrize(("velocity", "shift"), [((5.0, 0.0), 0.6), ((0.0, 5.0), 0.0), ((-5.0, 0.0), 0.6)])
def test_a_two_wheeler_is_half_a_wheelbase_behind_its_nearer_wheel(velocity: tuple[float, float], shift: float) -> None:
    times = np.arange(0, 1, 0.1).tolist()
    (track,) = follow_road_users(walked([(MOTORCYCLE, straight(200, 0, *velocity))], times), times)
    moved = of_body(track, np.array([0.0, 0.0, 8.0])).position - track.position
    known = np.isfinite(track.heading)
    assert known.sum() > 3
    assert moved[known, 0] == pytest.approx(shift, abs=0.1), "headings are known to 0.1"
    assert np.abs(moved[:, 1]).max() < 0.05


def test_who_stands_has_no_heading() -> None:
    times = np.arange(0, 4, 0.1).tolist()
    (track,) = follow_road_users(walked([(PEDESTRIAN, straight(3, 4, 0, 0))], times), times)
    assert np.isnan(track.heading).mean() > 0.95
    assert track.speed.max() < 0.5


def test_an_object_that_is_taken_for_a_bicycle_never_moved() -> None:
    """It stays in its place in the image; a cyclist who waits for as long and then rides moves there."""
    times = (np.arange(120) / 10).tolist()
    rng = np.random.default_rng(2)
    images = []
    for k in range(len(times)):
        ridden = 0.4 * max(0, k - 80)
        stands, rides = sight(np.array([0.0, 0.0]), BICYCLE), sight(np.array([9.0 + ridden, 0.0]), BICYCLE)
        images.append(
            [
                replace(one, bbox=np.array([x, 50.0, 20.0, 40.0]) + rng.normal(0, 0.5, 4))
                for one, x in ((stands, 100.0), (rides, 200.0 + 8 * ridden))
            ]
        )
    assert [one.flags for one in follow_road_users(images, times)] == [("never_moved",), ()]


def test_who_is_gone_for_long_comes_back_as_somebody_else_and_for_short_does_not() -> None:
    times = np.arange(0, 6, 0.1).tolist()
    for gap, count in ((0.8, 1), (2.0, 2)):
        images = walked([(PEDESTRIAN, straight(0, 0, 1.0, 0))], times)
        images = [[] if 2 < t < 2 + gap else image for t, image in zip(times, images, strict=True)]
        tracks = follow_road_users(images, times)
        assert len(tracks) == count
        if count == 1:
            assert not tracks[0].detected.all()
            assert (tracks[0].detected == tracks[0].located).all()
            assert np.abs(tracks[0].position[:, 0] - times).max() < 0.35


def test_numbers_that_sights_share_go_before_places() -> None:
    """Two who swap places between two frames, as nobody does: only their numbers tell."""
    times = np.arange(0, 4, 0.5).tolist()
    places = [np.array([0.0, 0.0]), np.array([0.6, 0.0])]
    images = [[sight(places[k % 2], PEDESTRIAN, 5), sight(places[1 - k % 2], PEDESTRIAN, 6)] for k in range(len(times))]
    one, other = follow_road_users(images, times)
    assert min(np.ptp(track.position[:, 0]) for track in (one, other)) > 0.4
    without = [[replace(s, links=()) for s in image] for image in images]
    assert max(np.ptp(t.position[:, 0]) for t in follow_road_users(without, times)) < 0.3


@pytest.mark.parametrize("links", [True, False])
def test_who_is_taken_for_several_kinds_is_one_of_the_surest(links: bool) -> None:
    """A detector's numbers are by category, so that none goes through all frames."""
    times = np.arange(0, 2, 0.1).tolist()
    kinds = [PEDESTRIAN if k % 3 == 0 else BICYCLE for k in range(len(times))]
    images = [[sight(np.array([1.0, 1.0]), kind, 3 if links else None)] for kind in kinds]
    (track,) = follow_road_users(images, times)
    assert track.category == "bicycle"
    assert track.located.all()


def test_a_number_that_was_mixed_up_once_stays_with_its_track() -> None:
    """Two pass each other, and in one frame are taken for one, with both numbers."""
    times = np.arange(0, 2, 0.1).tolist()
    images = [[sight(np.array([0.1 * k, 0.0]), PEDESTRIAN, 1), sight(np.array([2 - 0.1 * k, 0.5]), BICYCLE, 2)]
              for k in range(20)]  # fmt: skip
    images[10] = [replace(images[10][0], links=((PEDESTRIAN, 1), (BICYCLE, 2)))]
    one, other = follow_road_users(images, times)
    assert (one.category, other.category) == ("pedestrian", "bicycle")
    assert (one.located.sum(), other.located.sum()) == (20, 19)


def test_boxes_without_a_place_continue_a_track_and_begin_none() -> None:
    times = np.arange(0, 2, 0.1).tolist()
    place = np.array([1.0, 1.0])
    images = [
        [sight(place, MOTORCYCLE, 3, known=k % 5 == 0), sight(place, MOTORCYCLE, 4, known=False)] for k in range(20)
    ]
    (track,) = follow_road_users(images, times)
    assert track.located.tolist() == [k % 5 == 0 for k in range(16)], "to the last place"
    assert track.detected.all()


def test_one_or_two_sights_are_nobody() -> None:
    assert follow_road_users([[sight(np.zeros(2), PEDESTRIAN)], [sight(np.zeros(2), PEDESTRIAN)]], [0.0, 1.0]) == []
    assert follow_road_users([], []) == []
    times = np.arange(0, 0.3, 0.05).tolist()
    assert follow_road_users(walked([(PEDESTRIAN, straight(0, 0, 0, 0))], times), times) == [], "too short"


def test_a_long_track_is_the_same_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    times = np.arange(0, 30, 0.2).tolist()
    people = [(PEDESTRIAN, lambda t: (10 * math.cos(0.1 * t), 10 * math.sin(0.1 * t)))]
    (whole,) = follow_road_users(walked(people, times), times)
    monkeypatch.setattr("skope.tracking.pedestrian_and_cycle_tracks.FOOT_TRACKS", replace(FOOT_TRACKS, lag_s=8.0))
    (parts,) = follow_road_users(walked(people, times), times)
    assert parts.position == pytest.approx(whole.position, abs=0.02)
    assert parts.speed_sigma == pytest.approx(whole.speed_sigma, abs=0.02)
    assert np.array_equal(parts.frames, whole.frames)


# -------------------------------------------------------------------------------------------------------------- files


def box_at(camera: Camera, place: np.ndarray, size: tuple[float, float]) -> np.ndarray:
    """x, y, width, height of somebody of a size (width, height), metres, who stands at a place."""
    side = np.array([math.sin(camera.angles[0]), -math.cos(camera.angles[0])]) * size[0] / 2
    corners = [[*(place + k * side), z] for k, z in itertools.product((-1, 1), (0.0, size[1]))]
    foot, _, _ = camera.project(np.array([*place, 0.0]))
    pixels, _, _ = camera.project(np.array(corners))
    half = np.ptp(pixels[:, 0]) / 2
    top = pixels[:, 1].min()
    return np.array([foot[0] - half, top, 2 * half, foot[1] - top])


def street(seconds: float = 3.0, fps: float = 10.0) -> AnnotationFile:
    """A sedan, somebody who crosses on foot, and a bicycle."""
    file = drive(seconds, fps, speeds=(8.0,))
    users = []
    for image, (name, walk, size) in itertools.product(
        file.images,
        (
            ("pedestrian", straight(14, -4, 0.2, 1.4), (0.6, 1.75)),
            ("bicycle", straight(18, 3, 0.0, -4.0), (1.6, 1.7)),
        ),
    ):
        assert image.time_s is not None
        place = on_road(*walk(image.time_s))
        number = 1000 + len(users)
        box = tuple(box_at(CAMERA, place, size).tolist())
        users.append(replace(make_road_user(number, image.id, box, name), track_id=50 + len(users) % 2))
    return replace(file, road_users=tuple(users), categories=schema.CATEGORY_NAMES)


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


def test_labels_are_followed_beside_vehicles_whose_files_stay_what_they_are(skope: Any) -> None:
    file = street()
    coco.write(Path("road.json"), file)
    coco.write(Path("plain/road.json"), replace(file, road_users=(), categories=("vehicle",)))
    code, said, error = skope(
        "eval", "track", "--annotations", "road.json", "--noise", 1, "--out", "t", "--video", "-q"
    )
    assert code == 0, error
    assert "also: 1 bicycle, 1 pedestrian" in said
    plain = ("--annotations", "plain/road.json", "--noise", 1, "--out", "plain/t", "-q")
    assert skope("eval", "track", *plain)[0] == 0
    ours, theirs = files_of(Path("t")), files_of(Path("plain/t"))
    for name in ("mot.txt", "mot_truth.txt"):
        assert ours[name] == theirs[name]
    assert ours["tracks.csv"].startswith(theirs["tracks.csv"])
    assert not any("pedestrian" in name for name in theirs)
    rows = rows_of(Path("t/tracks.csv"))
    vehicles = {row["track"] for row in rows if row["category"] == "vehicle"}
    rows = [row for row in rows if row["category"] != "vehicle"]
    assert {row["category"] for row in rows} == {"bicycle", "pedestrian"}
    assert vehicles.isdisjoint(row["track"] for row in rows)
    for category, walk in (("pedestrian", straight(14, -4, 0.2, 1.4)), ("bicycle", straight(18, 3, 0, -4.0))):
        own = [row for row in rows if row["category"] == category]
        assert len({row["track"] for row in own}) == 1
        for row in own:
            at = [float(row["x"]), float(row["y"])]
            assert at == pytest.approx(on_road(*walk(float(row["time_s"]))), abs=0.3)
        truth = np.loadtxt(f"t/mot_truth_{category}.txt", delimiter=",")
        found = np.loadtxt(f"t/mot_{category}.txt", delimiter=",")
        assert found.shape[1] == 10
        assert len(truth) == 30
        assert found[:, 2:6] == pytest.approx(truth[:, 2:6], abs=0.01)
    steps = list(sumolib.xml.parse("t/fcd.xml", ["timestep"]))
    (person,), kinds = steps[10].person, {vehicle.type for vehicle in steps[10].vehicle}
    assert kinds == {"passenger", "bicycle"}
    assert person.type == "pedestrian"
    row = next(r for r in rows if r["track"] == person.id and r["frame"] == "10")
    assert (person.x, person.y) == (row["x"], row["y"])
    assert float(person.angle) == pytest.approx((90 - float(row["heading_deg"])) % 360, abs=0.02)


def test_results_of_other_road_users_are_followed(skope: Any) -> None:
    """Above the score; ones that were followed between key frames measure nothing; sigmas are those of their pixels."""
    file = street()
    found = [
        RoadUserResult(
            image_id=u.image_id,
            bbox=u.bbox,
            score=0.9 if u.category == "pedestrian" else 0.3,
            category_id=u.category_id,
            interpolated=u.image_id % 5 != 0,
            track_id=u.track_id,
        )
        for u in file.road_users
    ]
    coco.write(Path("road.json"), replace(file, annotations=(), road_users=()))
    coco.write_results(Path("found.json"), found)
    call = ("--annotations", "road.json", "--predictions", "found.json")
    code, said, error = skope("eval", "track", *call, "--out", "t", "-q")
    assert code == 0, error
    assert "also: 1 pedestrian" in said
    rows = rows_of(Path("t/tracks.csv"))
    assert {row["category"] for row in rows} == {"pedestrian"}
    assert {row["detected"] for row in rows} == {"1"}
    assert sum(row["located"] == "1" for row in rows) == 6
    assert all(0.05**2 < float(row["sigma_xx"]) < 4 for row in rows)
    assert {row["length"] for row in rows} == {""}
    code, said, _ = skope("eval", "track", *call, "--ground", "none", "--out", "u", "-q")
    assert code == 0
    assert "bicycle, motorcycle, pedestrian: no tracks, because the height of the road is unknown" in said


def test_a_box_that_the_images_edge_cuts_says_nothing_of_the_feet(tmp_path: Path) -> None:
    file = street(0.5)
    low = [replace(u, bbox=np.array([900.0, 700, 60, 380])) for u in file.road_users]
    coco.write(tmp_path / "road.json", replace(file, road_users=tuple(low)))
    scene = read_scene(None, tmp_path / "road.json", None, None, 0.0)
    sights = [one for image in ground_detections(scene, score=0.5, sigma_px=None) for one in image]
    assert len(sights) == len(file.road_users)
    assert all(one.point is None for one in sights)


def test_boxes_of_one_rider_are_one_sight_and_two_abreast_are_two(tmp_path: Path) -> None:
    file = street(0.5)
    image = file.images[0].id
    boxes = {BICYCLE: (500, 500, 40, 90), MOTORCYCLE: (497, 512, 46, 82), PEDESTRIAN: (508, 498, 24, 84)}
    beside = (532, 503, 26, 88)
    found = [
        RoadUserResult(image_id=image, score=score, bbox=np.array(box), track_id=number, category_id=kind)
        for kind, box, score, number in (
            *((kind, box, 0.5 + 0.1 * kind, kind) for kind, box in boxes.items()),
            (PEDESTRIAN, beside, 0.95, 9),
        )
    ]
    coco.write(tmp_path / "road.json", replace(file, road_users=()))
    scene = replace(read_scene(None, tmp_path / "road.json", None, None, 0.0), road_users=found)
    first, second = sorted(ground_detections(scene, score=0.5, sigma_px=None)[0], key=lambda sight: len(sight.links))
    assert first.links == ((PEDESTRIAN, 9),)
    assert set(second.links) == {(kind, kind) for kind in boxes}
    assert second.category_id == PEDESTRIAN, "the surest box"
    assert second.scores == pytest.approx({kind: 0.5 + 0.1 * kind for kind in boxes})


def test_ignored_ones_are_not_followed(tmp_path: Path) -> None:
    file = street(0.5)
    coco.write(tmp_path / "a.json", replace(file, road_users=tuple(replace(u, iscrowd=1) for u in file.road_users)))
    scene = read_scene(None, tmp_path / "a.json", None, None, 0.0)
    assert not any(ground_detections(scene, score=0.5, sigma_px=None))


def test_places_go_by_the_road_of_their_image(tmp_path: Path) -> None:
    coco.write(tmp_path / "street.json", street())
    scene = read_scene(None, tmp_path / "street.json", None, None, 0.0)
    first = scene.file.images[0].id
    lower, unknown = (
        ground_detections(replace(scene, roads={first: road}), score=0.5, sigma_px=None)
        for road in (Ground(height=-1.0), None)
    )
    usual = ground_detections(scene, score=0.5, sigma_px=None)
    assert any(sight.point for sight in usual[0])
    assert {sight.point.height for sight in lower[0] if sight.point} == {-1.0}
    assert not any(sight.point for sight in unknown[0])
    assert [sight.point.height for sight in lower[1] if sight.point] == [s.point.height for s in usual[1] if s.point]


def test_pictures_with_others_in_them_differ(tmp_path: Path) -> None:
    from skope.tracking import birdseye, birdseye_video

    times = np.arange(0, 2, 0.1).tolist()
    people = [(PEDESTRIAN, lambda t: tuple(on_road(12 + t, 1)))]
    tracks: list[Track] = follow_road_users(walked(people, times), times)
    pictures = []
    for shown in (tracks, []):
        path = tmp_path / f"{len(shown)}.png"
        birdseye.draw(path, [], CAMERA, Ground(), None, shown)
        pictures.append(path.read_bytes())
    assert pictures[0] != pictures[1]
    above = next(birdseye_video.birdseye_frames([], times, CAMERA, None, None, tracks))
    bare = next(birdseye_video.birdseye_frames([], times, CAMERA, None, None, []))
    assert above.shape != bare.shape or (above != bare).any()


def test_a_number_that_jumps_from_one_to_another_does_not_take_the_track_along() -> None:
    """As a detector's numbers do where two meet: half a street away is not the same person."""
    times = np.arange(0, 4, 0.1).tolist()
    people = [(PEDESTRIAN, straight(0, 0, 1.3, 0)), (PEDESTRIAN, straight(10, 6, -1.3, 0))]
    images = walked(people, times, links=True)
    for k, image in enumerate(images):
        if k >= 20:
            images[k] = [replace(one, links=other.links) for one, other in zip(image, image[::-1], strict=True)]
    tracks = follow_road_users(images, times)
    assert len(tracks) == 2
    assert max(track.speed.max() for track in tracks) < 3.0


@pytest.mark.parametrize(("speed", "category"), [(1.4, "pedestrian"), (3.0, "pedestrian"), (6.5, "bicycle")])
def test_who_is_too_fast_for_walking_is_on_wheels(speed: float, category: str) -> None:
    times = np.arange(0, 3, 0.1).tolist()
    (track,) = follow_road_users(walked([(PEDESTRIAN, straight(0, 0, speed, 0))], times), times)
    assert track.category == category
