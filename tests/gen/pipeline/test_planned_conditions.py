"""Splits by condition and lights that vary widely, as presets plan them."""

from collections import Counter

import numpy as np
import pytest

from skope.gen.pipeline.config import HEAVY_TYPES, in_its_light, preset_tables, presets, varied
from skope.gen.scene.conditions import CONDITION_LIMITS, Conditions, ranges
from skope.gen.towns.sites import site, sites
from skope.gen.vehicles.fleet import fleet
from tests.gen.pipeline.test_config import asked


def test_each_split_by_condition_has_its_own_weather_and_a_hundred_images() -> None:
    plans = asked("conditions").plans()
    images: Counter[str] = Counter()
    for plan in plans:
        images[plan.site.split] += plan.frames
        light = f"{plan.site.weather} {plan.site.time_of_day}"
        assert light in preset_tables()["conditions"][plan.site.split]["light"]
    assert set(images) == set(presets()["conditions"]["splits"])
    assert min(images.values()) >= 100
    assert {site(plan.site.name).split for plan in plans} == {"extra"}


def test_the_lights_of_a_condition_all_come() -> None:
    plans = asked("conditions").plans()
    for name, table in preset_tables()["conditions"].items():
        seen = {f"{p.site.weather} {p.site.time_of_day}" for p in plans if p.site.split == name}
        assert seen == set(table["light"])


def test_a_split_of_lorries_and_buses_asks_for_them_and_others_do_not() -> None:
    for plan in asked("conditions").plans():
        kinds = {fleet()[name].vehicle.vehicle_type for name in plan.vehicles}
        if plan.site.split == "heavy":
            assert kinds == HEAVY_TYPES
            assert plan.vehicle_share == pytest.approx(0.7)
        else:
            assert not kinds
            assert plan.vehicle_share is None


def test_world_asks_for_lorries_and_buses_that_may_be_learnt_and_each_traffic_has_a_share() -> None:
    plans = [plan for plan in asked("world").plans() if plan.site.split == "train"]
    models = {name for plan in plans for name in plan.vehicles}
    assert {fleet()[name].vehicle.vehicle_type for name in models} == HEAVY_TYPES
    assert not any(fleet()[name].held_out for name in models)
    shares = {(plan.site.name, plan.leader): plan.vehicle_share or 0.0 for plan in plans}
    assert all((plan.vehicle_share or 0.0) == shares[plan.site.name, plan.leader] for plan in plans)
    low, high = presets()["world"]["heavy"]
    assert low <= min(shares.values()) < 0.1
    assert high >= max(shares.values()) > 0.3


def test_spray_is_asked_for_in_its_split_and_wins_over_what_varies() -> None:
    sprayed = next(p for p in asked("conditions").plans() if p.site.split == "spray")
    assert sprayed.site.conditions["spray"] == (0.8, 1.8)
    assert sprayed.site.conditions["visibility_m"] == (300, 3000)


def test_a_third_of_world_is_dark_and_most_of_that_night() -> None:
    hours = Counter(plan.site.time_of_day for plan in asked("world").plans())
    dark = {hour: hours[hour] / hours.total() for hour in ("night", "dusk", "dawn")}
    assert 0.29 < sum(dark.values()) < 0.37
    assert dark["night"] > dark["dusk"] + dark["dawn"]


def test_nights_is_dark_throughout_and_most_of_it_night() -> None:
    hours = Counter(plan.site.time_of_day for plan in asked("nights").plans())
    assert set(hours) == {"night", "dusk"}
    assert 0.75 < hours["night"] / hours.total() < 0.92
    noon = asked("nights", time_of_day=("noon",)).plans()
    assert {plan.site.time_of_day for plan in noon} == {"noon"}


def test_what_varies_can_be_drawn_and_flags_win_over_it() -> None:
    for wide in preset_tables()["varied_light"].values():
        for name, (low, high) in wide.items():
            assert CONDITION_LIMITS[name][0] <= low <= high <= CONDITION_LIMITS[name][1]
    plan = next(p for p in asked("world", settings={"glare": (2.0, 2.0)}).plans() if p.site.time_of_day == "night")
    spans = ranges(plan.site.weather, plan.site.time_of_day, {**plan.site.conditions, **plan.variation.settings})
    drawn = Conditions.drawn(spans, np.random.default_rng(0))
    assert drawn.glare == 2.0
    assert spans["street_lights_lit"] == tuple(preset_tables()["varied_light"]["night"]["street_lights_lit"])


def test_paper_knows_nothing_of_what_varies() -> None:
    for plan in asked("paper").plans():
        spans = ranges(plan.site.weather, plan.site.time_of_day, {**plan.site.conditions, **plan.variation.settings})
        drawn = Conditions.drawn(spans, np.random.default_rng(0))
        assert (drawn.glare, drawn.street_lights_lit, drawn.spray, drawn.lens_dirt, drawn.snow_cover) == (1, 1, 0, 0, 0)


def test_a_site_s_own_values_win_over_what_varies() -> None:
    own = in_its_light(site(next(iter(sites()))), 0, 0)
    fixed = varied(own).conditions
    assert {name: fixed[name] for name in own.conditions} == dict(own.conditions)


def test_few_recordings_of_world_show_most_of_its_lights() -> None:
    lights = {f"{plan.site.weather} {plan.site.time_of_day}" for plan in asked("world", frames=96).plans()}
    assert len(lights) > 0.7 * len(set(presets()["world"]["light"]))
