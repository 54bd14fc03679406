"""Fleet: vehicle models by name, and random shapes near a model's shape.

Each model is a style and a point in its type's shape space. Random shapes make all vehicles of a dataset different.
"""

import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache, cached_property, lru_cache
from importlib import resources
from typing import Any, Final

import numpy as np

from skope import keypoints
from skope.errors import UserError, one_of
from skope.gen.cache import Arrays, cached, digest_of
from skope.gen.mesh import Mesh
from skope.gen.vehicles.bus import BusBody
from skope.gen.vehicles.cabin import ROOF_LOAD_HEIGHTS_M
from skope.gen.vehicles.car import CarBody
from skope.gen.vehicles.coaches import CityBusBody, CoachBody, DoubleDeckBody, SchoolBusBody, StepVanBody
from skope.gen.vehicles.jittered_parts import draw_details, styled
from skope.gen.vehicles.model import Derived, Trailer, Vehicle, simplified_parts
from skope.gen.vehicles.parts import PART_SIZES
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.trailer_body import TrailerBody
from skope.gen.vehicles.truck import ChassisCabBody, TruckBody
from skope.gen.vehicles.user_models import load_model
from skope.gen.vehicles.wheels import steel_wheel, wheel_mesh
from skope.types import Array

BODY_KINDS: Final[dict[str, Any]] = {
    "car": CarBody,
    "truck": TruckBody,
    "bus": BusBody,
    "chassis": ChassisCabBody,
    "city_bus": CityBusBody,
    "coach": CoachBody,
    "double_deck": DoubleDeckBody,
    "school_bus": SchoolBusBody,
    "step_van": StepVanBody,
}


@dataclass(frozen=True)
class ParametricVehicle(Derived):
    """Model of the fleet: a style and a point in its type's shape space."""

    model: str
    vehicle_type: str
    shape: Shape
    style: VehicleStyle
    mass: float
    """Mass with a driver, kilograms."""
    substituted: tuple[str, ...] = ()
    """Keypoints that are placed at a substitute because this body lacks their part."""
    size_class: str = ""
    """Table of `vehicle_dimensions.toml` with the ranges of its dimensions."""
    recurs: bool = field(default=False, compare=False)
    """Whether a shape other than the model's own also occurs in other recordings, so that it is cached on disk."""

    @property
    def size_lwh(self) -> tuple[float, float, float]:
        s = self.shape
        return (
            s.length,
            s.width,
            s.height
            + max(PART_SIZES.sign_height_m if self.style.sign else 0.0, ROOF_LOAD_HEIGHTS_M.get(self.style.load, 0.0)),
        )

    @cached_property
    def _body_arrays(self) -> Arrays:
        """Return the surfaces and the left keypoints, by stem."""

        def build() -> Arrays:
            body: CarBody | TruckBody | BusBody = BODY_KINDS[self.style.family](self.shape, self.style)
            arrays = body.mesh.to_arrays("mesh") | body.interior.to_arrays("interior") | body.points
            return {**arrays, **self._trailer_arrays()} if self.style.trailer else arrays

        return self._cached("vehicle", build)

    def _trailer_arrays(self) -> Arrays:
        """Return the trailer's surfaces in its own frame, and its left keypoints in the vehicle's frame."""
        body = TrailerBody(self.shape, self.style)
        inside: Arrays = body.interior.to_arrays("trailer_interior") if body.interior else {}
        points = {stem: point + [self.shape.hinge_x, 0.0, 0.0] for stem, point in body.points.items()}
        return {**body.mesh.to_arrays("trailer"), **inside, **points}

    def _cached(self, kind: str, build: Callable[[], Arrays]) -> Arrays:
        """Return the arrays that `build` makes of this shape, from the cache if the shape can recur."""
        entry = fleet().get(self.model)
        if not self.recurs and (entry is None or entry.vehicle.shape != self.shape):
            return build()
        return cached(kind, digest_of(repr(self.shape), repr(self.style)), build)

    @cached_property
    def mesh(self) -> Mesh:
        """Closed body without wheels, with opaque glass."""
        return _with_right_indicators(Mesh.from_arrays(self._body_arrays, "mesh"))

    @cached_property
    def trailer(self) -> Trailer | None:
        s, axles = self.shape, (0.0, *self.style.trailer_axles)
        if not self.style.trailer:
            return None
        rearmost = [-s.trailer_axle, s.track / 2, s.wheel_radius]
        return Trailer(
            surfaces=self._trailer_surfaces,
            hinge=np.array([s.hinge_x, 0.0, s.hinge_height]),
            size_lwh=(s.trailer_length, s.width, s.trailer_height),
            front=s.trailer_front,
            axle=s.trailer_axle - sum(axles) / len(axles),
            wheel_centers=np.array([rearmost, rearmost]) * [[1, -1, 1], [1, 1, 1]],
            bend=math.radians(self.style.bend_deg),
        )

    def _trailer_surfaces(self) -> tuple[Mesh, Mesh | None]:
        arrays, inside = self._body_arrays, "trailer_interior"
        interior = Mesh.from_arrays(arrays, inside) if f"{inside}_vertices" in arrays else None
        return _with_right_indicators(Mesh.from_arrays(arrays, "trailer")), interior

    @cached_property
    def interior(self) -> Mesh:
        """Seats, dashboard and driver, visible through the windows; they lie inside `mesh`."""
        return Mesh.from_arrays(self._body_arrays, "interior")

    @cached_property
    def coarse(self) -> tuple[Mesh, ...]:
        """Simplified parts for distant views."""
        names = [f"part{i}" for i in range(len(self.parts))]

        def build() -> Arrays:
            parts = zip(names, simplified_parts(self.parts), strict=True)
            return {key: array for name, part in parts for key, array in part.to_arrays(name).items()}

        arrays = self._cached("coarse", build)
        return tuple(Mesh.from_arrays(arrays, name) for name in names)

    @cached_property
    def wheel(self) -> Mesh:
        """Left wheel about its centre; a right wheel is its mirror image."""
        radius, width = self.shape.wheel_radius, self.shape.wheel_width
        if self.style.family == "car":
            return wheel_mesh(radius, width, self.style.spokes)
        return steel_wheel(radius, width)

    @cached_property
    def points(self) -> Array:
        """(33, 3) keypoints at rest, metres."""
        left = self._body_arrays
        wheels = self.shape.wheel_centers()
        if self.trailer:
            wheels[2:] = self.trailer.at_rest[1:, :3, 3]
        out = np.empty((keypoints.K, 3))
        for i, name in enumerate(keypoints.NAMES):
            stem = name.removesuffix("_left").removesuffix("_right")
            if i in keypoints.WHEELS:
                out[i] = wheels[i - keypoints.WHEELS[0]]
            else:
                out[i] = left[stem] * ([1, -1, 1] if name.endswith("_right") else [1, 1, 1])
        return out


