"""Style of a town, read from its `town.toml` and the building kinds that all towns share; and seasons.

A season sets the colours of grass and leaves and the fraction of bare trees.
"""

import colorsys
import tomllib
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Final, Literal

import numpy as np

from skope.gen.towns.town import Town, town_folder, towns
from skope.types import Range


@dataclass(frozen=True, eq=False)
class Season:
    """Appearance of a town's plants in a season."""

    colors: Mapping[str, tuple[float, float, float]]
    """Colours of plant materials, sRGB in 0..1."""
    bare: float
    """Fraction of the broad-leaved trees without leaves."""


@dataclass(frozen=True, kw_only=True)
class _SeasonKind:
    """Ranges of hue (degrees), saturation and value (0..1) in sRGB from which the colours of a kind of season are
    sampled.
    """

    share: float
    grass: tuple[Range, Range, Range]
    leaves: tuple[Range, Range, Range]
    bare: Range = (0.0, 0.0)


_SEASON_KINDS: Final = (
    _SeasonKind(  # fresh green
        share=0.08,
        grass=((70, 88), (0.36, 0.48), (0.36, 0.44)),
        leaves=((76, 98), (0.42, 0.58), (0.33, 0.42)),
    ),
    _SeasonKind(  # summer
        share=0.14,
        grass=((64, 80), (0.24, 0.36), (0.36, 0.42)),
        leaves=((72, 92), (0.28, 0.42), (0.30, 0.38)),
    ),
    _SeasonKind(  # grey-green
        share=0.30,
        grass=((55, 80), (0.08, 0.20), (0.34, 0.46)),
        leaves=((60, 110), (0.08, 0.22), (0.24, 0.36)),
        bare=(0.0, 0.15),
    ),
    _SeasonKind(  # dry
        share=0.20,
        grass=((38, 50), (0.16, 0.36), (0.42, 0.58)),
        leaves=((50, 72), (0.12, 0.28), (0.27, 0.37)),
        bare=(0.0, 0.15),
    ),
    _SeasonKind(  # autumn
        share=0.10,
        grass=((44, 60), (0.14, 0.28), (0.34, 0.44)),
        leaves=((22, 48), (0.30, 0.58), (0.30, 0.46)),
        bare=(0.1, 0.6),
    ),
    _SeasonKind(  # winter
        share=0.18,
        grass=((36, 60), (0.06, 0.22), (0.30, 0.44)),
        leaves=((50, 120), (0.05, 0.20), (0.20, 0.30)),
        bare=(0.7, 1.0),
    ),
)
_PLANT_COLORS: Final[Mapping[str, tuple[str, float]]] = {
    "meadow": ("grass", 1.08),
    "field_green": ("grass", 0.95),
    "grass": ("grass", 1.0),
    "leaves": ("leaves", 1.0),
    "leaves_dark": ("leaves", 0.72),
    "leaves_pale": ("leaves", 1.2),
    "hedge": ("leaves", 0.72),
    "woods": ("leaves", 0.75),
}
"""Colour range of a season kind that each material uses, and the factor on its brightness."""
_SPREAD_DEG: Final = 6.0
"""Spread between the hues of materials that use the same range, degrees."""


def drawn_season(rng: np.random.Generator) -> Season:
    """Sample a season: its kind by share, its colours and fraction of bare trees uniformly from the kind's ranges."""
    shares = np.array([kind.share for kind in _SEASON_KINDS])
    kind = _SEASON_KINDS[int(rng.choice(len(_SEASON_KINDS), p=shares / shares.sum()))]
    drawn = {name: [rng.uniform(*span) for span in getattr(kind, name)] for name in ("grass", "leaves")}
    colors = {}
    for material, (name, lighter) in _PLANT_COLORS.items():
        hue, saturation, value = drawn[name]
        turned = (hue + rng.uniform(-_SPREAD_DEG, _SPREAD_DEG)) / 360
        colors[material] = colorsys.hsv_to_rgb(turned, saturation, min(1.0, value * lighter))
    colors["leaves_lit"] = colors["leaves_pale"]
    return Season(colors, float(rng.uniform(*kind.bare)))


@dataclass(frozen=True, kw_only=True)
class Road:
    """Features of all edges of one SUMO edge type."""

    form: Literal["ground", "walled", "bridge"] = "ground"
    """Position of the road: on the ground or a bank; between retaining walls; on a deck over another road."""
    sidewalk: float = 0.0
    """Width of the sidewalk, metres; 0 for none."""
    shoulder: float = 0.0
    """Width of the paved strip beside the lanes, metres."""
    main: bool = False
    """Whether the road is a main road, with shops, bus stops and more furniture."""
    edge_lines: bool = False
    guard_rails: bool = False
    lights: float = 0.0
    """Distance between street lights, metres; 0 for none."""
    wires: bool = False
    """Whether there are utility poles with wires along the road."""

    @property
    def verge(self) -> float:
        """Width of the strip beside the lanes at their height, metres."""
        return max(self.sidewalk, self.shoulder) + 0.8


