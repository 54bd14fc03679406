"""Parts, failures, confidence, localisation and intervals against plain loops over the same random cases."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import scipy.stats

from skope import keypoints
from skope.metrics import failures, intervals, score_reliability
from skope.metrics.breakdown import FleetInfo, breakdown
from skope.metrics.keypoint_outcomes import MetricOptions, outcomes_at
from skope.metrics.match import match
from skope.metrics.outcome_counts import quotients, tally
from skope.metrics.pck_precision_recall import localisation, match_split, score_split
from skope.schema import AnnotationFile, Image, Result
from tests.metrics import brute
from tests.metrics.cases import as_records, random_case
from tests.samples import make_annotation

OPTIONS = MetricOptions(score=0.5, alpha=0.15, labelled="all", keypoint_score=0.2)
T = 0.6


def pairs_of(
    images: list[int], vehicles: list[brute.Vehicle], detections: list[brute.Detection]
) -> list[tuple[brute.Vehicle | None, brute.Detection | None, bool]]:
    """Every vehicle and detection that counts, once: together where matched; whether a detection is left out."""
    out: list[tuple[brute.Vehicle | None, brute.Detection | None, bool]] = []
    for image in images:
        truth = [v for v in vehicles if v["image"] == image and not v["ignored"]]
        ignored = [v for v in vehicles if v["image"] == image and v["ignored"]]
        here = sorted(
            (d for d in detections if d["image"] == image and d["score"] > OPTIONS.score), key=lambda d: -d["score"]
        )
        taken = brute.assign(truth, here, T)
        out += [(v, d, v is None and brute.on_ignored(d, ignored)) for d, v in zip(here, taken, strict=True)]
        out += [(v, None, False) for v in truth if not any(v is other for other in taken)]
    return out


def cases() -> list[tuple[list[int], list[brute.Vehicle], list[brute.Detection]]]:
    return [random_case(np.random.default_rng((99, i))) for i in range(60)]


def outcomes_of_case(images: list[int], vehicles: list[Any], detections: list[Any]) -> tuple[Any, Any]:
    file, results = as_records(images, vehicles, detections)
    matches = match_split(file, results, OPTIONS)
    return matches, outcomes_at(matches, T, OPTIONS)


def wrong(vehicle: brute.Vehicle, detection: brute.Detection) -> list[int]:
    right = brute.correct_points(vehicle, detection, "all", OPTIONS.alpha, OPTIONS.keypoint_score, list(range(33)))
    return [
        k
        for k in range(33)
        if vehicle["points"][k][2] > 0 and detection["points"][k][2] > OPTIONS.keypoint_score and k not in right
    ]


def kind_of(vehicle: brute.Vehicle, detection: brute.Detection, k: int) -> str:
    name, where = keypoints.NAMES[k], detection["points"][k]
    side = name.replace("right", "LEFT").replace("left", "right").replace("LEFT", "left")
    stem = name.rsplit("_", 1)[0]
    front_and_rear = [
        *(("roof_front", "roof_rear"), ("windscreen_base", "rear_window_base"), ("wheel_front", "wheel_rear")),
        *(("headlight_outer", "taillight_outer"), ("headlight_inner", "taillight_inner")),
        *(("bumper_front", "bumper_rear"), ("hood_front", "trunk_rear")),
    ]
    other = {a: b for pair in front_and_rear for a, b in (pair, pair[::-1])}.get(stem)
    ends = [f"{other}_right", f"{other}_left"] if other else []

    def distance(names: list[str]) -> float:
        places = [vehicle["points"][keypoints.INDEX[n]] for n in names if n != name]
        return min((brute.apart(where, p) for p in places if p[2] > 0), default=float("inf"))

    near = brute.reach(vehicle, OPTIONS.alpha)
    a, b = distance([side]), distance(ends)
    if min(a, b) > near:
        return "jitter"
    return "left_right" if a <= b else "front_rear"


def test_failures_by_kind_equal_the_loops() -> None:
    seen = dict.fromkeys(("missed", "false", *failures.ERROR_KINDS), 0)
    for case in cases():
        expected = dict.fromkeys(seen, 0)
        for vehicle, detection, left_out in pairs_of(*case):
            if vehicle is None:
                expected["false"] += not left_out
            elif detection is None:
                expected["missed"] += 1
            else:
                for k in wrong(vehicle, detection):
                    expected[kind_of(vehicle, detection, k)] += 1
        matches, outcomes = outcomes_of_case(*case)
        assert failures.failure_counts(matches, outcomes, OPTIONS) == expected
        seen = {name: seen[name] + expected[name] for name in seen}
    assert min(seen.values()) > 10


def test_confidence_equals_the_loops() -> None:
    seen = 0
    for case in cases():
        claims: list[tuple[float, bool]] = []
        visible, hidden, ranked, total = [], [], [], 0
        for vehicle, detection, left_out in pairs_of(*case):
            total += brute.count_labelled(vehicle, "all", list(range(33))) if vehicle else 0
            if detection is None or left_out:
                continue
            least = OPTIONS.keypoint_score
            right = (
                brute.correct_points(vehicle, detection, "all", OPTIONS.alpha, least, list(range(33)))
                if vehicle
                else []
            )
            ranked += [(p[2], k in right) for k, p in enumerate(detection["points"]) if p[2] > least]
            if vehicle:
                for (x, y, v), (px, py, p) in zip(vehicle["points"], detection["points"], strict=True):
                    near = brute.apart((x, y), (px, py)) <= brute.reach(vehicle, OPTIONS.alpha)
                    claims.append((p, v == 2 and near))
                    (visible if v == 2 else hidden if v == 1 else []).append(p)
        ours = score_reliability.confidence(*outcomes_of_case(*case), OPTIONS)
        assert (ours["points"], ours["right"]) == (len(claims), sum(good for _, good in claims))
        wins = [1.0 if a > b else 0.5 if a == b else 0.0 for a in visible for b in hidden]
        assert ours["auc_visible"] == (pytest.approx(np.mean(wins)) if wins else None)
        error = 0.0
        for row in ours["reliability"]:
            inside = [c for c in claims if row["from"] <= c[0] < row["to"] or (row["to"] == 1 and c[0] == 1)]
            assert row["count"] == len(inside)
            assert row["right"] == pytest.approx(np.mean([good for _, good in inside]))
            error += abs(np.mean([p for p, _ in inside]) - np.mean([good for _, good in inside])) * len(inside)
        assert ours["calibration_error"] == (pytest.approx(error / len(claims)) if claims else None)
        curve = [best_precision(ranked, total, r / 100) for r in range(101)] if total else []
        assert ours["precision_at_recall"] == pytest.approx(curve)
        seen += len(wins) > 0
    assert seen > 20


def best_precision(ranked: list[tuple[float, bool]], total: int, recall: float) -> float:
    best = 0.0
    for threshold in {p for p, _ in ranked}:
        kept = [good for p, good in ranked if p >= threshold]
        if sum(kept) / total >= recall:
            best = max(best, sum(kept) / len(kept))
    return best


def test_localisation_equals_the_loops() -> None:
    for case in cases():
        errors = []
        for vehicle, detection, _ in pairs_of(*case):
            if vehicle is None or detection is None:
                continue
            length = brute.reach(vehicle, 1.0)
            for truth, found in zip(vehicle["points"], detection["points"], strict=True):
                if truth[2] > 0:
                    off = brute.apart(truth, found)
                    shown = found[2] > OPTIONS.keypoint_score
                    errors.append((0.0 if off == 0 else off / length if length else np.inf) if shown else np.inf)
        ours = localisation(outcomes_of_case(*case)[1])
        assert ours["labelled"] == len(errors)
        if not errors:
            assert ours["pck_area"] is ours["median_error"] is ours["pck_0.05"] is None
            continue
        alphas = (np.arange(4000) + 0.5) / 4000 * 0.2
        area = np.mean([np.mean(np.array(errors) <= a) for a in alphas])
        assert ours["pck_area"] == pytest.approx(area, abs=1e-3)
        median = float(np.median(errors))
        assert ours["median_error"] == (pytest.approx(median) if np.isfinite(median) else None)


# ---------------------------------------------------------------------------------------------------------- intervals


def recorded(file: AnnotationFile, sites: int) -> AnnotationFile:
    """The same images as frames of recordings: 4 s apart, spread over sites."""
    images = tuple(
        replace(image, site=f"s{i % sites}", recording=f"{i % 2}", time_s=4.0 * i)
        for i, image in enumerate(file.images)
    )
    return replace(file, images=images)


def test_what_is_left_without_a_block_is_the_evaluation_of_the_other_images() -> None:
    images, vehicles, detections = [], [], []
    for i, (these, cars, found) in enumerate(cases()[:12]):  # one split of many images
        images += [100 * i + image for image in these]
        vehicles += [{**v, "id": 1000 * i + v["id"], "image": 100 * i + v["image"]} for v in cars]
        detections += [{**d, "image": 100 * i + d["image"]} for d in found]
    file, results = as_records(images, vehicles, detections)
    file = recorded(file, sites=2)
    matches = match_split(file, results, OPTIONS)
    blocks = intervals.blocks_of(file.images)
    assert (blocks.unit, blocks.sites) == ("recording", 2)
    without = intervals.left_out(quotients(tally(matches, T, OPTIONS)), blocks)
    for block in range(blocks.count):
        kept = {image for place, image in enumerate(images) if blocks.number[place] != block}
        cars, found = ([row for row in rows if row["image"] in kept] for rows in (vehicles, detections))
        expected = brute.evaluate(
            sorted(kept), cars, found, T, "all", OPTIONS.score, OPTIONS.alpha, OPTIONS.keypoint_score
        )
        for (name, protocol), values in without.items():
            if not math.isnan(values[block]):
                value = expected[name][protocol] if protocol else expected[name]
                assert values[block] == pytest.approx(value), (name, protocol)


def frames(count: int, **fields: Any) -> list[Image]:
    return [Image(id=i + 1, file_name=f"{i}.png", width=9, height=9, **fields) for i in range(count)]


def test_what_counts_as_one_piece_of_evidence() -> None:
    timed = [replace(image, time_s=3.0 * i) for i, image in enumerate(frames(8, site="a", recording="00"))]
    blocks = intervals.blocks_of(timed)
    assert blocks.number.tolist() == [0, 0, 0, 0, 1, 1, 1, 2]
    assert (blocks.unit, blocks.to_dict()["blocks"]) == ("10 s", 3)
    two = [*timed, *(replace(image, recording="01") for image in timed)]
    assert (intervals.blocks_of(two).unit, intervals.blocks_of(two).count) == ("recording", 2)
    there = [replace(image, site=str(i % 2)) for i, image in enumerate(timed)]
    assert (intervals.blocks_of(there).unit, intervals.blocks_of(there).count) == ("recording", 2)
    many = [replace(image, site=str(i % 3)) for i, image in enumerate(two)]
    assert (intervals.blocks_of(many).unit, intervals.blocks_of(many).count) == ("site", 3)
    plain = intervals.blocks_of(frames(4))
    assert (plain.unit, plain.count, plain.sites) == ("image", 4, None)
    assert intervals.blocks_of([]).count == 0


@pytest.mark.parametrize("count", [3, 5, 10])
@pytest.mark.parametrize(("mean", "alike"), [(0.7, 10), (0.9, 10), (0.9, 30), (0.97, 30)])
def test_intervals_cover_as_often_as_they_say(count: int, mean: float, alike: float) -> None:
    """Recordings (or sites) whose figures differ, 20 images of unequally many vehicles each: 95% hold the truth."""
    rng, said = np.random.default_rng(1), []
    blocks = intervals.Blocks(unit="recording", number=np.repeat(np.arange(count), 20), sites=1)
    for _ in range(1000):
        rate = rng.beta(mean * alike, (1 - mean) * alike, (count, 1))
        vehicles = rng.poisson(5 * rng.lognormal(0, 0.4, (count, 1)), (count, 20))
        hits = rng.binomial(vehicles, rate)
        columns = (hits.ravel().astype(float), vehicles.ravel().astype(float))
        pair = intervals.intervals({("box_recall", None): columns}, blocks)["box_recall"]
        if pair is not None:  # as it is where nothing was missed
            said.append(pair[0] <= mean <= pair[1])
    assert len(said) > 900
    assert 0.92 <= np.mean(said) <= 0.97


def test_frames_of_one_recording_are_no_evidence_of_their_own() -> None:
    """What 10 s blocks say of such recordings: the truth is outside far more often than once in twenty."""
    rng, held = np.random.default_rng(2), 0
    for _ in range(300):
        hits = rng.binomial(10, np.repeat(rng.beta(9, 1, 5), 20)).astype(float)
        columns = {("box_recall", None): (hits, np.full(100, 10.0))}
        blocks = intervals.Blocks(unit="10 s", number=np.repeat(np.arange(20), 5), sites=1)
        low, high = intervals.intervals(columns, blocks)["box_recall"]
        held += low <= 0.9 <= high
    assert held / 300 < 0.85


@pytest.mark.parametrize("count", [3, 5, 10])
def test_differences_are_covered_as_often(count: int) -> None:
    """Two detectors of which the second finds a tenth less, more or less by recording."""
    rng, held, trials, name = np.random.default_rng(3), 0, 1000, ("box_recall", None)
    blocks = intervals.Blocks(unit="recording", number=np.repeat(np.arange(count), 20), sites=1)
    for _ in range(trials):
        rate = rng.beta(16, 4, (count, 1))
        other = rate - 0.1 + rng.normal(0, 0.03, (count, 1))
        vehicles = rng.poisson(6, (count, 20)).astype(int)
        a, b = (
            {name: (rng.binomial(vehicles, np.clip(p, 0, 1)).ravel().astype(float), vehicles.ravel().astype(float))}
            for p in (rate, other)
        )
        pair = intervals.difference(a, b, blocks, name)
        assert pair is not None
        held += pair[0] <= -0.1 <= pair[1]
    assert 0.92 <= held / trials <= 0.97


def test_students_quantiles_are_those_of_scipy() -> None:
    for freedom in (*range(1, 12), 20, 50, 1000):
        assert intervals.t_quantile(freedom) == pytest.approx(scipy.stats.t.ppf(0.975, freedom), rel=1e-9)


def test_where_nothing_can_be_said_there_is_no_interval() -> None:
    """One block; or blocks that all say 1: how seldom something is missed, such data do not tell."""
    ones = {("pck", None): (np.ones(3), np.ones(3))}
    single = intervals.Blocks(unit="10 s", number=np.zeros(3, dtype=np.int64), sites=1)
    three = intervals.Blocks(unit="recording", number=np.arange(3), sites=1)
    empty = {("pck", None): (np.array([3.0, 0, 0]), np.array([4.0, 0, 0]))}
    for columns, blocks in ((ones, single), (ones, three), (empty, three)):
        assert intervals.intervals(columns, blocks) == {"pck": None}


# --------------------------------------------------------------------------------------------------------------- parts


def test_parts_equal_scoring_their_vehicles_alone() -> None:
    """Vehicles far apart cannot take each other's detections: a part's recall and PCK stand by themselves."""
    rng = np.random.default_rng(2)
    vehicles, results = [], []
    for i in range(60):
        box = (10.0 + 95 * (i % 10), 10.0 + 70 * (i // 10), 90.0, 60.0)
        vehicles.append(
            replace(
                make_annotation(i + 1, 1, box, hidden=int(rng.integers(20))),
                distance=float(rng.choice([5, 20, 39.9, 40, 60, 100])),
                occlusion=float(rng.choice([0.0, 0.1, 0.3, 0.4, 1.0])),
                truncation=None,
                parked=bool(rng.random() < 0.5),
                model=str(rng.choice(["bus_city", "sedan_a", "van_b"])),
                vehicle_type=str(rng.choice(["sedan", "bus"])),
            )
        )
        if rng.random() < 0.8:
            points = vehicles[-1].keypoints + np.pad(rng.normal(0, 7, (33, 2)), ((0, 0), (0, 1)))
            results.append(Result(image_id=1, score=0.95, bbox=vehicles[-1].bbox, keypoints=points))
    image = Image(id=1, file_name="a.png", width=1000, height=500, weather="rain")
    file = AnnotationFile(images=(image,), annotations=tuple(vehicles))
    fleet = FleetInfo(held_out={"van_b"}, substituted={"bus_city": ("hood_front_left", "hood_front_right")})
    options = MetricOptions()
    parts = breakdown(file.images, match(file, results), options, fleet)
    which = {
        "distance": {
            "0-20": lambda v: v.distance < 20,
            "20-40": lambda v: 20 <= v.distance < 40,
            "40-60": lambda v: 40 <= v.distance < 60,
            "60+": lambda v: v.distance >= 60,
        },
        "occlusion": {
            "0-0.1": lambda v: v.occlusion < 0.1,
            "0.1-0.4": lambda v: 0.1 <= v.occlusion < 0.4,
            "0.4-1": lambda v: v.occlusion >= 0.4,
        },
        "parked": {"parked": lambda v: v.parked, "driving": lambda v: not v.parked},
        "model": {"unseen": lambda v: v.model == "van_b", "seen": lambda v: v.model != "van_b"},
        "vehicle_type": {"sedan": lambda v: v.vehicle_type == "sedan", "bus": lambda v: v.vehicle_type == "bus"},
        "weather": {"rain": lambda v: True},
        "height": {"50-100": lambda v: True},
        "unoccluded_within_40_m": {
            "yes": lambda v: v.distance < 40 and v.occlusion == 0,
            "no": lambda v: v.distance >= 40 or v.occlusion > 0,
        },
    }
    assert set(parts) == {*which, "keypoint", "keypoint_kind"}
    for quantity, of in which.items():
        assert set(parts[quantity]) == set(of)
        for name, inside in of.items():
            alone = replace(file, annotations=tuple(v for v in vehicles if inside(v)))
            ours, entry = parts[quantity][name]["0.6"], score_split(alone, results, options)["iou"]["0.6"]
            for key in ("matched", "labelled", "labelled_all", "correct", "pck"):
                assert ours[key] == entry[key], (quantity, name, key)
            assert ours["box_recall"] == entry["box_recall"]["pooled"]
    whole = score_split(file, results, options)["iou"]["0.6"]
    for quantity in ("keypoint", "keypoint_kind"):
        assert sum(part["0.6"]["correct"] for part in parts[quantity].values()) == whole["correct"]
    stand_ins = [v for v in vehicles if v.model == "bus_city"]
    hood = [keypoints.INDEX[n] for n in fleet.substituted["bus_city"]]
    labelled = sum(int((v.keypoints[hood, 2] == 2).sum()) for v in stand_ins)
    assert parts["keypoint_kind"]["substituted"]["0.6"]["labelled_all"] == labelled > 0


def test_without_extra_fields_there_are_few_parts() -> None:
    file, results = as_records(*cases()[3])
    parts = breakdown(file.images, match(file, results), MetricOptions(), FleetInfo())
    assert set(parts) <= {"height", "keypoint"}


def test_the_papers_keypoint_precision_is_recall_times_pck_times_the_labelled_share() -> None:
    """Over images with equal counts: each has one vehicle found of two, with 22 of 33 points labelled."""
    rng = np.random.default_rng(4)
    vehicles, results = [], []
    for image in range(1, 9):
        for place in (0, 1):
            number = 2 * image + place
            vehicles.append(make_annotation(number, image, (10 + 200 * place, 10, 100, 60), hidden=11))
        if image % 4:
            points = vehicles[-1].keypoints + np.pad(rng.normal(0, 8, (33, 2)), ((0, 0), (0, 1)))
            results.append(Result(image_id=image, score=1.0, bbox=vehicles[-1].bbox, keypoints=points))
    images = tuple(Image(id=i, file_name=f"{i}.png", width=400, height=90) for i in range(1, 9))
    file = AnnotationFile(images=images, annotations=tuple(vehicles))
    entry = score_split(file, results, MetricOptions())["iou"]["0.9"]
    share = entry["labelled"] / (33 * entry["matched"])
    assert share == pytest.approx(22 / 33)
    assert 0.2 < entry["pck"] < 0.95
    product = entry["keypoint_recall"]["paper"] * entry["pck"] * share
    assert entry["keypoint_precision"]["paper"] == pytest.approx(product, abs=1e-12)
    assert entry["keypoint_recall"]["paper"] == 6 / 8
