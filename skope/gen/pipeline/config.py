"""Presets (`presets.toml`), the requested dataset, and the plans of its recordings.

A plan gives the split, weather, hour and traffic of a recording.
"""

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib import resources
from typing import Any, Final

from skope.camera.model import Distortion
from skope.errors import UserError, one_of
from skope.gen.generation_site import OwnSite
from skope.gen.labels.ignore_rules import Rules
from skope.gen.output.parameters import DatasetPlan, OwnSiteRecord, Parameters
from skope.gen.output.writers import DATASET_FORMATS
from skope.gen.render.lens import pinhole_of
from skope.gen.scene import camera_sampling
from skope.gen.scene.conditions import TIMES_OF_DAY, check_settings
from skope.gen.scene.random_streams import Stream, rng
from skope.gen.scene.recording import RecordingPlan
from skope.gen.scene.variation import Variation
from skope.gen.towns.sites import Site, site, sites
from skope.gen.traffic.sumo import step_for
from skope.gen.vehicles.fleet import fleet
from skope.records import check_whole
from skope.schema import WEATHER_NAMES
from skope.types import Range


@cache
def preset_tables() -> Mapping[str, Any]:
    """Return the content of `presets.toml`."""
    return tomllib.loads(resources.files("skope.gen.pipeline").joinpath("presets.toml").read_text(encoding="utf-8"))


def presets() -> Mapping[str, Mapping[str, Any]]:
    """Return the presets by name."""
    presets: Mapping[str, Mapping[str, Any]] = preset_tables()["presets"]
    return presets


def range_pairs(table: Mapping[str, Sequence[float]]) -> dict[str, Range]:
    """Convert the two-number lists of a table to ranges."""
    return {name: (low, high) for name, (low, high) in table.items()}


_OF_HOUR: Final = ("sun_elevation_deg", "sun_azimuth_deg")
_OF_WEATHER: Final = ("clouds", "visibility_m")
"""Conditions that follow from the weather; a site's own values apply only while its own weather is used."""
LIGHT_TURNS: Final = 30
"""Number of possible starting positions of a site in a cycle of lights."""


def in_its_light(
    base: Site, index: int, seed: int, traffic: Range | None = None, lights: Sequence[str] | None = None
) -> Site:
    """Return a site with the weather, hour and traffic of its recording `index`.

    Recording 0 has those of the site. Later recordings cycle through the lights in the table of the site's split in
    `presets.toml`. Their traffic is the site's vehicles per hour times a factor from the table's range, sampled with
    `seed`. `traffic` replaces the range of the table.

    `lights` replaces the lights of the table. Each site then starts with another light, sampled with `seed`, so that a
    few recordings contain all lights.
    """
    splits = preset_tables()["splits"]
    split = splits.get(base.split, splits["train"])
    busy = _with_traffic(base, index, seed, traffic or split["traffic"])
    if index == 0:
        return busy if traffic else base
    if lights:
        return _under_light(busy, lights[(index + _first_light(base, seed, 0)) % len(lights)])
    lights = split["light"]
    if base.road:
        # The site file determines the light of the first recording, so the others use other hours.
        lights = [light for light in lights if light.split()[1] != base.time_of_day]
    return _under_light(busy, lights[(index - 1) % len(lights)])


def in_its_split(base: Site, index: int, seed: int, splits: Sequence[str]) -> Site:
    """Return a site in the split of its recording `index`, with the light and traffic of that split in `presets.toml`.

    The recordings cycle through the splits. Each time a split returns, its next light is used. The first light is
    sampled with `seed`.
    """
    turn, split_index = divmod(index, len(splits))
    table = preset_tables()["conditions"][splits[split_index]]
    busy = _with_traffic(replace(base, split=splits[split_index]), index, seed, table["traffic"])
    lights = table["light"]
    lit = _under_light(busy, lights[(turn + _first_light(base, seed, split_index)) % len(lights)])
    return replace(lit, conditions={**lit.conditions, **range_pairs(table.get("settings", {}))})


