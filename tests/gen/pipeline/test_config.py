"""What is asked for of light, traffic and sites, and the plans that follow from it."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from skope.errors import UserError
from skope.gen.generation_site import own_site
from skope.gen.labels.ignore_rules import Rules
from skope.gen.pipeline.config import DatasetRequest, from_preset, presets
from skope.gen.pipeline.dataset_store import Store
from skope.gen.scene.recording import RecordingPlan
from skope.gen.vehicles.fleet import fleet

EXAMPLE = Path(__file__).parents[3] / "examples" / "own_road"


def asked(preset: str = "full", seed: int = 3, driver: str = "a driver", **changes: Any) -> DatasetRequest:
    return from_preset(preset, seed=seed, renderer="gl", driver=driver, rules=Rules(), **changes)


def lights(plans: list[RecordingPlan]) -> list[tuple[str, str]]:
    return [(plan.site.weather, plan.site.time_of_day) for plan in plans]


def test_recordings_have_no_other_light_than_what_was_asked_for() -> None:
    wanted = {(weather, hour) for weather in ("rain", "fog") for hour in ("night", "dusk")}
    for preset in ("demo", "full", "world"):
        found = lights(asked(preset, weather=("rain", "fog"), time_of_day=("night", "dusk")).plans())
        assert set(found) == wanted
    before = lights(asked().plans())
    assert lights(asked(weather=("fog",)).plans()) == [("fog", hour) for _, hour in before]
    assert lights(asked(time_of_day=("dawn",)).plans()) == [(weather, "dawn") for weather, _ in before]


def test_recordings_in_a_light_that_was_asked_for_stay_as_they_were() -> None:
    before, after = asked().plans(), asked(weather=("clear", "rain"), time_of_day=("noon", "night")).plans()
    fits = [(w in ("clear", "rain"), t in ("noon", "night")) for w, t in lights(before)]
    assert fits.count((True, True)) > 10
    for old, new, (weather, hour) in zip(before, after, fits, strict=True):
        assert (old == new) == (weather and hour)
        assert not weather or old.site.weather == new.site.weather
        assert not hour or old.site.time_of_day == new.site.time_of_day


def test_what_follows_from_a_light_goes_with_it_and_the_rest_of_a_site_file_stays() -> None:
    own = own_site("--site", str(EXAMPLE / "drawn.toml"))
    assert own is not None
    spans = {"sun_elevation_deg": (30.0, 30.0), "clouds": (0.1, 0.1), "noise": (1.0, 1.0)}
    own = replace(own, site=replace(own.site, weather="clear", time_of_day="noon", conditions=spans))

    def kept(**changes: Any) -> set[str]:
        return set(asked("demo", user_site=own, frames=4, **changes).plans()[0].site.conditions)

    assert kept() == set(spans)
    assert kept(weather=("fog",)) == {"sun_elevation_deg", "noise"}
    assert kept(time_of_day=("night",)) == {"clouds", "noise"}
    assert kept(weather=("clear", "fog"), time_of_day=("noon",)) == set(spans)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"weather": ("hail",)}, "--weather: 'hail' is not one of clear, cloudy"),
        ({"weather": ("rain", "rain")}, "--weather: expected different names, got rain,rain"),
        ({"time_of_day": ("noon", "tea")}, "--time-of-day: 'tea' is not one of noon"),
        ({"vehicle_share": 0.2}, "--share: applies to the models of --vehicles"),
        ({"vehicles": {"mine": "ab"}, "vehicle_share": 0.0}, "--share: expected a share above 0 and up to 1, got 0"),
        ({"vehicles": {"mine": "ab"}, "vehicle_share": 1.5}, "--share: expected a share above 0 and up to 1, got 1.5"),
        ({"vehicles": {"mine": "ab"}, "vehicle_share": float("nan")}, "--share: expected a share"),
        (
            {"vehicles": {"suv": ""}},
            "--vehicles suv: is a model of the fleet and in the traffic anyway; set its share",
        ),
    ],
)
def test_what_cannot_be_asked_for_is_named(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError) as raised:
        asked(**changes)
    assert str(raised.value).startswith(said)


def test_models_that_are_held_out_are_for_test_sites_only() -> None:
    name = next(name for name, entry in fleet().items() if entry.held_out)
    changes = {"vehicles": {name: ""}, "vehicle_share": 0.3}
    assert asked(sites=("t01_main_west",), **changes).parameters.vehicle_share == 0.3
    with pytest.raises(
        UserError, match=f"--vehicles {name}: is held out for test sites, but t01_mill_corner is a training site"
    ):
        asked(sites=("t01_main_west", "t01_mill_corner"), **changes)


def test_further_models_belong_to_three_presets() -> None:
    """Datasets of the others stay as they were."""
    with_them = {"world", "nights", "conditions"}
    assert {name for name in presets() if asked(name).parameters.variation.further_models} == with_them
    for name in presets():
        assert all(plan.variation.further_models == (name in with_them) for plan in asked(name, frames=1).plans())
    # There they drive by anyway; elsewhere they need not be given a share.
    with pytest.raises(UserError, match="--vehicles truck_mixer: is a model of the fleet and in the traffic anyway"):
        asked("world", vehicles={"truck_mixer": ""})
    assert asked("varied", vehicles={"truck_mixer": ""}).parameters.vehicle_share is None


@pytest.mark.parametrize("span", [(0.0, 0.3), (0.3, 0.2), (0.1, 1.5), (float("nan"), 0.3)])
def test_the_range_of_the_largest_vehicle_is_checked(span: tuple[float, float]) -> None:
    request = asked("nights", frames=1)
    variation = replace(request.parameters.variation, largest_vehicle=span)
    with pytest.raises(UserError, match=r"^largest_vehicle: expected a range above 0 and up to 1, got "):
        replace(request, parameters=replace(request.parameters, variation=variation))


def test_only_nights_chooses_how_large_vehicles_are() -> None:
    chosen = {name: asked(name, frames=1).parameters.to_dict().get("largest_vehicle") for name in presets()}
    assert {name for name, span in chosen.items() if span} == {"nights"}
    assert chosen["nights"] == presets()["nights"]["largest_vehicle"]


def test_a_photograph_has_one_light() -> None:
    own = own_site("--site", str(EXAMPLE / "site.toml"))
    with pytest.raises(UserError, match=r"--time-of-day: .*site\.toml has a photograph"):
        asked("demo", user_site=own, frames=4, time_of_day=("night",))


def test_a_site_is_a_name_or_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert own_site("--site", "t01_main_west") is None
    with pytest.raises(UserError, match=r"^--site: expected a site file \(\.toml\) or one of t01_.*; got 'nowhere'"):
        own_site("--site", "nowhere")
    with pytest.raises(UserError, match=r"^nowhere\.toml: "):
        own_site("--site", "nowhere.toml")
    (tmp_path / "t01_main_west").write_text("network = 3")
    with pytest.raises(
        UserError, match=r"both a site of the package and a file here; write \./t01_main_west for the file"
    ):
        own_site("--site", "t01_main_west")
    with pytest.raises(UserError, match=r"^t01_main_west: .*expected"):
        own_site("--site", "./t01_main_west")


def test_other_light_or_traffic_is_other_work(tmp_path: Path) -> None:
    first = asked(weather=("rain",), vehicles={"suv": ""}, vehicle_share=0.2)
    Store(tmp_path).begin(first.dataset_plan())
    Store(tmp_path).begin(first.dataset_plan())
    for other, said in (
        (asked(weather=("rain",), vehicles={"suv": ""}, vehicle_share=0.3), "vehicle_share = 0.2, now 0.3"),
        (asked(vehicles={"suv": ""}, vehicle_share=0.2), r'weather = \["rain"\], now \[\]'),
        (
            asked(weather=("rain",), time_of_day=("noon",), vehicles={"suv": ""}, vehicle_share=0.2),
            r"time_of_day = \[\]",
        ),
    ):
        with pytest.raises(UserError, match=said):
            Store(tmp_path).begin(other.dataset_plan())


def test_a_site_s_frames_are_shared_out_to_the_recordings_asked_for() -> None:
    plans = asked("demo", recordings=5, frames=12).plans()
    by_site = [[plan.frames for plan in plans if plan.site.name == name] for name in {p.site.name for p in plans}]
    assert by_site == [[3, 3, 2, 2, 2]] * 13
    assert lights(plans[:5]) == lights(asked("paper").plans()[:5])
    assert len(set(lights(plans[:5]))) > 2


def test_recordings_of_an_own_road_fit_its_file() -> None:
    own = own_site("--site", str(EXAMPLE / "drawn.toml"))
    assert own is not None
    named = replace(own, splits=("train", "test"))
    assert [plan.site.split for plan in asked(user_site=replace(own, splits=()), recordings=3).plans()] == [
        "train",
        "train",
        "test",
    ]
    assert len(asked(user_site=named, recordings=2).plans()) == 2
    with pytest.raises(UserError, match=r"^--recordings: expected 2, as \S+ has that number of splits, got \d+$"):
        asked(user_site=named, recordings=3)
    with pytest.raises(UserError, match="--recordings: expected a whole number from 1, got 0"):
        asked(recordings=0)


def test_the_guide_says_what_presets_hold() -> None:
    guide = (EXAMPLE.parents[1] / "docs" / "generating.md").read_text(encoding="utf-8")
    told = {
        name: rest for name, *rest in re.findall(r"^\| `(\w+)` \| [^|]*? \| (.*?) \| (.*?) \| (\S+) \|$", guide, re.M)
    }
    assert told.keys() == presets().keys()
    for name, (frames, recordings, size) in told.items():
        row = presets()[name]
        assert set(map(int, re.findall(r"\d+", frames))) == set(row["frames"].values())
        assert int(re.findall(r"\d+", recordings)[0]) == row.get("recordings", row.get("recording_frames"))
        assert size == row["size"]
