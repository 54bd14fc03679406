"""Input of the page: files that a user loads (points with positions, cameras of other programs), and other windows."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.camera.calibration_files import read_uncertain_camera
from skope.camera.model import Camera
from skope.camera.point_files import read_points
from skope.dataset.camera_of_file import fitted_camera, read_camera
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.site.page.document_values import entries_of
from skope.site.page.drawings import DRAWN
from skope.site.page.marks import KINDS
from skope.site.page.site_store import camera_dict, point_entry


def merged_document(base: Mapping[str, Any], mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, Any]:
    """One document with the changes of both.

    Where both have changed the same entry, mine counts. Entries are told by their names, or by their content.

    Args:
        base: What both began with.
        mine: What this window made of it.
        theirs: What is saved now.
    """
    out = dict(mine)
    for kind in (*KINDS, *DRAWN):
        own, other, before = (_by_name(document, kind) for document in (mine, theirs, base))
        rows = []
        for name, entry in own.items():
            changed_here = entry != before.get(name)
            if name in other:
                rows.append(entry if changed_here else other[name])
            elif changed_here:  # new here, or taken away there but changed here
                rows.append(entry)
        rows += [entry for name, entry in other.items() if name not in own and entry != before.get(name)]
        out[kind] = rows
    for key in ("camera", "known", "world", "plan", "time_zone", "start"):
        out[key] = mine.get(key) if mine.get(key) != base.get(key) else theirs.get(key)
    return out


def _by_name(document: Mapping[str, Any], kind: str) -> dict[str, Mapping[str, Any]]:
    return {str(entry.get("name") or entry): entry for entry in entries_of(document, kind)}


POINT_FILES: Final = (".otrfpts", ".csv")
_FOCAL_SHARE: Final = 0.01
"""Standard deviation of the focal length of a camera file, as a share: zoom and focus may have changed since."""
_K1_SIGMA: Final = 0.02
CAMERA_FILES: Final = (".json", ".yml", ".yaml", ".xml", ".txt")


def read_file(sent: Mapping[str, Any], folder: Path, size: tuple[int, int]) -> dict[str, Any]:
    """Parts of the document from a file that the browser sends: `points` with their `world`, or `lens` and `camera`.

    `said` are words to the user.

    Args:
        sent: `name` and `text` of the file.
        folder: An empty folder, in which it is put for those who read it.
        size: Width and height of the footage, pixels.

    Raises:
        UserError: It is no such file; the message names it as the user does.
    """
    name, text = sent.get("name"), sent.get("text")
    if not isinstance(name, str) or not isinstance(text, str):
        raise UserError("expected name and text of a file")
    suffix = Path(name).suffix.lower()
    if suffix not in POINT_FILES + CAMERA_FILES:
        raise UserError(f"{name}: expected points ({', '.join(POINT_FILES)}) or a camera ({', '.join(CAMERA_FILES)})")
    # The name is the user's: as a path it could lead anywhere.
    path = folder / f"file{suffix}"
    write_text(path, text)
    try:
        found = loaded(path, size)
    except UserError as error:
        raise UserError(str(error).replace(str(path), name)) from None
    return found | {"said": found["said"].replace(str(path), name)}


def loaded(path: Path, size: tuple[int, int]) -> dict[str, Any]:
    """Parts of the document from a file of points or a camera. Raises UserError as `read_file` does."""
    if path.suffix.lower() in POINT_FILES:
        file = read_points(path)
        # Map coordinates from a local origin have digits that nobody typed: tenths of millimetres are kept.
        points = [entry | {"place": np.round(entry["place"], 4).tolist()} for entry in map(point_entry, file.points)]
        world = {"world": dict(file.world)} if file.world else {}
        return {"points": points, **world, "said": "; ".join(file.said)}
    camera, posed = read_camera(path, size)
    known = read_uncertain_camera(path) if posed and path.suffix.lower() == ".json" else None
    camera, scaled = fitted_camera(camera, size, str(path), "the footage")
    lens = {"lens": lens_of(camera)}
    if not posed:
        said = "the file tells the lens alone: mark points, or lengths and parallels, that tell where the camera hangs"
        said = f"{scaled}; {said}" if scaled else said
        return {**lens, "said": said}
    return {**lens, "camera": camera_dict(known, camera) | {"trusted": True}, "said": scaled}


def lens_of(camera: Camera) -> dict[str, list[float]]:
    """The lens of a camera file as evidence: `focal_px`, and `k1` of OpenCV's usual model."""
    focal = round(float(camera.K[0, 0]), 3)
    out = {"focal_px": [focal, round(_FOCAL_SHARE * focal, 3)]}
    if camera.distortion.model == "brown":
        out["k1"] = [float(camera.distortion.coefficients[0]), _K1_SIGMA]
    return out
