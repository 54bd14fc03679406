"""The fleet: vehicle models by name, each a style and a point in its type's shape space."""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property, lru_cache
from importlib import resources
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.errors import UserError, one_of
from skope.gen.cache import Arrays, cached, digest_of
from skope.gen.mesh import Mesh
from skope.gen.vehicles.added import load
from skope.gen.vehicles.bus import BusBody
from skope.gen.vehicles.car import CarBody
from skope.gen.vehicles.model import Derived, Vehicle, simplified_parts
from skope.gen.vehicles.parts import SIGN_HEIGHT
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.truck import TruckBody
from skope.gen.vehicles.wheels import steel_wheel, wheel_mesh
from skope.schema import COLORS

Array = NDArray[np.float64]

_BODIES: Final[dict[str, Any]] = {"car": CarBody, "truck": TruckBody, "bus": BusBody}


class Paint(NamedTuple):
    """A vehicle's colours."""

    share: float
    """How often it is seen, relative to the others of its palette."""
    rgb: tuple[int, int, int]
    """sRGB of the body."""
    livery: tuple[int, int, int]
    """sRGB of what is of a second colour: a stripe, a box, the lower half."""
    color: str
    """What annotations call it: one of `skope.schema.COLORS`."""
    palette: str


def _private(share: float, name: str, rgb: tuple[int, int, int]) -> tuple[str, Paint]:
    return name, Paint(share, rgb, rgb, name, "private")


def _livery(
    name: str, share: float, color: str, rgb: tuple[int, int, int], livery: tuple[int, int, int]
) -> tuple[str, Paint]:
    return name, Paint(share, rgb, livery, color, name.split("_")[0])


_WHITE: Final = (226, 227, 224)
_CREAM: Final = (222, 208, 168)

PAINTS: Final[dict[str, Paint]] = dict(
    (
        _private(0.38, "white", _WHITE),
        _private(0.19, "black", (26, 26, 29)),
        _private(0.15, "grey", (95, 99, 104)),
        _private(0.09, "silver", (168, 172, 176)),
        _private(0.07, "blue", (31, 62, 122)),
        _private(0.05, "red", (140, 22, 24)),
        _private(0.03, "brown", (92, 66, 48)),
        _private(0.02, "yellow", (205, 160, 42)),
        _private(0.02, "green", (38, 74, 52)),
        _livery("taxi_yellow", 4, "yellow", (222, 168, 24), (30, 30, 32)),
        _livery("taxi_cream", 3, "other", _CREAM, _CREAM),
        _livery("taxi_black", 2, "black", (26, 26, 29), (66, 130, 62)),
        _livery("taxi_white", 2, "white", _WHITE, (196, 92, 30)),
        _livery("van_white", 9, "white", _WHITE, _WHITE),
        _livery("van_white_blue", 2, "white", _WHITE, (34, 80, 150)),
        _livery("van_white_red", 2, "white", _WHITE, (170, 30, 30)),
        _livery("van_white_green", 1, "white", _WHITE, (52, 120, 66)),
        _livery("van_silver", 3, "silver", (168, 172, 176), (168, 172, 176)),
        _livery("van_grey", 2, "grey", (86, 90, 96), (86, 90, 96)),
        _livery("van_yellow", 2, "yellow", (224, 172, 20), (180, 24, 24)),
        _livery("van_brown", 1, "brown", (74, 50, 34), (196, 150, 60)),
        _livery("van_blue", 2, "blue", (28, 58, 116), _WHITE),
        _livery("freight_white", 6, "white", _WHITE, (214, 215, 212)),
        _livery("freight_white_blue", 2, "white", _WHITE, (38, 84, 148)),
        _livery("freight_white_green", 2, "white", _WHITE, (46, 102, 70)),
        _livery("freight_red", 2, "red", (150, 24, 26), (214, 215, 212)),
        _livery("freight_red_red", 1, "red", (150, 24, 26), (146, 30, 30)),
        _livery("freight_blue", 3, "blue", (30, 66, 128), (206, 208, 208)),
        _livery("freight_green", 1, "green", (34, 80, 54), _CREAM),
        _livery("freight_yellow", 2, "yellow", (214, 164, 28), (72, 76, 82)),
        _livery("freight_orange", 1, "orange", (206, 96, 24), (214, 215, 212)),
        _livery("bus_red", 3, "red", (160, 24, 26), _CREAM),
        _livery("bus_blue", 2, "blue", (32, 74, 140), _WHITE),
        _livery("bus_green", 2, "green", (42, 104, 66), _CREAM),
        _livery("bus_yellow", 2, "yellow", (220, 168, 26), (70, 74, 80)),
        _livery("bus_white", 2, "white", _WHITE, (190, 36, 36)),
        _livery("bus_orange", 1, "orange", (206, 98, 26), _WHITE),
    )
)
"""Paints by the name that recordings keep.

Shares of private cars' colours are Axalta's Global Automotive Color Popularity Report of 2020 in whole per cent; it has
brown with beige and yellow with gold, and its last two per cent, other colours, are green here. Liveries have no such
source: their shares say only that plain white leads.
"""


