"""Convert a site file to the page's document and back; what the page does not know is kept in the file."""

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.camera.evidence import MARKING_ERRORS, CameraPrior, MarkedPoint
from skope.camera.model import Camera
from skope.camera.uncertain_camera import UncertainCamera
from skope.dataset.camera_of_file import fitted_camera
from skope.errors import UserError
from skope.files.atomic import sha256_of
from skope.site.calibration_marks import CalibrationMarks
from skope.site.gates_zones_lanes import Gate, gate_at_size, line_on_road
from skope.site.mark_parser import MARK_KINDS, MARK_LIMITS
from skope.site.page.drawings import DRAWN_KINDS, drawn_in_image
from skope.site.page.marks import SIGMA_FIELDS, entries_of, read_time, time_texts, unique_names
from skope.site.page.solved_page import SolvedCamera
from skope.site.site_file import SiteFile, read_site
from skope.site.write_site import save_site

KNOWN_FIELDS: Final = ("fov_deg", "height_m", "lens")
"""Keys of prior knowledge of a camera, with standard deviations."""
PLAN_KEYS: Final = ("metres_per_pixel", "origin", "rotation_deg")
"""Keys of a plan that give the position of its pixels in the world."""
POSE_KEYS: Final = (
    *("file", "raw", "fov_deg", "R", "t", "position", "look_at", "yaw_deg", "pitch_deg", "roll_deg", "points"),
    "ground",
)
"""Other forms of a pose in a [camera] table; the page's result replaces them."""


class SavedElsewhereError(Exception):
    """The file has been saved elsewhere since it was read."""


@dataclass(frozen=True, kw_only=True)
class Opened:
    """Site file, converted to the document of the page."""

    document: dict[str, Any]
    revision: str | None
    """Revision of the file; None: there is no file yet."""
    vehicles: CameraPrior | None = None
    """Prior of the camera from vehicles."""
    plan: Path | None = None
    """File of the plan's image, which may be missing."""


class SiteStore:
    """Reader and writer of a site file, which may not exist yet."""

    def __init__(self, path: Path, size: tuple[int, int]) -> None:
        self.path, self.size = path, size

    def read(self) -> Opened:
        """Return the file as a document, which is empty without a file. Raises UserError if the file is invalid."""
        if not self.path.exists():
            return Opened(document=document_of(None, self.size), revision=None)
        site = read_site(self.path)
        vehicles = site.calibration.vehicles if site.calibration else None
        return Opened(document=document_of(site, self.size), revision=site.revision, vehicles=vehicles,
                      plan=site.plan.file if site.plan else None)  # fmt: skip

    def check(self, revision: str | None) -> None:
        """Raise SavedElsewhereError if the file does not have `revision` any more."""
        if self._revision() != revision:
            raise SavedElsewhereError

    def save(
        self,
        document: Mapping[str, Any],
        solved: SolvedCamera,
        revision: str | None,
        when: datetime,
        plan: str | None = None,
    ) -> str:
        """Write a document to the file.

        Args:
            document: The page's document, without problems.
            solved: The solved camera.
            revision: Revision of the file when the page read it; None: there was no file.
            when: Current time, saved as the time of calibration.
            plan: File name of the plan's image; None: the name in the file is kept.

        Returns:
            The file's new revision.

        Raises:
            SavedElsewhereError: The file does not have `revision` any more; nothing is written.
            UserError: The file cannot be written.
        """
        self.check(revision)
        try:
            return save_site(self.path, changes_of(document, solved, self.size, when, plan), revision).revision
        except UserError:
            if self._revision() != revision:
                raise SavedElsewhereError from None
            raise

    def _revision(self) -> str | None:
        return sha256_of(self.path) if self.path.exists() else None


def merged_document(base: Mapping[str, Any], mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, Any]:
    """Merge the changes of two documents.

    If both have changed one entry, `mine` is used. Entries are matched by name, or by content.

    Args:
        base: The common earlier document.
        mine: The document of this window.
        theirs: The saved document.
    """
    out = dict(mine)
    for kind in (*MARK_KINDS, *DRAWN_KINDS):
        mine_by_name, theirs_by_name, base_by_name = (_by_name(document, kind) for document in (mine, theirs, base))
        rows = []
        for name, entry in mine_by_name.items():
            changed_here = entry != base_by_name.get(name)
            if name in theirs_by_name:
                rows.append(entry if changed_here else theirs_by_name[name])
            elif changed_here:  # new here, or changed here but removed there
                rows.append(entry)
        rows += [
            entry
            for name, entry in theirs_by_name.items()
            if name not in mine_by_name and entry != base_by_name.get(name)
        ]
        out[kind] = rows
    for key in ("camera", "known", "world", "plan", "time_zone", "start"):
        out[key] = mine.get(key) if mine.get(key) != base.get(key) else theirs.get(key)
    return out


