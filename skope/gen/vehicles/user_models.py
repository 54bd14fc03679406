"""Vehicle models that users add: stored in a separate folder, one subfolder per model."""

import hashlib
import io
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.errors import UserError, one_of
from skope.files.atomic import write_bytes
from skope.files.json_files import check_version, read_json
from skope.files.safe_names import name as check_name
from skope.gen.mesh import Mesh
from skope.gen.vehicles.marked_models import Marked
from skope.gen.vehicles.model import Derived, Sidecar
from skope.gen.vehicles.shape import Dimensions
from skope.records import check_array, check_number, dataclass_of, is_number
from skope.schema import VEHICLE_TYPES
from skope.types import Array


@dataclass(frozen=True)
class UserModelLimits:
    """Limits of a user's vehicle models."""

    density: float = 115.0
    """Mass per volume of the box around a vehicle, kg/m3: that of a sedan."""
    masses_kg: tuple[float, float] = (1.0, 1_000_000.0)
    """Minimum and maximum mass, kilograms: from a scale model to the heaviest haul truck."""
    version: int = 1
    """Version of the files."""


USER_MODELS: Final = UserModelLimits()

MESH_NAMES: Final = ("mesh", "wheel")
_MODEL_FILES: Final = ("mesh.npz", "vehicle.json")
MESH_FIELDS: Final = ("vertices", "normals", "triangles", "material")


@dataclass(frozen=True, eq=False)
class AddedVehicle(Derived):
    """Model from a file; its windows are opaque."""

    model: str
    vehicle_type: str
    shape: Dimensions
    mass: float
    mesh: Mesh
    wheel: Mesh
    points: Array
    digest: str = ""
    """Digest of the model's files."""
    substituted: tuple[str, ...] = ()

    @property
    def interior(self) -> None:
        return None


def models_folder() -> Path:
    """Return $SKOPE_VEHICLES, or skope's folder in the user's data."""
    folder = os.environ.get("SKOPE_VEHICLES")
    if folder:
        return Path(folder)
    return Path(os.environ.get("XDG_DATA_HOME", Path.home() / ".local/share")) / "skope" / "vehicles"


def vehicle_of_model(marked: Marked, name: str, vehicle_type: str, mass: float | None) -> AddedVehicle:
    """Make a vehicle from a model with markers.

    Args:
        marked: The result of `read_marked`.
        name: Name of the new model.
        vehicle_type: One of `VEHICLE_TYPES`.
        mass: Kilograms. Default: estimated from the size.
    """
    points = marked.points
    right_front, left_front, right_rear, _ = (points[k] for k in (16, 17, 18, 19))
    length, width, height = marked.size_lwh
    shape = Dimensions(
        length=length,
        width=width,
        height=height,
        wheelbase=float(right_front[0] - right_rear[0]),
        track=float(left_front[1] - right_front[1]),
        wheel_radius=marked.wheel_radius,
        wheel_width=marked.wheel_width,
        front_overhang=float(length / 2 - right_front[0]),
        clearance=float(max(marked.mesh.vertices[:, 2].min(), 0.0)),
    )
    kilograms = USER_MODELS.density * length * width * height if mass is None else mass
    return AddedVehicle(name, vehicle_type, shape, kilograms, marked.mesh, marked.wheel, points)


def save_model(vehicle: AddedVehicle) -> Path:
    """Write a model's files; return their folder.

    Raises:
        UserError: Another model has that name.
    """
    path = models_folder() / vehicle.model
    arrays = {f"{name}_{field}": getattr(getattr(vehicle, name), field) for name in MESH_NAMES for field in MESH_FIELDS}
    mesh = io.BytesIO()
    np.savez_compressed(mesh, **arrays)
    row = {
        "version": USER_MODELS.version,
        "vehicle_type": vehicle.vehicle_type,
        "shape": asdict(vehicle.shape),
        "mass": vehicle.mass,
        "keypoints": vehicle.points.tolist(),
        "materials": {name: getattr(vehicle, name).materials for name in MESH_NAMES},
        "sidecar": vehicle.sidecar.to_dict(),
    }
    row_bytes = (json.dumps(row, indent=1, allow_nan=False) + "\n").encode()
    files = dict(zip((path / name for name in _MODEL_FILES), (mesh.getvalue(), row_bytes), strict=True))
    if any(file.is_file() and file.read_bytes() != data for file, data in files.items()):
        raise UserError(
            f"{path}: another model of that name was added already; choose another --name, "
            f"or `skope gen vehicles remove {vehicle.model}`"
        )
    for file, data in files.items():
        if not file.is_file():
            write_bytes(file, data)
    return path


