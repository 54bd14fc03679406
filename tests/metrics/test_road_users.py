"""Figures of people on foot and on two wheels: those of pycocotools on the files, and of plain loops."""

import contextlib
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from skope.dataset import coco
from skope.metrics.breakdown import FleetInfo
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.metrics.road_users import category_figures
from skope.metrics.split_scores import split_metrics
from skope.schema import CATEGORY_NAMES, AnnotationFile, Result, RoadUser, RoadUserResult
from tests.metrics import brute
from tests.samples import make_annotation, make_image, make_road_user

SIZES = {"all": (0, 1e10), "small": (0, 32**2), "medium": (32**2, 96**2), "large": (96**2, 1e10)}


def found(user: RoadUser, score: float, *, shift: Sequence[float] = (0, 0, 0, 0), category: int = 0) -> RoadUserResult:
    return RoadUserResult(
        image_id=user.image_id, score=score, bbox=user.bbox + shift, category_id=category or user.category_id
    )


def random_split(seed: int) -> tuple[AnnotationFile, list[RoadUserResult]]:
    """Four crowded images; some road users are ignored, some results off, doubled or of another category."""
    rng = np.random.default_rng(seed)
    images = tuple(make_image(i, 640, 480) for i in range(1, 5))
    users: list[RoadUser] = []
    results: list[RoadUserResult] = []
    for image in images[:-1]:  # the last one is empty
        for _ in range(12):
            category = CATEGORY_NAMES[int(rng.integers(1, 4))]
            side = float(rng.choice([12.0, 28.0, 60.0, 130.0]))
            x, y = rng.integers(0, 480, 2).tolist()
            box = (float(x), float(y), side, float(rng.choice([1.0, 1.5])) * side)
            users.append(make_road_user(len(users) + 1, image.id, box, category, iscrowd=int(rng.random() < 0.2)))
            for _ in range(int(rng.integers(0, 3))):
                shift = rng.choice([0.0, 0.05, 0.15, 0.4], 4) * side
                other = int(rng.integers(2, 5)) if rng.random() < 0.15 else 0
                # Scores that lie apart: of equal ones pycocotools prefers those that stand first in an image's list.
                results.append(found(users[-1], float(rng.random()), shift=shift, category=other))
    vehicle = make_annotation(900, 1, (0.0, 0.0, 300.0, 300.0))
    file = AnnotationFile(images=images, annotations=(vehicle,), road_users=tuple(users), categories=CATEGORY_NAMES)
    return file, results


@pytest.mark.parametrize("seed", range(3))
def test_ap_is_that_of_pycocotools_on_the_files(seed: int, tmp_path: Path) -> None:
    file, results = random_split(seed)
    coco.write(tmp_path / "truth.json", file)
    coco.write_results(tmp_path / "found.json", results)
    file, results = coco.read(tmp_path / "truth.json"), list(coco.read_road_user_results(tmp_path / "found.json"))
    figures = category_figures(file, results, score=0.5)
    assert list(figures) == ["bicycle", "motorcycle", "pedestrian"]
    for name, by_size in figures.items():
        with contextlib.redirect_stdout(io.StringIO()):
            truth = COCO(str(tmp_path / "truth.json"))
            evaluation = COCOeval(truth, truth.loadRes(str(tmp_path / "found.json")), "bbox")
            evaluation.params.catIds = [CATEGORY_NAMES.index(name) + 1]
            evaluation.evaluate()
            evaluation.accumulate()
            evaluation.summarize()
        ap, ap50, _, *of_sizes = [None if value < 0 else value for value in evaluation.stats[:6]]
        assert (by_size["all"]["ap"], by_size["all"]["ap50"]) == (pytest.approx(ap), pytest.approx(ap50))
        assert [by_size[size]["ap"] for size in ("small", "medium", "large")] == [
            value if value is None else pytest.approx(value) for value in of_sizes
        ]
        assert any(0 < figures["ap"] < 1 for figures in by_size.values() if figures["ap"])