def _by_name(document: Mapping[str, Any], kind: str) -> dict[str, Mapping[str, Any]]:
    return {str(entry.get("name") or entry): entry for entry in entries_of(document, kind)}


def document_of(site: SiteFile | None, size: tuple[int, int]) -> dict[str, Any]:
    """Return the page's document of a site file.

    Raises UserError if the file's marks are in images of another size than `size`.
    """
    out: dict[str, Any] = {kind: [] for kind in (*MARK_KINDS, *DRAWN_KINDS)} | {"camera": None, "known": {}}
    out |= {"world": None, "plan": None, "time_zone": None, "start": None}
    if site is None:
        return out
    if site.calibration is not None:
        out |= _marks(site.calibration, size)
    if site.camera is not None:
        out["camera"] = _camera(site, size)
    if site.world is not None:
        out["world"] = dict(site.world)
    if site.plan is not None:
        out["plan"] = {key: getattr(site.plan, key) for key in PLAN_KEYS} | {"origin": list(site.plan.origin)}
    out |= time_texts(site.time_zone, site.start)
    out["gates"] = [_gate(gate, size) for gate in site.gates]
    out["zones"] = [{"name": zone.name, "polygon": _rows(zone.polygon)} for zone in site.zones]
    out["lanes"] = [{"name": lane.name, "line": _rows(lane.line), "width": lane.width} for lane in site.lanes]
    out["occluders"] = [
        {
            "polygon": _rows(occluder.polygon),
            "foot": list(occluder.foot) if occluder.foot else None,
            "distance": occluder.distance,
        }
        for occluder in site.occluders
    ]
    return out


def _gate(gate: Gate, size: tuple[int, int]) -> dict[str, Any]:
    """Return a gate for the document; its pixels are those of the footage, unless the aspect ratio differs."""
    with contextlib.suppress(UserError):  # `read_drawings` reports another aspect ratio as a problem
        gate = gate_at_size(gate, size)
    out: dict[str, Any] = {"name": gate.name, "directions": list(gate.directions or ("", ""))}
    if gate.line:
        out["line"] = _rows(gate.line)
    if gate.pixels:
        out |= {"pixels": _rows(gate.pixels), "size": list(gate.size or size)}
    return out


def _marks(marks: CalibrationMarks, size: tuple[int, int]) -> dict[str, Any]:
    evidence = marks.evidence(size)
    known = {"fov_deg": marks.fov_deg, "height_m": marks.height_m}
    lens = {"lens": {key: list(value) for key, value in marks.lens.items()}} if marks.lens else {}
    return {
        "points": [point_entry(point) for point in evidence.points],
        "lengths": [
            {"name": length.name, "pixels": length.pixels.tolist(), "metres": length.metres}
            | _unless("sigma_m", length.sigma_m, MARK_LIMITS.length_sigma_m)
            for length in evidence.lengths
        ],
        "parallels": [{"name": group.name, "lines": group.lines.tolist()} for group in evidence.parallels],
        "verticals": [
            {"name": vertical.name, "pixels": vertical.pixels.tolist(), "metres": vertical.metres}
            for vertical in evidence.verticals
        ],
        "known": {name: list(value) for name, value in known.items() if value is not None} | lens,
    }


def point_entry(point: MarkedPoint) -> dict[str, Any]:
    """Return a point for the document, with standard deviations that differ from the defaults."""
    usual = {
        "sigma_m": MARKING_ERRORS.position_m,
        "sigma_px": MARKING_ERRORS.pixel,
        "sigma_z_m": MARKING_ERRORS.height_m,
    }
    sigmas = {
        key: value
        for name, default in usual.items()
        for key, value in _unless(name, getattr(point, name), default).items()
    }
    return {"name": point.name, "pixel": point.pixel.tolist(), "place": point.place.tolist()} | sigmas


def _unless(key: str, value: float, default: float) -> dict[str, float]:
    return {} if math.isclose(value, default) else {key: value}


def _camera(site: SiteFile, size: tuple[int, int]) -> dict[str, Any]:
    assert site.camera is not None
    fitted_camera(site.camera.camera, size, f"{site.path}: camera", "the footage")  # raises UserError if it differs
    return camera_dict(site.camera.known, site.camera.camera)


