"""What the page is told of images and vehicles, and that its counts are those of the metrics."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.errors import UserError
from skope.files.json_files import json_bytes
from skope.keypoints import INDEX, K
from skope.metrics.breakdown import FleetInfo
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.metrics.split_scores import SplitScores, split_metrics
from skope.schema import Result
from skope.viewer import documents
from skope.viewer.collection import Collection, ShownSplit
from skope.viewer.documents import (
    ALL_QUALITIES,
    HEIGHT_QUALITY,
    OCCLUSION_QUALITY,
    SCORE_STEPS_KEPT,
    TYPE_QUALITY,
    Documents,
    kind_number,
)
from tests.samples import make_annotation, make_dataset
from tests.viewer.conftest import HOSTILE


def values_of(kind: int) -> tuple[str, ...]:
    """The words that a number of `vehicle_filters` stands for, worked out as the page does."""
    out = []
    for quality in reversed(ALL_QUALITIES):
        kind, place = divmod(kind, len(quality.values))
        out.append(quality.values[place])
    return tuple(reversed(out))


def facet(index: dict[str, Any], name: str) -> list[str | None]:
    (found,) = (one for one in index["facets"] if one["name"] == name)
    return [None if place < 0 else found["values"][place] for place in found["of"]]


# --------------------------------------------------------------------------------------------------------- the index


def test_the_index_has_a_light_row_for_each_image(labelled: Collection) -> None:
    index = json.loads(json_bytes(Documents(labelled).index()))
    assert index["title"] == f"data {HOSTILE}"
    assert index["names"] == [image.file_name for image in labelled.splits[0].file.images]
    assert facet(index, "site") == ["north", HOSTILE.replace("/", "")] * 2
    assert facet(index, "weather") == ["clear", "clear", "rain", "rain"]
    assert facet(index, "recording")[0] == "north/00"
    assert len(index["keypoints"]) == K
    assert index["score"] is None
    kinds = [{values_of(kind) for kind in row} for row in index["kinds"]]
    assert kinds[0] == {("van", "0-0.1", "25-50"), ("sedan", "0-0.1", "25-50")}
    assert kinds[1] == {*kinds[0], ("bus", "0.4-1", "0-25")}
    assert kinds[3] == kinds[0]  # ignored vehicles are none that is looked for
    assert len(json_bytes(index["kinds"])) < 60


def test_what_images_and_vehicles_do_not_say_is_unknown(labelled: Collection) -> None:
    (split,) = labelled.splits
    bare = replace(split.file.images[0], weather=None, site=None, recording=None, split=None)
    vehicle = replace(make_annotation(1, bare.id, (0, 0, 300, 210)), vehicle_type=None, occlusion=None)
    file = replace(split.file, images=(bare,), annotations=(vehicle,), name="night")
    index = Documents(replace(labelled, splits=(ShownSplit(file=file),))).index()
    assert [facet(index, name) for name in ("split", "site", "recording", "weather")] == [["night"]] + [[None]] * 3
    assert values_of(index["kinds"][0][0]) == ("unknown", "unknown", "200+")


@pytest.mark.parametrize(
    ("height", "occlusion", "bands"),
    [
        (24.9, 0.0, ("0-25", "0-0.1")),
        (25.0, 0.1, ("25-50", "0.1-0.4")),
        (100.0, 0.39, ("100-200", "0.1-0.4")),
        (200.0, 1.0, ("200+", "0.4-1")),
    ],
)
def test_bands_are_those_of_the_breakdown(height: float, occlusion: float, bands: tuple[str, str]) -> None:
    vehicle = replace(make_annotation(1, 1, (0, 0, 9, height)), occlusion=occlusion)
    for boxes in ("full", "visible"):
        assert values_of(kind_number(vehicle, boxes))[1:] == bands[::-1]
    assert [quality["name"] for quality in documents.described()] == [
        TYPE_QUALITY.name,
        OCCLUSION_QUALITY.name,
        HEIGHT_QUALITY.name,
    ]


def test_images_of_several_splits_are_numbered_through(labelled: Collection, tmp_path: Path) -> None:
    from skope.dataset.folder import open_dataset

    more = open_dataset(make_dataset(tmp_path / "more", images=3, splits=("hard",))).read("hard")
    documents = Documents(replace(labelled, splits=(*labelled.splits, ShownSplit(file=more))))
    assert len(documents) == 7
    for number in range(7):
        facts = dict(documents.details(number)["facts"])
        assert facts["split"] == ("easy" if number < 4 else "hard")
        assert facts["frame"] == str(number % 4 + 1 if number < 4 else number - 3)
    assert facet(documents.index(), "split") == ["easy"] * 4 + ["hard"] * 3


# ------------------------------------------------------------------------------------------------------- one image


def test_details_are_what_is_drawn(labelled: Collection) -> None:
    documents = Documents(labelled)
    (van, _, bus), (*_, ignored) = (documents.details(number)["vehicles"] for number in (1, 3))
    truth = labelled.splits[0].file.by_image()[2]
    assert van["box"] == pytest.approx(truth[0].bbox)
    assert np.reshape(van["points"], (K, 3)) == pytest.approx(truth[0].keypoints, abs=0.051)
    assert bus["words"] == "bus 50, 20 m away, 50% hidden"
    assert [bus["points"][3 * k + 2] for k in (0, K - 1)] == [2, 1]
    assert (bus["ignored"], ignored["ignored"]) == (False, True)
    assert ignored["words"].endswith("ignored: small")
    assert documents.details(0)["detections"] == []
    assert documents.details(0)["size"] == [160, 120]


def test_people_and_two_wheelers_are_told_apart_from_vehicles(labelled: Collection, peopled: Collection) -> None:
    documents = Documents(peopled)
    assert (documents.index()["others"], Documents(labelled).index()["others"]) == (True, False)
    walker, bicycle = documents.details(0)["others"]
    assert (walker["category"], walker["words"], walker["ignored"]) == ("pedestrian", "pedestrian 60, 20 m away", False)
    assert bicycle["box"] == [120, 5, 20, 30]
    assert [one["ignored"] for one in documents.details(1)["others"]] == [True]
    plain = Documents(labelled)
    assert plain.details(0)["others"] == []
    assert documents.details(0)["vehicles"] == plain.details(0)["vehicles"]
    assert documents.index()["kinds"] == plain.index()["kinds"]


def test_visible_boxes_are_shown_where_they_were_measured(predicted: Collection) -> None:
    (split,) = predicted.splits
    vehicles = tuple(replace(a, bbox_visible=np.array([1.0, 2, 3, 4])) for a in split.file.annotations)
    shown = replace(
        predicted,
        splits=(replace(split, file=replace(split.file, annotations=vehicles)),),
        options=MetricOptions(boxes="visible"),
    )
    assert Documents(shown).details(0)["vehicles"][0]["box"] == [1, 2, 3, 4]


# ------------------------------------------------------------------------------------------------------- predictions


def measured(collection: Collection, score: float) -> SplitScores:
    (split,) = collection.splits
    assert collection.options
    return split_metrics(split.file, split.results, replace(collection.options, score=score), FleetInfo())


@pytest.mark.parametrize("step", [0, 500, 919, 920, 940, 985, 1000])
def test_counts_are_those_of_the_metrics_at_every_threshold(predicted: Collection, step: int) -> None:
    documents = Documents(predicted)
    scores = documents.scores(step)
    expected = measured(predicted, step / SCORE_STEPS_KEPT.steps).entry
    assert sum(scores["detections"]) == expected["detections"]
    assert sum(scores["false"]) == expected["failures"]["0.6"]["false"]
    assert sum(map(len, scores["missed"])) == expected["failures"]["0.6"]["missed"]
    for number in range(len(documents)):
        details = documents.details(number)
        above = [d for d in details["detections"] if d["step"] > step]
        truth = [v for v in details["vehicles"] if not v["ignored"]]
        assert len(above) == scores["detections"][number]
        assert sum(d["false"] for d in above) == scores["false"][number]
        assert sorted(v["kind"] for v in truth if v["found"] <= step) == sorted(scores["missed"][number])


def test_missed_vehicles_are_known_by_kind_and_quality_is_worst_where_most_is_missed(predicted: Collection) -> None:
    scores = Documents(predicted).scores(500)
    assert [sorted(values_of(kind)[0] for kind in kinds) for kinds in scores["missed"]] == [
        [],
        ["bus", "sedan"],
        [],
        ["sedan"],
    ]
    assert scores["false"] == [0, 0, 0, 1]
    assert np.argmin(scores["quality"]) == 3  # half of the keypoints, times 2 / 3 for the false one
    assert scores["quality"][2] == 1


def test_wrong_keypoints_lead_to_their_places(predicted: Collection) -> None:
    details = Documents(predicted).details(0)
    swapped = details["vehicles"][0]
    theirs = details["detections"][swapped["by"]]["points"]
    k = INDEX["wheel_front_left"]
    other = INDEX["wheel_front_right"]
    assert k in swapped["wrong"]
    assert np.hypot(*(np.array(theirs[3 * k : 3 * k + 2]) - swapped["points"][3 * other : 3 * other + 2])) < 8
    assert details["vehicles"][1]["wrong"] == []


@pytest.mark.parametrize("score", [0.0, 1e-9, 0.07, 0.29, 0.5, 0.9, 0.900001, 0.9995, 1.0])
def test_browser_and_server_agree_on_what_lies_above_a_threshold(predicted: Collection, score: float) -> None:
    (split,) = predicted.splits
    found = Result(image_id=1, score=score, bbox=np.array([0.0, 0, 9, 9]), keypoints=np.zeros((K, 3)))
    documents = Documents(replace(predicted, splits=(replace(split, results=(found,)),)))
    drawn = documents.details(0)["detections"]
    for step in range(SCORE_STEPS_KEPT.steps):
        above = [one for one in drawn if one["step"] > step]
        assert len(above) == (score > step / SCORE_STEPS_KEPT.steps)
    for step in (0, 69, 70, 71, 290, 500, 900, 999):
        assert documents.scores(step)["detections"][0] == (score > step / SCORE_STEPS_KEPT.steps)


def test_footage_has_detections_and_nothing_is_false(predicted: Collection) -> None:
    (split,) = predicted.splits
    bare = replace(split, file=replace(split.file, annotations=()))
    documents = Documents(replace(predicted, splits=(bare,), truth=False))
    assert documents.scores(500) == {"detections": [2, 1, 2, 2]}
    assert not any(d["false"] for d in documents.details(3)["detections"])
    assert documents.index()["kinds"] == [[]] * 4


def test_pictures_are_given_by_number_and_missing_ones_named(labelled: Collection) -> None:
    documents = Documents(labelled)
    picture = documents.picture(2)
    assert (picture.media_type, picture.data[:4]) == ("image/png", b"\x89PNG")
    gone = replace(labelled.splits[0].file.images[2], file_name="images/site/gone.png")
    with pytest.raises(UserError, match=r"gone\.png: no such file"):
        labelled.picture(gone)
