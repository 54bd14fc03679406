"""Split, weather, hour and traffic of each of a site's recordings, as presets and flags plan them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from skope.gen.pipeline.presets import range_pairs, tables
from skope.gen.scene.random_streams import Stream, rng
from skope.gen.towns.sites import Site
from skope.types import Range

_OF_HOUR: Final = ("sun_elevation_deg", "sun_azimuth_deg")
_OF_WEATHER: Final = ("clouds", "visibility_m")
"""Conditions that follow from weather and hour: a site's own values hold for its first recording only."""
_TURNS: Final = 30
"""Turns that a site may begin with among lights."""


def in_its_light(
    own: Site, index: int, seed: int, traffic: Range | None = None, lights: Sequence[str] | None = None
) -> Site:
    """A site with the weather, hour and traffic of its recording `index`.

    Recording 0 has the site's own. Later ones follow the table of the site's split in `presets.toml`: lights in turn,
    and a share of the site's vehicles an hour that `seed` draws. `traffic` replaces what the table says, `lights` too:
    each site begins with another one of these, which `seed` draws, so that few recordings show all of them.
    """
    splits = tables()["splits"]
    split = splits.get(own.split, splits["train"])
    busy = _busy(own, index, seed, traffic or split["traffic"])
    if index == 0:
        return busy if traffic else own
    if lights:
        return _under(busy, lights[(index + _begun(own, seed, 0)) % len(lights)])
    lights = split["light"]
    if own.road:
        # The site file decides the first recording's light: the others are at other hours.
        lights = [light for light in lights if light.split()[1] != own.time_of_day]
    return _under(busy, lights[(index - 1) % len(lights)])


def in_its_split(own: Site, index: int, seed: int, splits: Sequence[str]) -> Site:
    """A site in the split of its recording `index`, with light and traffic of that condition in `presets.toml`.

    The splits take turns from recording to recording; the lights of each take turns from site to site, begun with one
    that `seed` draws.
    """
    turn, place = divmod(index, len(splits))
    table = tables()["conditions"][splits[place]]
    busy = _busy(replace(own, split=splits[place]), index, seed, table["traffic"])
    lights = table["light"]
    lit = _under(busy, lights[(turn + _begun(own, seed, place)) % len(lights)])
    return replace(lit, conditions={**lit.conditions, **range_pairs(table.get("settings", {}))})


def in_asked_light(planned: Site, index: int, seed: int, weathers: Sequence[str], times_of_day: Sequence[str]) -> Site:
    """A site in the light of its recording `index`, where its weather or hour is not among those that are asked for.

    One that is asked for takes the place of one that is not: in turns from recording to recording, begun with one that
    `seed` draws for each site. Without names, each is as planned.
    """
    turn = index + _begun(planned, seed, 0)
    weather, time_of_day = planned.weather, planned.time_of_day
    if weathers and weather not in weathers:
        weather = weathers[turn % len(weathers)]
    if times_of_day and time_of_day not in times_of_day:
        # Weathers take their turns faster, so that each comes at each hour.
        time_of_day = times_of_day[turn // max(len(weathers), 1) % len(times_of_day)]
    other_weather = _OF_WEATHER if weather != planned.weather else ()
    other_hour = _OF_HOUR if time_of_day != planned.time_of_day else ()
    fixed = _without(planned.conditions, other_weather + other_hour)
    return replace(planned, weather=weather, time_of_day=time_of_day, conditions=fixed)


def varied(planned: Site) -> Site:
    """A site whose conditions vary as widely as `presets.toml` says of its weather and hour."""
    table: Mapping[str, Any] = tables()["varied_light"]
    wide = {**table.get(planned.time_of_day, {}), **table.get(planned.weather, {})}
    return replace(planned, conditions={**range_pairs(wide), **planned.conditions})


def _begun(own: Site, seed: int, place: int) -> int:
    """The one of the lights that a site begins with; `place` tells apart those that begin on their own."""
    return int(rng(seed, own.name, place, Stream.ASKED_LIGHT).integers(_TURNS))


def _busy(own: Site, index: int, seed: int, traffic: Range) -> Site:
    share = rng(seed, own.name, index, Stream.TRAFFIC_SHARE).uniform(*traffic)
    return replace(own, vehicles_per_hour=round(own.vehicles_per_hour * share, 1))


def _under(own: Site, light: str) -> Site:
    """A site in a light such as "clear noon"."""
    weather, time_of_day = light.split()
    fixed = _without(own.conditions, _OF_WEATHER + _OF_HOUR)
    return replace(own, weather=weather, time_of_day=time_of_day, conditions=fixed)


def _without(conditions: Mapping[str, Range], names: Sequence[str]) -> dict[str, Range]:
    return {name: pair for name, pair in conditions.items() if name not in names}