def in_asked_light(planned: Site, index: int, seed: int, weathers: Sequence[str], times_of_day: Sequence[str]) -> Site:
    """Return a site with the light of its recording `index`, limited to the requested weathers and hours.

    A weather or hour that was not requested is replaced by a requested one. The recordings cycle through the requested
    values, starting at one that is sampled with `seed` for each site. An empty list leaves the planned value.
    """
    turn = index + _first_light(planned, seed, 0)
    weather, time_of_day = planned.weather, planned.time_of_day
    if weathers and weather not in weathers:
        weather = weathers[turn % len(weathers)]
    if times_of_day and time_of_day not in times_of_day:
        # Weathers change faster than hours, so that all combinations occur.
        time_of_day = times_of_day[turn // max(len(weathers), 1) % len(times_of_day)]
    weather_fields = _OF_WEATHER if weather != planned.weather else ()
    hour_fields = _OF_HOUR if time_of_day != planned.time_of_day else ()
    fixed = _without(planned.conditions, weather_fields + hour_fields)
    return replace(planned, weather=weather, time_of_day=time_of_day, conditions=fixed)


def varied(planned: Site) -> Site:
    """Return a site with the wide ranges of conditions that `presets.toml` has for its weather and hour."""
    table: Mapping[str, Any] = preset_tables()["varied_light"]
    wide = {**table.get(planned.time_of_day, {}), **table.get(planned.weather, {})}
    return replace(planned, conditions={**range_pairs(wide), **planned.conditions})


def _first_light(base: Site, seed: int, draw_index: int) -> int:
    """Sample the position in a cycle of lights at which a site starts. Each `draw_index` gives another sample."""
    return int(rng(seed, base.name, draw_index, Stream.ASKED_LIGHT).integers(LIGHT_TURNS))


def _with_traffic(base: Site, index: int, seed: int, traffic: Range) -> Site:
    share = rng(seed, base.name, index, Stream.TRAFFIC_SHARE).uniform(*traffic)
    return replace(base, vehicles_per_hour=round(base.vehicles_per_hour * share, 1))


def _under_light(base: Site, light: str) -> Site:
    """Return a site with a weather and hour, given as text such as "clear noon"."""
    weather, time_of_day = light.split()
    fixed = _without(base.conditions, _OF_WEATHER + _OF_HOUR)
    return replace(base, weather=weather, time_of_day=time_of_day, conditions=fixed)


def _without(conditions: Mapping[str, Range], names: Sequence[str]) -> dict[str, Range]:
    return {name: pair for name, pair in conditions.items() if name not in names}


HEAVY_TYPES: Final = frozenset(("bus", "truck", "box_truck", "articulated_truck", "articulated_bus"))
"""Vehicle types that count as heavy (`heavy` in `presets.toml`)."""


@dataclass(frozen=True)
class DatasetRequest:
    """A requested dataset: its parameters, and the user's own site (the parameters hold only its digests).

    Raises UserError with the name of the flag if a parameter is out of range.
    """

    parameters: Parameters
    user_site: OwnSite | None = None

    def __post_init__(self) -> None:
        p = self.parameters
        p.pixels()
        one_of("--format", p.format, DATASET_FORMATS)
        if not all(p.sites) or not p.sites or len(set(p.sites)) < len(p.sites):
            raise UserError("--sites: expected one or more different sites, separated by commas")
        for name in p.sites:
            self.site(name)
        for frames in p.frames.values():
            check_whole("--frames", frames, 1)
        check_whole("--recordings", p.recordings, 1)
        check_whole("--seed", p.seed)
        if not 5 <= p.fov_deg <= 150:
            raise UserError(f"--fov: expected degrees from 5 to 150, got {p.fov_deg}")
        step_for(p.interval_s)
        check_settings(p.variation.settings)
        check_settings(p.variation.night)
        camera_sampling.check_ranges(p.variation.cameras)
        self._check_lens()
        for flag, asked, known in (
            ("--weather", p.weather, WEATHER_NAMES),
            ("--time-of-day", p.time_of_day, TIMES_OF_DAY),
        ):
            for name in asked:
                one_of(flag, name, known)
            if len(set(asked)) < len(asked):
                raise UserError(f"{flag}: expected different names, got {','.join(asked)}")
        self._check_vehicles()
        check_whole("--views", p.variation.views, 0, 16)
        if p.variation.largest_vehicle:
            camera_sampling.check_largest_vehicle(p.variation.largest_vehicle)
        if self.user_site:
            self._check_user_site(self.user_site)

    def _check_vehicles(self) -> None:
        p = self.parameters
        if p.vehicle_share is not None:
            if not p.vehicles:
                raise UserError("--share: applies to the models of --vehicles, but there are none; add --vehicles")
            if not 0 < p.vehicle_share <= 1:
                raise UserError(f"--share: expected a share above 0 and up to 1, got {p.vehicle_share:g}")
        for name in p.vehicles.keys() & fleet().keys():
            if p.vehicle_share is None and name in fleet(further=p.variation.further_models):
                raise UserError(
                    f"--vehicles {name}: is a model of the fleet and in the traffic anyway; "
                    "set its share of the traffic with --share"
                )
            learnt = [info.site for info in self.dataset_plan().recordings if info.split == "train"]
            if fleet()[name].held_out and learnt:
                raise UserError(
                    f"--vehicles {name}: is held out for test sites, but {learnt[0]} is a training site; "
                    "choose other --sites, or another model of `skope gen vehicles list`"
                )

    def _check_lens(self) -> None:
        """Raise a UserError if the strongest distortion at the widest angle would fold the image."""
        p, settings = self.parameters, self.parameters.variation.settings
        widest = p.variation.cameras.get("fov_deg", (p.fov_deg, p.fov_deg))[1]
        low, high = map(round, settings.get("fisheye", (0.0, 0.0)))
        for k1 in set(settings.get("k1", (0.0, 0.0))):
            for model in ("brown", "fisheye")[low : high + 1]:
                if k1 or model == "fisheye":
                    lens = Distortion(model, (k1, 0.0, 0.0, 0.0))
                    pinhole_of(self.site(p.sites[0]).camera(p.pixels(), widest, lens))

    def _check_user_site(self, user_site: OwnSite) -> None:
        p, variation = self.parameters, self.parameters.variation
        if p.recordings != len(user_site.splits):
            raise UserError(
                f"--recordings: expected {len(user_site.splits)}, as {user_site.path} has that number of splits, "
                f"got {p.recordings}"
            )
        camera, photograph, (width, height) = user_site.road.camera, user_site.road.photograph, p.pixels()
        if abs(width * camera.height / (height * camera.width) - 1) > 0.01:
            raise UserError(
                f"--size {p.size}: the camera of {user_site.path} has {camera.width}x{camera.height}; "
                "expected a size with the same aspect ratio"
            )
        lens = next((name for name in ("k1", "fisheye") if name in variation.settings), None)
        if lens and (photograph or camera.distortion.model != "none"):
            raise UserError(f"--set {lens}: {user_site.path} already sets the distortion of its camera")
        if photograph and (p.weather or p.time_of_day):
            flag = "--weather" if p.weather else "--time-of-day"
            raise UserError(f"{flag}: {user_site.path} has a photograph, which sets the light of all recordings")
        if variation.views or variation.town_jitter:
            flag = "--views" if variation.views else "--town-jitter"
            raise UserError(f"{flag}: {user_site.path} is a road of your own; only towns of the package can vary")
        if variation.cameras and photograph:
            raise UserError(f"{user_site.path}: a photograph shows the road from one camera only; cameras cannot vary")
        if variation.cameras.keys() & {"fov_deg", "height_m", "pitch_deg"}:
            raise UserError(f"--preset {p.preset}: {user_site.path} sets the pose of its camera (try --camera-jitter)")

    def site(self, name: str) -> Site:
        """Return the site with the given name. Raises UserError with a list of all names if there is none."""
        return self.user_site.site if self.user_site else site(name)

    def plans(self) -> list[RecordingPlan]:
        """Return one plan per recording, site by site; a site's frames are divided evenly among its recordings."""
        return [
            self._plan(name, index, frames)
            for name in self.parameters.sites
            for index, frames in enumerate(_share_out(self.frames_of(name), self.parameters.recordings))
        ]

    def _plan(self, name: str, index: int, frames: int) -> RecordingPlan:
        p, planned = self.parameters, self._in_its_light(name, index)
        plan = RecordingPlan(
            site=planned,
            index=index,
            frames=frames,
            interval=p.interval_s,
            size=p.pixels(),
            fov_deg=p.fov_deg,
            seed=p.seed,
            variation=p.variation if self.site(name).split == "train" else replace(p.variation, views=0),
        )
        return replace(plan, **self._asked_vehicles(plan))

    def simulations(self) -> list[tuple[RecordingPlan, ...]]:
        """Return the plans, grouped by shared traffic."""
        groups: dict[tuple[str, int], list[RecordingPlan]] = {}
        for plan in self.plans():
            groups.setdefault((plan.site.name, plan.leader), []).append(plan)
        return [tuple(group) for group in groups.values()]

    def _in_its_light(self, name: str, index: int) -> Site:
        """Return the site with the weather, hour and traffic of its recording `index`."""
        p, row = self.parameters, presets()[self.parameters.preset]
        if self.user_site is not None:
            base = replace(self.user_site.site, split=self.user_site.splits[index])
            # A photograph shows one light, so all recordings have it.
            planned = base if self.user_site.road.photograph else in_its_light(base, index, p.seed)
        elif "splits" in row:
            planned = in_its_split(site(name), index, p.seed, row["splits"])
        else:
            planned = in_its_light(site(name), index, p.seed, p.traffic, row.get("light"))
        lit = in_asked_light(planned, index, p.seed, p.weather, p.time_of_day)
        return varied(lit) if row.get("varied_light") and self.user_site is None else lit

    def _asked_vehicles(self, plan: RecordingPlan) -> dict[str, Any]:
        """Return the plan's fields for requested models, or for the heavy vehicles of the preset or split."""
        p, row = self.parameters, presets()[self.parameters.preset]
        share = None if self.user_site else preset_tables()["conditions"].get(plan.site.split, {}).get("heavy")
        if "heavy" in row and not self.user_site:
            share = round(float(plan.shared_rng(Stream.HEAVY_SHARE).uniform(*row["heavy"])), 3) or None
        if p.vehicles or share is None:
            return {"vehicles": tuple(p.vehicles), "vehicle_share": p.vehicle_share}
        models, learnt = fleet(further=p.variation.further_models), plan.site.split == "train"
        heavy = [
            name
            for name, entry in models.items()
            if entry.vehicle.vehicle_type in HEAVY_TYPES and not (learnt and entry.held_out)
        ]
        return {"vehicles": tuple(heavy), "vehicle_share": share}

    def frames_of(self, name: str) -> int:
        """Return the number of frames of a site; if its split is not in `frames`, that of the first split."""
        frames = self.parameters.frames
        return frames.get(self.site(name).split, next(iter(frames.values())))

    def dataset_plan(self) -> DatasetPlan:
        """Return the plan of the dataset's folder."""
        return DatasetPlan(self.parameters, tuple(plan.info for plan in self.plans()))

    @property
    def images(self) -> int:
        """Number of images that the dataset will contain."""
        return sum(self.frames_of(name) for name in self.parameters.sites)


def _share_out(frames: int, recordings: int) -> list[int]:
    """Divide frames as evenly as possible among recordings; there are at most as many recordings as frames."""
    count = min(recordings, frames)
    return [frames // count + (i < frames % count) for i in range(count)]


def from_preset(
    preset: str,
    *,
    seed: int,
    renderer: str,
    driver: str,
    rules: Rules,
    frames: int | None = None,
    user_site: OwnSite | None = None,
    camera_jitter: bool = False,
    settings: Mapping[str, Range] | None = None,
    **overrides: Any,
) -> DatasetRequest:
    """Return the dataset of a preset with changes.

    Args:
        preset: Name of a preset in `presets()`.
        seed: Seed of all random numbers, from 0.
        renderer: "gl" or "pybullet".
        driver: Driver of the renderer, as `choose_renderer` names it.
        rules: Rules for labels and ignored road users.
        frames: Frames per site; replaces the preset's number.
        user_site: User's own site, which replaces the preset's sites; its file gives the camera and the image size.
        camera_jitter: Whether the pose of the camera varies slightly between recordings.
        settings: Ranges of conditions that override those of the preset.
        overrides: Other fields of `Parameters`, or of its `variation`; None keeps the preset's value.

    Raises:
        UserError: The preset is unknown, or a value is out of range.
    """
    row = presets()[one_of("--preset", preset, tuple(presets()))]
    known = {f.name for f in (*fields(Parameters), *fields(Variation))}
    values = {name: value for name, value in row.items() if name in known}
    values["time_of_day"] = tuple(row.get("time_of_day", ()))
    of_splits = (name for split in row["frames"] for name in sites() if site(name).split == split)
    values["sites"] = tuple(row.get("sites", of_splits))
    if user_site is not None:
        user_site, camera = (
            user_site.with_recordings(overrides.get("recordings") or row["recordings"]),
            user_site.road.camera,
        )
        values |= {
            "own": _record_of(user_site),
            "sites": (user_site.site.name,),
            "recordings": len(user_site.splits),
            "size": f"{camera.width}x{camera.height}",
            "fov_deg": round(math.degrees(2 * math.atan(camera.width / 2 / camera.K[0, 0])), 3),
        }
    values |= {name: value for name, value in overrides.items() if value is not None}
    if "recording_frames" in row and overrides.get("recordings") is None:
        longest = max(values["frames"].values()) if frames is None else frames
        values["recordings"] = max(1, math.ceil(longest / row["recording_frames"]))
    for name in ("traffic", "largest_vehicle", "distractors", "lit_objects"):
        values[name] = tuple(row[name]) if name in row else None
    by_day = range_pairs(row.get("settings", {}))
    values["settings"] = by_day | dict(settings or {})
    # The command on a card repeats the preset's settings: values equal to the preset's must not change the nights.
    changed = {name for name, pair in (settings or {}).items() if pair != by_day.get(name)}
    values["night"] = {name: pair for name, pair in range_pairs(row.get("night", {})).items() if name not in changed}
    values["cameras"] = range_pairs(
        row.get("cameras", {}) | (preset_tables()["camera_jitter"] if camera_jitter else {})
    )
    if frames is not None:
        values["frames"] = dict.fromkeys(row["frames"], frames)
    variation = Variation(**{f.name: values.pop(f.name) for f in fields(Variation) if f.name in values})
    parameters = Parameters(
        preset=preset, seed=seed, renderer=renderer, driver=driver, rules=rules, variation=variation, **values
    )
    return DatasetRequest(parameters, user_site)


def _record_of(user_site: OwnSite) -> OwnSiteRecord:
    return OwnSiteRecord(
        file=user_site.path.name,
        digests=dict(user_site.digests),
        town=user_site.road.name,
        photograph=bool(user_site.road.photograph),
        splits=user_site.splits,
    )