def palette(vehicle: Vehicle) -> list[str]:
    """Names of the paints that a vehicle may have."""
    kind = vehicle.style.palette if isinstance(vehicle, ParametricVehicle) else "private"
    return [name for name, paint in PAINTS.items() if paint.palette == kind]


def draw_paint(vehicle: Vehicle, rng: np.random.Generator) -> str:
    """The name of a paint for a vehicle, by the shares of its palette."""
    names = palette(vehicle)
    shares = np.array([PAINTS[name].share for name in names])
    return names[rng.choice(len(names), p=shares / shares.sum())]


@dataclass(frozen=True)
class ParametricVehicle(Derived):
    """A model of the fleet: a style and a point in its type's shape space."""

    model: str
    vehicle_type: str
    shape: Shape
    style: VehicleStyle
    mass: float
    """Kilograms, laden with a driver."""
    substituted: tuple[str, ...] = ()
    """Keypoints that stand for a part that this body lacks."""

    @property
    def size_lwh(self) -> tuple[float, float, float]:
        s = self.shape
        return s.length, s.width, s.height + (SIGN_HEIGHT if self.style.sign else 0.0)

    @cached_property
    def _body(self) -> Arrays:
        """Surfaces and the left keypoints, by stem."""

        def build() -> Arrays:
            body: CarBody | TruckBody | BusBody = _BODIES[self.style.family](self.shape, self.style)
            return body.mesh.to_arrays("mesh") | body.interior.to_arrays("interior") | body.points

        return self._kept("vehicle", build)

    def _kept(self, kind: str, build: Callable[[], Arrays]) -> Arrays:
        """What is built of a model, on disk; a shape of a vehicle's own passes by once."""
        entry = fleet().get(self.model)
        if entry is None or entry.vehicle.shape != self.shape:
            return build()
        return cached(kind, digest_of(repr(self.shape), repr(self.style)), build)

    @cached_property
    def mesh(self) -> Mesh:
        """The body without wheels, closed, with its glass opaque."""
        mesh = Mesh.from_arrays(self._body, "mesh")
        # Of two indicators drawn on the left half and mirrored, the right one is the other lamp.
        name = "indicator_left"
        if name not in mesh.materials:
            return mesh
        right = mesh.vertices[mesh.triangles][:, :, 1].mean(axis=1) < 0
        of = mesh.materials.index(name)
        material = np.where((mesh.material == of) & right, len(mesh.materials), mesh.material)
        return Mesh(mesh.vertices, mesh.normals, mesh.triangles, (*mesh.materials, "indicator_right"), material)

    @cached_property
    def interior(self) -> Mesh:
        """What is seen through the windows; it lies inside `mesh`."""
        return Mesh.from_arrays(self._body, "interior")

    @cached_property
    def coarse(self) -> tuple[Mesh, ...]:
        """The parts for pictures from afar."""
        names = [f"part{i}" for i in range(len(self.parts))]

        def build() -> Arrays:
            parts = zip(names, simplified_parts(self.parts), strict=True)
            return {key: array for name, part in parts for key, array in part.to_arrays(name).items()}

        arrays = self._kept("coarse", build)
        return tuple(Mesh.from_arrays(arrays, name) for name in names)

    @cached_property
    def wheel(self) -> Mesh:
        """A left wheel about its centre; a right one is its mirror image."""
        radius, width = self.shape.wheel_radius, self.shape.wheel_width
        if self.style.family == "car":
            return wheel_mesh(radius, width, self.style.spokes)
        return steel_wheel(radius, width)

    @cached_property
    def points(self) -> Array:
        """(33, 3) keypoints at rest, metres."""
        left = self._body
        wheels = self.shape.wheel_centers()
        out = np.empty((keypoints.K, 3))
        for i, name in enumerate(keypoints.NAMES):
            stem = name.removesuffix("_left").removesuffix("_right")
            if i in keypoints.WHEELS:
                out[i] = wheels[i - keypoints.WHEELS[0]]
            else:
                out[i] = left[stem] * ([1, -1, 1] if name.endswith("_right") else [1, 1, 1])
        return out


