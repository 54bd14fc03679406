"""Vehicles between key frames: drawn ones, whose places are known in every frame."""

from collections.abc import Callable, Iterator, Sequence

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from skope import boxes
from skope.footage.key_frames import ImageWithPixels
from skope.footage.key_frames import with_frames_between as with_frames_between_keys
from skope.schema import AnyResult, Image, Result, RoadUserResult

SIZE = (320, 200)
CAR = (48, 32)
Place = Callable[[int], tuple[float, float]]


def with_frames_between(
    frames: Iterator[ImageWithPixels],
    find: Callable[[ImageWithPixels], list[AnyResult]],
    every: int,
    known: Sequence[int] = (),
) -> Iterator[tuple[Image, list[AnyResult], bool]]:
    """Find the vehicles of one key frame at a time."""
    return with_frames_between_keys(frames, lambda keys: ((key[0], find(key)) for key in keys), every, known)


def texture(seed: int, width: int, height: int) -> NDArray[np.uint8]:
    """Coarse and fine patches, as cars and roads have them."""
    rng = np.random.default_rng(seed)
    grains = [rng.integers(0, 128, (height // grain, width // grain, 3), dtype=np.uint8) for grain in (16, 4)]
    coarse, fine = (cv2.resize(one, (width, height), interpolation=cv2.INTER_LINEAR) for one in grains)
    return coarse + fine


def drawn(count: int, cars: Sequence[Place]) -> list[tuple[Image, NDArray[np.uint8]]]:
    """Frames of textured cars that move before a textured ground, to fractions of a pixel."""
    ground = texture(0, *SIZE)
    frames = []
    for k in range(count):
        pixels = ground.copy()
        for seed, car in enumerate(cars, start=1):
            shift = np.float32([[1, 0, car(k)[0]], [0, 1, car(k)[1]]])
            here = cv2.warpAffine(np.full(CAR[::-1], 255, np.uint8), shift, SIZE) > 127
            pixels[here] = cv2.warpAffine(texture(seed, *CAR), shift, SIZE)[here]
        frames.append((Image(id=k + 1, file_name=f"{k}.png", width=SIZE[0], height=SIZE[1]), pixels))
    return frames


def vehicle(image_id: int, at: tuple[float, float], score: float = 0.9) -> Result:
    """A car's label: its box inside the image, and keypoints that it takes along."""
    points = np.random.default_rng(7).random((33, 2)) * CAR + at
    low, high = np.clip(at, 0, SIZE), np.clip(np.add(at, CAR), 0, SIZE)
    keypoints = np.column_stack([points, np.ones(33)])
    return Result(image_id=image_id, score=score, bbox=np.concatenate([low, high - low]), keypoints=keypoints)


def between(
    cars: Sequence[Place], count: int, every: int, hidden: Sequence[tuple[int, int]] = ()
) -> list[list[Result]]:
    """What there is in each frame; the detector finds each car in its place but for `hidden` pairs of car and frame."""

    def find(frame: tuple[Image, NDArray[np.uint8]]) -> list[Result]:
        k = frame[0].id - 1
        inside = [i for i, car in enumerate(cars) if -CAR[0] + 4 < car(k)[0] < SIZE[0] - 4 and (i, k) not in hidden]
        return [vehicle(frame[0].id, cars[i](k)) for i in inside]

    out = list(with_frames_between(iter(drawn(count, cars)), find, every))
    assert [image.id for image, _, _ in out] == list(range(1, count + 1))
    assert [key for _, _, key in out] == [k % every == 0 or k == count - 1 for k in range(count)]
    for _, found, key in out:
        assert all(result.interpolated == (not key) for result in found)
    return [found for _, found, _ in out]


def speeding_up(k: int) -> tuple[float, float]:
    return 10 + 3.0 * k + 0.4 * k * k, 60 + 1.5 * k


def test_a_vehicle_is_followed_where_it_speeds_up_and_not_along_a_straight_line() -> None:
    found = between([speeding_up, lambda k: (200.0, 20.0)], 12, 5)
    for k, here in enumerate(found):
        assert len(here) == 2
        for result, at in zip(here, (speeding_up(k), (200.0, 20.0)), strict=True):
            expected = vehicle(k + 1, at)
            assert result.bbox == pytest.approx(expected.bbox, abs=0.7)
            assert result.keypoints == pytest.approx(expected.keypoints, abs=0.7)
    straight = np.mean([speeding_up(0), speeding_up(5)], axis=0) - speeding_up(2)
    assert np.abs(straight).max() > 2


def test_what_drives_in_or_out_is_followed_to_the_edge() -> None:
    found = between([lambda k: (290.0 - 12 * k, 30.0), lambda k: (-10.0 - 9 * (5 - k), 120.0)], 11, 5)
    entering = [[r for r in here if r.bbox[1] > 100] for here in found]
    for k in (3, 4):
        (here,) = entering[k]
        assert here.bbox == pytest.approx(vehicle(k + 1, (-10.0 - 9 * (5 - k), 120)).bbox, abs=1.0)
    leaving = [[r for r in here if r.bbox[1] < 100] for here in found]
    assert [len(here) for here in entering[5:]] == [1] * 6
    assert [len(here) for here in leaving[:2]] == [1, 1]


def test_what_one_key_frame_shows_alone_is_followed_until_the_other_one() -> None:
    found = between([lambda k: (100.0 + 2 * k, 50.0)], 13, 6, hidden=[(0, 6)])
    assert [len(here) for here in found] == [1] * 6 + [0] + [1] * 6
    for k in (5, 7):
        both = np.array([found[k][0].bbox, vehicle(k + 1, (100.0 + 2 * k, 50)).bbox])
        assert boxes.iou(*np.split(boxes.xywh_to_xyxy(both), 2)) > 0.93


def test_what_another_vehicle_hides_is_followed_no_farther() -> None:
    """A car that drives before another one, which the second key frame does not show."""
    found = between([lambda k: (150.0, 50.0), lambda k: (75.0 + 20 * k, 50.0)], 7, 6, hidden=[(0, 6)])
    behind = [[result for result in here if abs(result.bbox[0] - 150) < 3] for here in found]
    assert [len(behind[k]) for k in (0, 1, 5, 6)] == [1, 1, 0, 0]


def test_scores_pass_from_one_to_the_next() -> None:
    frames = drawn(5, [lambda k: (100.0, 50.0)])
    scores = {1: 0.9, 5: 0.5}
    out = with_frames_between(iter(frames), lambda frame: [vehicle(frame[0].id, (100, 50), scores[frame[0].id])], 4)
    assert [here[0].score for _, here, _ in out] == pytest.approx([0.9, 0.8, 0.7, 0.6, 0.5])


def test_videos_without_vehicles_or_of_one_frame() -> None:
    assert between([], 7, 3) == [[]] * 7
    assert list(with_frames_between(iter([]), lambda _: [], 4)) == []
    assert len(between([lambda k: (50.0, 50.0)], 1, 4)[0]) == 1


def test_a_vehicle_keeps_its_name_and_gives_it_to_nobody_else() -> None:
    """Also where a key frame misses one that both others show: it is another one then, which tracks mend."""
    found = between([speeding_up, lambda k: (200.0, 20.0)], 12, 5)
    assert {tuple(sorted(one.track_id or 0 for one in here)) for here in found} == {(1, 2)}
    for k, here in enumerate(found):
        moving = min(here, key=lambda one: abs(one.bbox[1] - speeding_up(k)[1]))
        assert moving.track_id == 1
    missed = between([lambda k: (40.0, 40.0)], 11, 5, hidden=[(0, 5)])
    assert {one.track_id for here in missed for one in here} == {1, 2}


def test_a_run_that_goes_on_keeps_the_names() -> None:
    def find(frame: tuple[Image, NDArray[np.uint8]]) -> list[Result]:
        return [vehicle(frame[0].id, (30.0 + 2 * frame[0].id, 50.0)), vehicle(frame[0].id, (200.0, 20.0))]

    frames = drawn(11, [lambda k: (32.0 + 2 * k, 50.0), lambda k: (200.0, 20.0)])
    whole = [[one.track_id for one in found] for _, found, _ in with_frames_between(iter(frames), find, 5)]
    later = [
        [one.track_id for one in found] for _, found, _ in with_frames_between(iter(frames[5:]), find, 5, whole[5])
    ]
    assert later == whole[5:]


def walker(image_id: int, at: tuple[float, float], category: int = 4) -> RoadUserResult:
    """Somebody as large as the drawn cars: a road user has no keypoints to follow."""
    low, high = np.clip(at, 0, SIZE), np.clip(np.add(at, CAR), 0, SIZE)
    box = np.concatenate([low, high - low])
    return RoadUserResult(image_id=image_id, score=0.8, bbox=box, category_id=category)


def test_road_users_without_keypoints_are_followed_beside_vehicles() -> None:
    """By points in the middle of their boxes, where they speed up too; vehicles are where they are without them."""
    places = (lambda k: (200.0, 20.0), speeding_up)

    def find(frame: tuple[Image, NDArray[np.uint8]]) -> list[AnyResult]:
        k = frame[0].id - 1
        return [vehicle(k + 1, places[0](k)), walker(k + 1, places[1](k))]

    frames = drawn(12, places)
    both = list(with_frames_between(iter(frames), find, 5))
    alone = list(with_frames_between(iter(frames), lambda frame: find(frame)[:1], 5))
    names = set()
    for k, ((image, (car, person), key), (_, (lonely,), _)) in enumerate(zip(both, alone, strict=True)):
        assert np.array_equal(car.bbox, lonely.bbox)
        assert np.array_equal(car.keypoints, lonely.keypoints)
        assert isinstance(person, RoadUserResult)
        assert (person.image_id, person.category_id, person.interpolated) == (image.id, 4, not key)
        assert person.bbox == pytest.approx(walker(k + 1, speeding_up(k)).bbox, abs=1.5)
        names.add((car.track_id, person.track_id))
    ((car_name, person_name),) = names
    assert car_name != person_name


def test_nobody_becomes_another_kind_between_key_frames() -> None:
    """A bicycle in the place of a pedestrian of the frame before is somebody else."""

    def find(frame: tuple[Image, NDArray[np.uint8]]) -> list[AnyResult]:
        return [walker(frame[0].id, (100.0, 50.0), 4 if frame[0].id == 1 else 2)]

    out = list(with_frames_between(iter(drawn(4, [lambda k: (100.0, 50.0)])), find, 3))
    numbers = {(one.category_id, one.track_id) for _, found, _ in out for one in found}
    assert len(numbers) == 2
    assert len({track for _, track in numbers}) == 2
