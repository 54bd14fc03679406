"""Files that a user loads into the page: points with places, cameras of other programs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from skope.camera.camera_json import read_uncertain_camera
from skope.camera.point_files import read_points
from skope.dataset.camera_of_file import read_camera
from skope.errors import UserError
from skope.eval.site.site_store import camera_dict, point_entry
from skope.files.atomic import write_text

POINT_FILES: Final = (".otrfpts", ".csv")
CAMERA_FILES: Final = (".json", ".yml", ".yaml", ".xml", ".txt")


def read_file(sent: Mapping[str, Any], folder: Path, size: tuple[int, int]) -> dict[str, Any]:
    """What a file that the browser sends adds to the document: `points` or `camera`, and `said`, words to the user.

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
        return loaded(path, size)
    except UserError as error:
        raise UserError(str(error).replace(str(path), name)) from None


def loaded(path: Path, size: tuple[int, int]) -> dict[str, Any]:
    """What a file of points or a camera adds to the document. Raises UserError as `read_file` does."""
    if path.suffix.lower() in POINT_FILES:
        file = read_points(path)
        points = [point_entry(point) for point in file.points]
        world = {"world": dict(file.world)} if file.world else {}
        return {"points": points, **world, "said": "; ".join(file.said)}
    camera, posed = read_camera(path, size)
    known = read_uncertain_camera(path) if posed and path.suffix.lower() == ".json" else None
    said = "" if posed else "the file tells the lens alone: mark what tells where the camera hangs"
    return {"camera": camera_dict(known, camera) | {"posed": posed, "trusted": True}, "said": said}