@dataclass(frozen=True)
class FleetEntry:
    vehicle: Vehicle
    share: float
    """How often the model drives by, relative to the others."""
    held_out: bool = False
    """Kept for testing."""


def _table(name: str) -> dict[str, Any]:
    return tomllib.loads(resources.files("skope.gen.vehicles").joinpath(name).read_text(encoding="utf-8"))


@cache
def class_ranges(vehicle_type: str) -> Mapping[str, tuple[float, float]]:
    """What vehicles of a type measure, metres: least and greatest by dimension; nothing of those of no class."""
    ranges = _table("classes.toml").get(vehicle_type, {}).get("range", {})
    return {name: (low, high) for name, (low, high) in ranges.items()}


@cache
def fleet() -> Mapping[str, FleetEntry]:
    """All models of the package, by name; none is built yet."""
    classes = _table("classes.toml")
    return {name: _entry(name, row, classes[row["vehicle_type"]]) for name, row in _table("fleet.toml").items()}


def _entry(name: str, row: Mapping[str, Any], of_type: Mapping[str, Any]) -> FleetEntry:
    shape = Shape(**{**of_type["shape"], **row.get("shape", {})})
    choices: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in row["style"].items()}
    style = VehicleStyle(**choices)
    vehicle = ParametricVehicle(name, row["vehicle_type"], shape, style, row["mass"], tuple(row.get("substituted", ())))
    return FleetEntry(vehicle, row["share"], row.get("held_out", False))


def _parametric(model: str) -> ParametricVehicle:
    vehicle = fleet()[model].vehicle
    assert isinstance(vehicle, ParametricVehicle)
    return vehicle


@lru_cache(maxsize=256)
def _build(model: str, shape: tuple[tuple[str, float], ...]) -> ParametricVehicle:
    base = _parametric(model)
    try:
        return replace(base, shape=Shape(**dict(shape)))
    except TypeError as error:
        raise UserError(f"shape of {model}: {error}") from None


def build(model: str, shape: Mapping[str, float]) -> Vehicle:
    """The vehicle of a model with the given shape parameters (see `Shape`); equal ones are built once.

    A model that was added has one shape only.
    """
    if model not in fleet():
        return load(model)
    return _build(model, tuple(sorted(shape.items())))


_ALONG: Final = frozenset(
    (
        *("length", "wheelbase", "front_overhang", "cowl_setback", "screen_run", "backlight_run", "deck_length"),
        "cab_length",
    )
)
_ACROSS: Final = frozenset(("width", "track", "headlight_inner", "taillight_inner", "roof_inset"))
_UP: Final = frozenset(
    (
        *("height", "bumper_height", "headlight_low", "headlight_high", "taillight_low", "taillight_high"),
        *("hood_height", "cowl_height", "belt_height", "deck_height", "box_height", "clearance"),
    )
)
_STRETCH: Final = 0.025
"""Standard deviation of the share by which a jittered shape is longer, wider or higher than its model."""


def jittered(model: str, rng: np.random.Generator) -> Mapping[str, float]:
    """Shape parameters near a model's, within the ranges of its type: stretched along each axis, and slightly bent."""
    one_of("model", model, tuple(fleet()))
    vehicle = _parametric(model)
    ranges = class_ranges(vehicle.vehicle_type)
    whole = vehicle.shape.to_dict()
    scales = []
    for names in (_ALONG, _ACROSS, _UP):
        # One share for an axis, within what keeps all its dimensions in their ranges.
        bounds = [(ranges[name][0] / whole[name], ranges[name][1] / whole[name]) for name in names if name in ranges]
        low, high = max(bound[0] for bound in bounds), min(bound[1] for bound in bounds)
        scales.append((names, float(np.clip(1 + _STRETCH * rng.standard_normal(), low, high))))
    out = {}
    for name, value in whole.items():
        scale = next((scale for names, scale in scales if name in names), 1.0)
        out[name] = float(value * scale)
    for name in ("screen_run", "backlight_run", "roof_inset", "nose_round", "tail_round", "roof_droop", "nose_lean"):
        out[name] *= float(1 + 0.05 * np.clip(rng.standard_normal(), -2, 2))
    return out


assert {f.name for f in fields(Shape)} >= _ALONG | _ACROSS | _UP
assert all(set(entry.vehicle.substituted) <= set(keypoints.NAMES) for entry in fleet().values())
assert {paint.color for paint in PAINTS.values()} <= set(COLORS)
assert {_parametric(model).style.palette for model in fleet()} == {paint.palette for paint in PAINTS.values()}