@dataclass(frozen=True, kw_only=True)
class Terrain:
    """Shape of the ground away from roads."""

    level: float = 0.0
    waves: tuple[tuple[float, float, float, float], ...] = ()
    """Amplitude and length (metres), direction and phase (degrees) of each of the waves that form the ground."""
    slope: float = 0.5
    """Slope (rise over run) of banks beside roads that are higher or lower than the ground."""


@dataclass(frozen=True, kw_only=True)
class BuildingKind:
    """A kind of building; values are sampled uniformly from ranges and lists. Lengths in metres."""

    form: Literal["house", "tower", "hall", "barn", "silo"] = "house"
    length: Range
    """Range of the length along the street, metres."""
    depth: Range
    storeys: tuple[int, int] = (2, 3)
    ground: float = 2.95
    """Height of the ground floor, metres."""
    storey: float = 2.8
    walls: tuple[str, ...]
    roofs: tuple[str, ...] = ("tiles", "slate")
    roof: Literal["gabled", "mixed", "flat"] = "mixed"
    frames: tuple[str, ...] = ("frame",)
    bay: Range = (2.3, 3.1)
    window: Range = (0.95, 1.35)
    """Range of the width of windows, metres."""
    pane: Range = (1.35, 1.6)
    """Range of the height of windows, metres."""
    terraced: bool = False
    """Whether buildings adjoin their neighbours."""
    shop: bool = False
    balconies: bool = False
    shutters: bool = False
    drive: bool = False
    """Whether some of the buildings have a drive beside them."""
    parking: float = 0.0
    """Depth of the car park in front of the building, metres; 0 for none."""
    garden: bool = True


@dataclass(frozen=True, kw_only=True)
class ObjectRow:
    """Row of buildings along some of the roads; at each place, the first row that fits is used."""

    roads: tuple[str, ...] = ()
    """SUMO edge types of the roads; empty for all."""
    within: float = 1e9
    """Maximum distance from the nearest signalled junction, metres."""
    kinds: Mapping[str, float]
    """Shares of the building kinds."""
    setback: Range = (3.2, 6.5)
    """Range of the distance from the sidewalk to the front, metres."""
    gap: Range = (3.0, 8.0)
    """Range of the gap between neighbours that are not terraced, metres."""
    empty: float = 0.0
    """Fraction of the places that are left open."""


@dataclass(frozen=True, kw_only=True)
class Planting:
    """Line of trees along roads."""

    spacing: float
    offset: float
    """Distance from the kerb, metres."""
    chance: float
    wander: float = 0.25
    """Scatter of the trees around their regular positions, as a fraction of the offset."""
    roads: tuple[str, ...] = ()
    """SUMO edge types of the roads; empty for all roads on the ground."""


@dataclass(frozen=True, kw_only=True)
class Gantry:
    """Sign gantry over an edge."""

    edge: str
    at: float
    """Position along the edge, metres; negative values count from its end."""
    signs: tuple[str, ...]
    """Colour material of each sign, from left to right."""


@dataclass(frozen=True, kw_only=True)
class TownStyle:
    """Complete style of a town."""

    title: str
    kerb: float = 0.12
    """Height of kerbs, metres; 0 for roads without kerbs."""
    terrain: Terrain = Terrain()
    roads: Mapping[str, Road]
    """Features of roads, by SUMO edge type."""
    road: Road = Road()
    """Features of all other roads."""
    rows: tuple[ObjectRow, ...]
    behind: Mapping[str, float] = field(default_factory=dict)
    """Shares of building kinds behind the rows."""
    kinds: Mapping[str, BuildingKind]
    species: Mapping[str, float]
    """Shares of tree species."""
    planting: tuple[Planting, ...]
    median: str = "grass"
    """Ground material of medians and islands."""
    median_trees: float = 0.0
    """Probability of a tree in a median, every 11 m."""
    median_rails: bool = False
    open_ground: tuple[str, ...] = ("grass",)
    """Ground materials away from the streets; more than one gives fields."""
    plaza: float = 0.0
    """Width of the paved ground beside sidewalks at places without buildings, metres."""
    interchange: float = 0.0
    """Distance from roads up to which enclosed ground is left without buildings, metres."""
    fields_from: float = 60.0
    """Minimum distance of fields from roads, metres."""
    fences: Mapping[str, float] = field(default_factory=lambda: {"hedge": 1.0})
    """Shares of the kinds of fences and hedges around front gardens and open ground."""
    light: Literal["curved", "mast", "double", "timber"] = "curved"
    """Shape of the street lights."""
    furniture: Mapping[str, float] = field(default_factory=dict)
    """Shares of the kinds of furniture on sidewalks."""
    gantries: tuple[Gantry, ...] = ()
    barriers: tuple[tuple[str, float, float], ...] = ()
    """Noise barriers: edge, start and end (metres along the edge)."""
    horizon: Literal["hills", "skyline"] = "hills"
    hill_height: float = 1.0
    """Height of the hills around the town, as a multiple of 22 m."""
    season: Season | None = None
    """Season, which sets the colours of plants and the fraction of bare trees; None for the default summer."""