def camera_dict(known: UncertainCamera | None, camera: Camera) -> dict[str, Any]:
    """Return a camera for the document, with its covariance if known."""
    out = {"width": camera.width, "height": camera.height, **camera.to_dict()}
    return out | ({"covariance": known.covariance_dict()} if known else {})


def _rows(positions: Any) -> list[list[float]]:
    return [list(position) for position in positions]


# -------------------------------------------------------------------------------------------------------- what is saved


def changes_of(
    document: Mapping[str, Any],
    solved: SolvedCamera,
    size: tuple[int, int],
    when: datetime,
    plan: str | None,
) -> dict[str, Any]:
    """Return new values of the file's keys for `save_site`.

    Args:
        document: The page's document, without problems.
        solved: The solved camera.
        size: Width and height of the images, pixels.
        when: Current time, saved as the time of calibration.
        plan: File name of the plan's image; None: the name in the file is kept.

    Returns:
        Values by top-level key of the file; None removes a key.
    """
    out: dict[str, Any] = {}
    marked = {kind: _saved_marks(document, kind) for kind in MARK_KINDS}
    known = {name: document.get("known", {}).get(name) for name in KNOWN_FIELDS}
    if any(marked.values()) or any(known.values()):
        rows = {kind: values or None for kind, values in marked.items()}
        out["calibration"] = {"size": list(size), "when": when, **rows, **known}
    else:
        out["calibration"] = dict.fromkeys((*MARK_KINDS, *KNOWN_FIELDS))
    for kind in DRAWN_KINDS:
        rows_of_kind = [_saved_drawing(kind, entry, solved.camera) for entry in entries_of(document, kind)]
        out[kind] = rows_of_kind or None
    out["world"] = document.get("world") or None
    out["plan"] = _saved_plan(document, plan)
    time = read_time(document)
    out |= {"time_zone": time.time_zone, "start": time.start}
    camera = _saved_camera(document, solved, size, when)
    if camera:
        out["camera"] = camera
    return out


def _saved_marks(document: Mapping[str, Any], kind: str) -> list[dict[str, Any]]:
    entries = entries_of(document, kind)
    keys: dict[str, tuple[str, ...]] = {
        "points": ("pixel", "place", *SIGMA_FIELDS),
        "lengths": ("pixels", "metres", "sigma_m"),
    }
    keys |= {"parallels": ("lines",), "verticals": ("pixels", "metres")}
    return [
        {"name": name} | {key: entry.get(key) for key in keys[kind]}
        for name, entry in zip(unique_names(entries), entries, strict=True)
    ]


def _saved_drawing(kind: str, entry: Mapping[str, Any], camera: Camera | None) -> dict[str, Any]:
    if kind == "gates":
        directions = entry.get("directions") or ["", ""]
        out = {"name": entry["name"], "line": entry.get("line"), "pixels": None, "size": None}
        if drawn_in_image(kind, entry):
            out |= {"pixels": entry["pixels"], "size": entry.get("size")}
        if drawn_in_image(kind, entry) and camera is not None:
            out["line"] = _rows(line_on_road(camera, np.array(entry["pixels"]))) or None
        return out | {"directions": directions if any(directions) else None}
    if kind == "zones":
        return {"name": entry["name"], "polygon": entry["polygon"]}
    if kind == "lanes":
        return {"name": entry["name"], "line": entry["line"], "width": entry.get("width")}
    foot = entry.get("foot")
    return {"polygon": entry["polygon"], "foot": foot, "distance": None if foot else entry.get("distance")}


def _saved_plan(document: Mapping[str, Any], file: str | None) -> dict[str, Any] | None:
    """Return the [plan] table; a missing image keeps its name in the file."""
    plan = document.get("plan")
    if not isinstance(plan, dict):
        return None
    return ({"file": file} if file else {}) | {key: plan.get(key) for key in PLAN_KEYS}


def _saved_camera(
    document: Mapping[str, Any], solved: SolvedCamera, size: tuple[int, int], when: datetime
) -> dict[str, Any] | None:
    """Return the [camera] table; None if the page has no camera, so that the file's own is kept."""
    loaded = (document.get("camera") or {}).get("trusted") is True
    if solved.camera is None or (solved.calibration is None and not loaded):
        return None
    counted = [f"{len(entries_of(document, kind))} {kind}" for kind in MARK_KINDS if entries_of(document, kind)]
    source = ", ".join(counted) if solved.calibration else "a camera file"
    return {
        **dict.fromkeys(POSE_KEYS),
        "size": list(size),
        **solved.camera.to_dict(),
        "covariance": solved.known.covariance_dict() if solved.known else None,
        "calibrated": {"when": when, "from": source},
    }
