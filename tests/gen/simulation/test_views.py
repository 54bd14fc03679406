"""Recordings that share one simulated traffic: other corners and times, other paint and light, the same on any way."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.gen.labels.ignore_rules import Rules
from skope.gen.pipeline.config import DatasetRequest, from_preset
from skope.gen.pipeline.dataset_store import Store
from skope.gen.pipeline.workers import simulate_job
from skope.gen.scene import recording as recordings
from skope.gen.scene.camera_sampling import CAMERA_SAMPLING, PlacedCamera, ViewSampler
from skope.gen.scene.recording import LAMP_BITS, Recording, RecordingPlan
from skope.gen.scenery import build
from skope.gen.scenery.build import bays_of, scenery
from skope.gen.simulation.simulate import _variant, lamps_on, simulate, simulate_together
from skope.gen.towns.town import Town, Variant
from skope.gen.towns.town_style import style
from skope.gen.vehicles.paints import ALL_PAINTS


def request(**changes: object) -> DatasetRequest:
    made = from_preset(
        "world",
        seed=2,
        renderer="pybullet",
        driver="",
        rules=Rules(),
        frames=8,
        sites=("t01_mill_corner",),
        size="320x180",
    )
    own = {name: changes.pop(name) for name in vars(made.parameters.variation).keys() & changes.keys()}
    changes = {"recordings": 4, "variation": replace(made.parameters.variation, **own), **changes}
    return replace(made, parameters=replace(made.parameters, **changes))


@pytest.fixture(scope="module")
def plans() -> Sequence[RecordingPlan]:
    (plans,) = request().simulations()
    assert [(plan.index, plan.leader, plan.frames) for plan in plans] == [(0, 0, 2), (1, 0, 2), (2, 0, 2), (3, 0, 2)]
    return plans


@pytest.fixture(scope="module")
def filmed(plans: Sequence[RecordingPlan]) -> list[Recording]:
    return simulate_together(plans)


def test_cameras_hang_at_corners_of_one_town(filmed: list[Recording]) -> None:
    variants = {recording.town.variant for recording in filmed}
    (variant,) = variants
    assert variant
    assert variant.seed
    assert len(set(variant.masts)) == 4
    for mast, recording in zip(variant.masts, filmed, strict=True):
        assert recording.camera.position == pytest.approx(mast.position, abs=1e-6)
    assert len({recording.conditions for recording in filmed}) == 4


def test_by_day_some_vehicles_have_their_lamps_lit(filmed: list[Recording]) -> None:
    lit = []
    for recording in filmed:
        assert not lamps_on(recording.conditions) or (recording.lamps & LAMP_BITS["low_beam"]).any()
        if not lamps_on(recording.conditions):
            driving = [not recording.vehicles[i].parked and recording.vehicles[i].labelled for i in recording.vehicle]
            lit += ((recording.lamps & LAMP_BITS["low_beam"]) > 0)[driving].tolist()
    assert 0.1 < np.mean(lit) < 0.8


def test_paints_come_in_shades(filmed: list[Recording]) -> None:
    palettes = {ALL_PAINTS[one.color].palette for recording in filmed for one in recording.vehicles if one.labelled}
    assert "shades" in palettes
    assert "private" not in palettes


def test_equal_plans_make_equal_recordings(plans: Sequence[RecordingPlan], filmed: list[Recording]) -> None:
    assert list(map(recordings.packed_recording, simulate_together(plans))) == list(
        map(recordings.packed_recording, filmed)
    )


def test_a_missing_recording_is_made_as_it_was(
    plans: Sequence[RecordingPlan], filmed: list[Recording], tmp_path: Path
) -> None:
    store = Store(tmp_path)
    for plan, recording in zip(plans, filmed, strict=True):
        store.write_recording(plan.info, recordings.packed_recording(recording))
    lost = store.recording_path(plans[2].info)
    whole = lost.read_bytes()
    lost.unlink()
    others = {path: path.stat().st_mtime_ns for path in lost.parent.iterdir()}
    assert simulate_job(tmp_path, plans) == 4
    assert lost.read_bytes() == whole
    assert {path: path.stat().st_mtime_ns for path in others} == others


def test_a_recording_keeps_its_town(filmed: list[Recording], tmp_path: Path) -> None:
    for recording in filmed:
        recordings.save(tmp_path / "r.npz", recording)
        assert recordings.load(tmp_path / "r.npz").town == recording.town


@pytest.mark.slow
def test_frames_are_at_other_times(plans: Sequence[RecordingPlan]) -> None:
    """Two cameras side by side record the same vehicles, but not at the same places, and in other paint."""
    (busy,) = request(traffic=(2.0, 2.0), sites=("t05_market_first",)).simulations()
    one, other, *_ = simulate_together(busy)
    where = [
        {tuple(place.round(3)) for place in recording.T_world_chassis[:, :2, 3] if np.isfinite(place).all()}
        for recording in (
            replace_parked(one),
            replace_parked(other),
        )
    ]
    assert where[0]
    assert not where[0] & where[1]


def replace_parked(recording: Recording) -> Recording:
    """The recording without what stands still."""
    moving = np.hypot(*recording.velocity[:, :2].T) > 0.5
    rows = {name: getattr(recording, name)[moving] for name in recordings._ROW_FIELDS}
    return replace(recording, **rows)


def test_a_town_is_grown_anew_by_its_seed() -> None:
    own, first = (scenery(Town("town01", variant=variant)) for variant in (None, Variant(1)))
    again = build._grow_scenery(Town("town01", variant=Variant(1)))
    assert first.mesh.vertices.tobytes() == again.mesh.vertices.tobytes()
    assert len(own.mesh.vertices) != len(first.mesh.vertices)


def test_what_a_variant_is_drawn_with_is_switched_by_itself() -> None:
    def drawn(**changes: object) -> Variant:
        values = {"distractors": None, "lit_objects": None, "seasons": False, "randomised": 0.0, **changes}
        (plans,) = request(**values).simulations()
        return _variant(plans[0], ())

    plain = drawn()
    assert (plain.distractors, plain.lit_objects, plain.season, plain.randomised) == (0, 0, 0, 0)
    assert drawn(distractors=(7, 7)) == replace(plain, distractors=7)
    assert drawn(lit_objects=(5, 5)) == replace(plain, lit_objects=5)
    assert drawn(seasons=True) == replace(plain, season=drawn(seasons=True).season) != plain
    assert drawn(randomised=1.0) == replace(plain, randomised=drawn(randomised=1.0).randomised) != plain
    assert drawn(seasons=True, town_jitter=False) == Variant(0)


def test_views_are_drawn_with_the_size_of_vehicles_that_the_preset_wants(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    draw = ViewSampler.draw

    def drawn(sampler: ViewSampler, *values: Any) -> PlacedCamera:
        asked.append(values[3])
        return draw(sampler, *values)

    monkeypatch.setattr(ViewSampler, "draw", drawn)
    for span in (None, (0.04, 0.2)):
        simulate_together(request(largest_vehicle=span).simulations()[0])
    assert asked == [CAMERA_SAMPLING.largest_vehicle] * 4 + [(0.04, 0.2)] * 4


def test_only_a_seed_changes_the_style() -> None:
    own, moved, anew = (style(Town("town02", variant=variant)) for variant in (None, Variant(0), Variant(9)))
    assert own == moved
    assert (own.roads, own.terrain) == (anew.roads, anew.terrain)
    assert own.rows != anew.rows


def test_bays_are_those_of_the_scenery() -> None:
    anew = Town("town01", variant=Variant(2))
    assert bays_of(anew) == scenery(anew).bays
    assert bays_of(Town("town06", variant=Variant(0))) == scenery(Town("town06")).bays
    assert len(scenery(anew).bays) > 5


def test_town_jitter_without_views_keeps_the_sites_camera() -> None:
    made = request(views=0, town_jitter=True, cameras={}, recordings=1)
    (plan,) = made.plans()
    recording = simulate(plan)
    assert recording.camera.position == pytest.approx(plan.site.position)
    assert recording.town.variant
    assert not recording.town.variant.masts


def test_sites_that_are_tested_on_keep_their_cameras() -> None:
    made = from_preset("world", seed=0, renderer="gl", driver="", rules=Rules(), frames=12, sites=("t01_school_lane",))
    assert [plan.variation.views for plan in made.plans()] == [0]
