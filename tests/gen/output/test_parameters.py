"""Parameters of a dataset: written and read by themselves, and whatever is wrong in a file is named."""

import json
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from skope.errors import UserError
from skope.gen.labels.ignore_rules import Rules
from skope.gen.output.frames import Encoding
from skope.gen.output.parameters import DatasetPlan, OwnSiteRecord, Parameters
from skope.gen.scene.recording import RecordingInfo
from skope.gen.scene.variation import Variation

OWN = OwnSiteRecord(file="site.toml", digests={"site": "ab"}, town="cd", photograph=True, splits=("train", "test"))
PARAMETERS = Parameters(
    preset="varied",
    seed=3,
    sites=("west", "east"),
    frames={"train": 3, "easy": 2},
    recordings=2,
    interval_s=0.5,
    size="320x180",
    fov_deg=60,
    renderer="gl",
    driver="a driver",
    rules=Rules(occlusion="paper", min_box=10),
    variation=Variation(
        settings={"rain_mm_h": (2.0, 6)},
        night={"contrast": (0.9, 1.1)},
        cameras={"zoom_by": (0.9, 1.1)},
        shape_jitter=True,
        largest_vehicle=(0.05, 0.4),
        distractors=(0, 25),
        lit_objects=(0, 18),
        seasons=True,
        further_models=True,
        randomised=0.25,
    ),
    vehicles={"mine": "ef"},
    vehicle_share=0.25,
    weather=("rain", "fog"),
    time_of_day=("night",),
    own=OWN,
    encoding=Encoding(image="png", depth=False),
    format="shards",
    licence="CC0 1.0",
    versions={"skope": "0.1.0"},
)
PLAN = DatasetPlan(PARAMETERS, (RecordingInfo("west", "00", "train", 2), RecordingInfo("east", "01", "easy", 1)))


def through_json(value: Any) -> Any:
    return json.loads(json.dumps(value))


def test_what_is_written_is_read_again() -> None:
    assert DatasetPlan.from_dict(through_json(PLAN.to_dict()), Path("card")) == PLAN
    assert through_json(PLAN.to_dict()) == PLAN.to_dict()  # nothing but JSON values


def test_every_field_is_written_in_one_object() -> None:
    """What varies stands among the other parameters."""
    variation = replace(PARAMETERS.variation, road_users=True)
    names = list(replace(PARAMETERS, variation=variation).to_dict())
    assert set(names) == {f.name for f in (*fields(Parameters), *fields(Variation))} - {"variation"}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"fov_deg": "wide"}, "parameters.fov_deg: expected a number, got 'wide'"),
        ({"seed": True}, "parameters.seed: expected a whole number, got True"),
        ({"seed": 1.0}, "parameters.seed: expected a whole number, got 1.0"),
        ({"settings": {"rain_mm_h": [1]}}, "parameters.settings.rain_mm_h: expected a list of 2 numbers, got [1]"),
        ({"frames": {"train": "3"}}, "parameters.frames.train: expected a whole number, got '3'"),
        ({"sites": "west"}, "parameters.sites: expected a list of texts, got 'west'"),
        ({"own": {"file": "site.toml"}}, "parameters.own.digests: missing"),
        ({"rules": {"occlusion": "paper"}}, "parameters.rules.localizer: missing"),
        ({"encoding": {"image": "gif", "quality": 95, "depth": True}}, "parameters.encoding.--image-format: "),
        ({"encoding": {"image": "jpeg", "quality": "95", "depth": True}}, "parameters.encoding.quality: "),
        ({"distractors": 3}, "parameters.distractors: expected a list of 2 numbers or none, got 3"),
        ({"weather": "rain"}, "parameters.weather: expected a list of texts, got 'rain'"),
        ({"vehicle_share": "much"}, "parameters.vehicle_share: expected a number or none, got 'much'"),
        ({"keypoint_edition": 1}, "parameters.keypoint_edition: expected 2, got 1"),
        ({"keypoint_edition": None}, "parameters.keypoint_edition: expected 2, got nothing"),
        ({"haze": 3}, "parameters.haze: unknown field; "),
    ],
)
def test_what_is_wrong_is_named(change: Mapping[str, Any], said: str) -> None:
    plan = through_json(PLAN.to_dict())
    plan["parameters"] |= change
    with pytest.raises(UserError) as raised:
        DatasetPlan.from_dict(plan, Path("card"))
    assert str(raised.value).startswith(f"card: {said}")