def remove_model(name: str) -> Path:
    """Remove a model's files, readable or not; return their folder, which is kept if it contains other files.

    Raises:
        UserError: No model of that name was added, or its files cannot be removed.
    """
    if name not in model_names():
        raise UserError(f"{name}: no such model was added; there are: {', '.join(model_names()) or 'none'}")
    path = models_folder() / name
    try:
        # The file that identifies a model is removed last, so that an interrupted removal can be repeated.
        for file in _MODEL_FILES:
            (path / file).unlink(missing_ok=True)
        if not any(path.iterdir()):
            path.rmdir()
    except OSError as error:
        raise UserError(f"{path}: cannot be removed: {error.strerror or error}") from None
    load_model.cache_clear()
    return path


@cache
def load_model(name: str) -> AddedVehicle:
    """Return the added model with this name."""
    path = models_folder() / check_name("model", name)
    if not (path / "vehicle.json").is_file():
        raise UserError(f"--vehicles: there is no model {name!r}; `skope gen vehicles list` names all")
    row = read_json(path / "vehicle.json")
    if not isinstance(row, dict):
        raise UserError(f"{path / 'vehicle.json'}: expected an object, got {row!r:.60}")
    check_version(path / "vehicle.json", row.get("version"), USER_MODELS.version)
    try:
        with np.load(path / "mesh.npz", allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files}
        mesh, wheel = (_read_mesh(arrays, key, row["materials"][key]) for key in MESH_NAMES)
        vehicle = AddedVehicle(
            model=name,
            vehicle_type=one_of("vehicle_type", row["vehicle_type"], VEHICLE_TYPES),
            shape=_read_dimensions(row["shape"]),
            mass=check_mass("mass", row["mass"]),
            points=check_array("keypoints", row["keypoints"], keypoints.K, 3),
            digest=_digest(path),
            mesh=mesh,
            wheel=wheel,
        )
        Sidecar.from_dict(row["sidecar"])
    except Exception as error:  # damaged archives and fields raise many exception types
        raise UserError(f"{path}: not a readable vehicle: {error}") from None
    return vehicle


def check_mass(field: str, kilograms: Any) -> float:
    """Check a mass, kilograms, and return it. Raises UserError if it is not plausible."""
    low, high = USER_MODELS.masses_kg
    if not is_number(kilograms) or not low <= kilograms <= high:
        raise UserError(f"{field}: expected kilograms from {low:g} to {high:g}, got {kilograms!r:.60}")
    return float(kilograms)


def _read_dimensions(values: Mapping[str, Any]) -> Dimensions:
    shape = dataclass_of(Dimensions, values, "shape")
    for name, metres in shape.to_dict().items():
        check_number(f"shape.{name}", metres)
    return shape


def _read_mesh(arrays: Mapping[str, NDArray[Any]], name: str, materials: list[str]) -> Mesh:
    """Return a mesh of a file.

    Raises:
        UserError: The arrays have inconsistent shapes, values that are not finite, or invalid indices.
    """
    vertices, normals, triangles, material = (arrays[f"{name}_{field}"] for field in MESH_FIELDS)
    count = len(triangles)
    shapes = (vertices.shape, normals.shape, triangles.shape, material.shape)
    if shapes != ((len(vertices), 3), (len(vertices), 3), (count, 3), (count,)) or not count:
        raise UserError(f"mesh.npz: {name}: its arrays do not belong together")
    if not (np.isfinite(vertices).all() and np.isfinite(normals).all()):
        raise UserError(f"mesh.npz: {name}: not all numbers are finite")
    for indices, limit in ((triangles, len(vertices)), (material, len(materials))):
        if indices.dtype.kind != "i" or indices.min() < 0 or indices.max() >= limit:
            raise UserError(f"mesh.npz: {name}: triangles of vertices or materials that are not there")
    return Mesh(vertices, normals, triangles, tuple(materials), material)


def model_names() -> list[str]:
    """Return the names of all models that the user has added."""
    return sorted(path.parent.name for path in models_folder().glob("*/vehicle.json"))


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    for name in _MODEL_FILES:
        digest.update((path / name).read_bytes())
    return digest.hexdigest()[:16]