def _with_right_indicators(mesh: Mesh) -> Mesh:
    """Return the mesh with the material of the right indicator on the right half.

    The left half is mirrored, so both indicators first have the material of the left one.
    """
    name = "indicator_left"
    if name not in mesh.materials:
        return mesh
    right = mesh.vertices[mesh.triangles][:, :, 1].mean(axis=1) < 0
    of = mesh.materials.index(name)
    material = np.where((mesh.material == of) & right, len(mesh.materials), mesh.material)
    return Mesh(mesh.vertices, mesh.normals, mesh.triangles, (*mesh.materials, "indicator_right"), material)


@dataclass(frozen=True)
class FleetEntry:
    vehicle: Vehicle
    share: float
    """Frequency of the model in traffic, relative to the others."""
    held_out: bool = False
    """Whether the model is reserved for testing and never appears in a split `train`."""
    further: bool = False
    """Whether the model is used only if `Variation.further_models` is set."""


@cache
def _read_table(name: str) -> dict[str, Any]:
    return tomllib.loads(resources.files("skope.gen.vehicles").joinpath(name).read_text(encoding="utf-8"))


@cache
def class_ranges(size_class: str) -> Mapping[str, tuple[float, float]]:
    """Return the minimum and maximum of each dimension of a vehicle class, metres.

    Empty for a class without a table.
    """
    ranges = _read_table("vehicle_dimensions.toml").get(size_class, {}).get("range", {})
    return {name: (low, high) for name, (low, high) in ranges.items()}


@cache
def fleet(*, further: bool = True) -> Mapping[str, FleetEntry]:
    """Return all models of the package by name, or only those without `FleetEntry.further`. None is built yet."""
    tables = {"fleet.toml": False} | ({"further_fleet.toml": True} if further else {})
    return {
        name: _fleet_entry(name, row, belongs)
        for table, belongs in tables.items()
        for name, row in _read_table(table).items()
    }


def _fleet_entry(name: str, row: Mapping[str, Any], further: bool) -> FleetEntry:
    size_class = row.get("class", row["vehicle_type"])
    shape = Shape(**{**_read_table("vehicle_dimensions.toml")[size_class]["shape"], **row.get("shape", {})})
    choices: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in row["style"].items()}
    vehicle = ParametricVehicle(
        model=name,
        vehicle_type=row["vehicle_type"],
        shape=shape,
        style=VehicleStyle(**choices),
        mass=row["mass"],
        substituted=tuple(row.get("substituted", ())),
        size_class=size_class,
    )
    return FleetEntry(vehicle, row["share"], row.get("held_out", False), further)


def parametric(model: str) -> ParametricVehicle:
    """Return the model of the fleet with this name."""
    vehicle = fleet()[model].vehicle
    assert isinstance(vehicle, ParametricVehicle)
    return vehicle