def counted(file: AnnotationFile, results: list[RoadUserResult], name: str, low: float, high: float) -> dict[str, int]:
    """Plain loops: who is in the range of areas, what is found of them, and what is found besides."""
    out = {"ground_truth": 0, "detections": 0, "matched": 0}
    for image in file.images:
        truth = [u for u in file.road_users if u.image_id == image.id and u.category == name]
        known = [u for u in truth if not u.ignored]
        out["ground_truth"] += sum(low <= u.area <= high for u in known)
        own = [r for r in results if r.image_id == image.id and r.category == name and r.score > 0.5]
        free = {u.id: u for u in known}
        for r in sorted(own, key=lambda r: -r.score):
            box = tuple(r.bbox.tolist())

            # Those of the range are asked first.
            def best(users: list[RoadUser], box: tuple[float, ...] = box) -> RoadUser | None:
                users = [u for u in users if brute.iou(box, tuple(u.bbox.tolist())) >= 0.5]
                return max(users, key=lambda u: brute.iou(box, tuple(u.bbox.tolist())), default=None)

            inside = best([u for u in free.values() if low <= u.area <= high])
            if inside is not None:
                del free[inside.id]
                out["detections"] += 1
                out["matched"] += 1
                continue
            beside = best([u for u in free.values() if not low <= u.area <= high])
            on_ignored = any(
                brute.overlap(box, tuple(u.bbox.tolist())) >= 0.5 * box[2] * box[3] for u in truth if u.ignored
            )
            if beside is not None and not on_ignored:
                del free[beside.id]
            elif not on_ignored and low <= box[2] * box[3] <= high:
                out["detections"] += 1
    return out


@pytest.mark.parametrize("seed", range(8))
def test_precision_and_recall_are_those_of_plain_loops(seed: int) -> None:
    file, results = random_split(seed)
    figures = category_figures(file, results, score=0.5)
    for name, by_size in figures.items():
        for size, (low, high) in SIZES.items():
            expected = counted(file, results, name, low, high)
            got = by_size[size]
            assert {key: got[key] for key in expected} == expected, (name, size)
            for ratio, below in (("precision", "detections"), ("recall", "ground_truth")):
                wanted = expected["matched"] / expected[below] if expected[below] else None
                assert got[ratio] == (wanted if wanted is None else pytest.approx(wanted))


def test_by_hand() -> None:
    """Two pedestrians, one found; a false one; one on an ignored pedestrian; a bicycle in a pedestrian's place."""
    users = (
        make_road_user(1, 1, (10, 10, 20, 40), "pedestrian"),
        make_road_user(2, 1, (60, 10, 20, 40), "pedestrian"),
        make_road_user(3, 1, (110, 10, 40, 40), "pedestrian", iscrowd=1),
    )
    file = AnnotationFile(images=(make_image(1),), annotations=(), road_users=users, categories=CATEGORY_NAMES)
    results = [
        found(users[0], 0.9),
        found(users[2], 0.8, shift=(0, 0, -20, 0)),
        found(users[1], 0.8, shift=(0, 60, 0, 0)),
        found(users[1], 0.99, category=2),
        found(users[1], 0.3),
    ]
    all_sizes = {name: by_size["all"] for name, by_size in category_figures(file, results, score=0.5).items()}
    person = all_sizes["pedestrian"]
    assert {key: person[key] for key in ("ground_truth", "ignored", "detections", "matched")} == {
        "ground_truth": 2, "ignored": 1, "detections": 2, "matched": 1
    }  # fmt: skip
    assert (person["precision"], person["recall"]) == (0.5, 0.5)
    bicycle = all_sizes["bicycle"]
    assert (bicycle["precision"], bicycle["recall"], bicycle["ap"]) == (0.0, None, None)
    motorcycle = all_sizes["motorcycle"]
    assert (motorcycle["detections"], motorcycle["precision"], motorcycle["recall"]) == (0, None, None)
    assert category_figures(file, results, score=0.5, all_scores=False)["pedestrian"]["all"]["ap"] is None


def test_figures_are_those_of_categories_that_truth_and_detector_have() -> None:
    file, results = random_split(0)
    assert list(category_figures(file, results, score=0.5, known=("vehicle", "pedestrian"))) == ["pedestrian"]
    assert category_figures(replace(file, road_users=(), categories=("vehicle",)), results, score=0.5) == {}


def test_vehicles_are_measured_as_if_there_were_nobody_else() -> None:
    file, results = random_split(1)
    (vehicle,) = file.annotations
    cars = [Result(image_id=1, score=0.95, bbox=vehicle.bbox, keypoints=vehicle.keypoints)]
    alone = replace(file, road_users=(), categories=("vehicle",))

    def entry(of: AnnotationFile, **more: Any) -> dict[str, Any]:
        return split_metrics(of, cars, MetricOptions(), FleetInfo(), **more).entry

    with_others = entry(file, road_users=results, known=CATEGORY_NAMES)
    assert set(with_others.pop("categories")) == set(CATEGORY_NAMES[1:])
    assert with_others == entry(alone) == entry(file)