@lru_cache(maxsize=64)
def style(town: Town) -> TownStyle:
    """Return the style of a town or of its variant."""
    if town.variant and town.variant.season:
        without_season = replace(town, variant=replace(town.variant, season=0))
        return replace(style(without_season), season=drawn_season(np.random.default_rng(town.variant.season)))
    if town.variant and town.variant.seed:
        rng = np.random.default_rng([zlib.crc32(town.name.encode()), town.variant.seed])
        return varied_style(style(Town(town.name)), [style(other_town) for other_town in towns()], rng)
    row = _read(town)
    town_kinds = row.pop("kinds", {})
    shared = tomllib.loads(town_folder("buildings.toml").read_text(encoding="utf-8"))
    used = {name for part in (*row.get("rows", []), {"kinds": row.get("behind", {})}) for name in part["kinds"]}
    return TownStyle(
        terrain=Terrain(**_fixed(row.pop("terrain", {}))),
        roads={name: Road(**values) for name, values in row.pop("roads", {}).items()},
        road=Road(**row.pop("road", {})),
        kinds={
            name: BuildingKind(**_fixed({**shared.get(name, {}), **town_kinds.get(name, {})})) for name in sorted(used)
        },
        rows=tuple(ObjectRow(**_fixed(values)) for values in row.pop("rows", [])),
        planting=tuple(Planting(**_fixed(values)) for values in row.pop("planting", [])),
        gantries=tuple(Gantry(**_fixed(values)) for values in row.pop("gantries", [])),
        **_fixed(row),
    )


def varied_style(base: TownStyle, all_styles: Sequence[TownStyle], rng: np.random.Generator) -> TownStyle:
    """Sample the style of another place of the same kind: new roadside objects along the same roads.

    Args:
        base: Style of the town.
        all_styles: Styles of all towns, which provide trees, fences, street lights and open ground.
        rng: Random generator.
    """

    def from_any_town(name: str) -> Any:
        """Sample a value of a town's style.

        If the base style's value is empty, return that: its roads have no room for objects.
        """
        values = [getattr(town_style, name) for town_style in all_styles if getattr(town_style, name)]
        return getattr(base, name) and values[int(rng.integers(len(values)))]

    def scaled(pair: Range, factor: float) -> Range:
        return pair[0] * factor, pair[1] * factor

    def some(names: tuple[str, ...], most: int) -> tuple[str, ...]:
        count = int(rng.integers(1, min(most, len(names)) + 1))
        return tuple(names[i] for i in sorted(rng.choice(len(names), count, replace=False)))

    def shares(of: Mapping[str, float]) -> Mapping[str, float]:
        return {name: share * float(rng.lognormal(0.0, 0.8)) for name, share in of.items()}

    kinds = {
        name: replace(
            kind,
            walls=some(kind.walls, 3),
            roofs=some(kind.roofs, 2),
            frames=some(kind.frames, 2),
            storeys=(max(1, kind.storeys[0] - int(rng.integers(0, 2))), kind.storeys[1] + int(rng.integers(0, 2)))
            if kind.form in ("house", "tower")
            else kind.storeys,
            bay=scaled(kind.bay, float(rng.uniform(0.9, 1.2))),
        )
        for name, kind in base.kinds.items()
    }
    rows = tuple(
        replace(
            row,
            kinds=shares(row.kinds),
            setback=scaled(row.setback, float(rng.uniform(1.0, 1.8))),
            gap=scaled(row.gap, float(rng.uniform(0.7, 2.2))),
            empty=min(0.85, row.empty + max(0.0, float(rng.uniform(-0.3, 0.5)))),
        )
        for row in base.rows
    )
    planting = tuple(
        replace(
            line, spacing=line.spacing * float(rng.uniform(0.8, 1.6)), chance=line.chance * float(rng.uniform(0, 1.2))
        )
        for line in base.planting
    )
    return replace(
        base,
        kinds=kinds,
        rows=rows,
        planting=planting,
        species=shares(from_any_town("species")),
        fences=shares(from_any_town("fences")),
        furniture=shares(from_any_town("furniture")),
        light=from_any_town("light"),
        open_ground=from_any_town("open_ground"),
        horizon=from_any_town("horizon"),
        hill_height=base.hill_height * float(rng.uniform(0.3, 1.8)),
        median_trees=base.median_trees * float(rng.uniform(0.0, 1.5)),
    )


def _read(town: Town) -> dict[str, Any]:
    road = town.road
    path = (
        town_folder(town.name) / "town.toml"
        if road is None
        else town_folder("bare.toml" if road.photograph else "generic.toml")
    )
    return tomllib.loads((road and road.style) or path.read_text(encoding="utf-8"))


def _fixed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Convert lists to tuples recursively."""

    def fix(value: Any) -> Any:
        return tuple(fix(item) for item in value) if isinstance(value, list) else value

    return {name: fix(value) for name, value in values.items()}


def drawn_name(shares: Mapping[str, float], rng: np.random.Generator) -> str:
    """Sample a name with a probability proportional to its share."""
    names, weights = list(shares), np.array(list(shares.values()))
    return names[rng.choice(len(names), p=weights / weights.sum())]