@lru_cache(maxsize=256)
def _build_parametric(model: str, shape: tuple[tuple[str, float], ...], recurs: bool) -> ParametricVehicle:
    base = parametric(model)
    try:
        shape_of_model = Shape(**dict(shape))
    except TypeError as error:
        raise UserError(f"shape of {model}: {error}") from None
    return replace(base, shape=shape_of_model, style=styled(base.style, shape_of_model), recurs=recurs)


def build_vehicle(model: str, shape: Mapping[str, float], *, recurs: bool = False) -> Vehicle:
    """Build a vehicle; equal vehicles are built once.

    Args:
        model: A model of the fleet, or a model that the user added.
        shape: Shape parameters (fields of `Shape`); ignored for a user's model, which has one shape only.
        recurs: Whether a shape other than the model's own is cached on disk because other recordings use it too.

    Raises:
        UserError: The model or the parameter does not exist.
    """
    if model not in fleet():
        return load_model(model)
    return _build_parametric(model, tuple(sorted(shape.items())), recurs)


_LENGTH_FIELDS: Final = frozenset((
    "length", "wheelbase", "front_overhang", "cowl_setback", "screen_run", "backlight_run", "deck_length", "cab_length",
    "hood_length", "hinge_setback", "hinge_gap", "trailer_front", "trailer_length", "trailer_axle",
))  # fmt: skip
"""Dimensions along a vehicle, which are scaled together."""
_WIDTH_FIELDS: Final = frozenset(("width", "track", "headlight_inner", "taillight_inner", "roof_inset"))
"""Dimensions across a vehicle, which are scaled together."""
_HEIGHT_FIELDS: Final = frozenset((
    "height", "bumper_height", "headlight_low", "headlight_high", "taillight_low", "taillight_high",
    "hood_height", "cowl_height", "belt_height", "deck_height", "box_height", "clearance",
    "hinge_height", "trailer_floor", "trailer_height",
))  # fmt: skip
"""Vertical dimensions, which are scaled together."""
_STRETCH_SIGMA: Final = 0.025
"""Standard deviation of the relative change of length, width and height of a jittered shape."""


def jittered(model: str, rng: np.random.Generator) -> Mapping[str, float]:
    """Return random shape parameters near a model's, within the ranges of its class.

    The shape is scaled along each axis and slightly bent.
    """
    one_of("model", model, tuple(fleet()))
    vehicle = parametric(model)
    ranges = class_ranges(vehicle.size_class)
    whole = vehicle.shape.to_dict()
    scales = []
    for names in (_LENGTH_FIELDS, _WIDTH_FIELDS, _HEIGHT_FIELDS):
        # One factor per axis, limited so that all its dimensions stay in their ranges.
        bounds = [(ranges[name][0] / whole[name], ranges[name][1] / whole[name]) for name in names if name in ranges]
        low, high = max(bound[0] for bound in bounds), min(bound[1] for bound in bounds)
        scales.append((names, float(np.clip(1 + _STRETCH_SIGMA * rng.standard_normal(), low, high))))
    out = {}
    for name, value in whole.items():
        scale = next((scale for names, scale in scales if name in names), 1.0)
        out[name] = float(value * scale)
    for name in ("screen_run", "backlight_run", "roof_inset", "nose_round", "tail_round", "roof_droop", "nose_lean"):
        out[name] *= float(1 + 0.05 * np.clip(rng.standard_normal(), -2, 2))
    # A separate random stream: dimensions do not depend on the number of details.
    details_rng = rng.spawn(1)[0]
    _jitter_lamps(out, vehicle.style.family, details_rng)
    return out | draw_details(vehicle.style, vehicle.vehicle_type, details_rng)


def _jitter_lamps(shape: dict[str, float], family: str, rng: np.random.Generator) -> None:
    """Change height, width and position of a car's lamps at random."""
    if family != "car":
        return
    top = {"headlight": shape["hood_height"] - 0.03, "taillight": shape["deck_height"] - 0.03}
    for lamp, highest in top.items():
        low, high = shape[f"{lamp}_low"], shape[f"{lamp}_high"]
        middle = (low + high) / 2 + rng.uniform(-0.025, 0.025)
        half = (high - low) / 2 * rng.uniform(0.75, 1.25)
        shape[f"{lamp}_high"] = min(middle + half, max(high, highest))
        shape[f"{lamp}_low"] = shape[f"{lamp}_high"] - 2 * half
        shape[f"{lamp}_inner"] += rng.uniform(-0.04, 0.04)
        shape[f"{lamp}_wrap"] *= rng.uniform(0.7, 1.3)


assert {f.name for f in fields(Shape)} >= _LENGTH_FIELDS | _WIDTH_FIELDS | _HEIGHT_FIELDS


assert all(set(entry.vehicle.substituted) <= set(keypoints.NAMES) for entry in fleet().values())
