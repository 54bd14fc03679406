"""The road from above on the page: a plan or map with scale and rotation, and the camera's image on the ground.

Positions on web maps are latitude and longitude; they are converted to metres of the page's world. In the view from
above, north is up and a cell is a square of the road.
"""

import base64
import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.geographic import local_metres, utm_metres
from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera
from skope.errors import UserError
from skope.files.atomic import read_bytes, replacing
from skope.site.mark_parser import positions
from skope.site.world import UTM_ZONE
from skope.viewer.collection import Picture, encoded

DEGREE_PAIR: Final = re.compile(
    r"\s*([-+]?\d{1,3}(?:[.,]\d+)?)\s*°?\s*([NSns]?)\s*[,;\s]\s*([-+]?\d{1,3}(?:[.,]\d+)?)\s*°?\s*([EWew]?)\s*"
)


@dataclass(frozen=True)
class PlanRules:
    """Settings of the view from above, and limits of a plan."""

    spread_m: float = 20_000.0
    """Maximum distance between positions, metres."""
    reach_heights: float = 9.0
    """End of the view, in heights of the camera."""
    reach_m: tuple[float, float] = (25.0, 80.0)
    """Minimum and maximum end of the view, metres."""
    longer_side: int = 1000
    """Number of cells along the longer side."""
    empty: tuple[int, int, int] = (226, 226, 226)
    """Colour of cells outside the image, RGB."""
    most_bytes: int = 24 << 20
    """Maximum size of a plan, bytes."""
    agreement: float = 0.02
    """Maximum relative difference between a typed distance and that of typed positions."""


PLAN_RULES: Final = PlanRules()


def map_places(sent: Mapping[str, Any]) -> dict[str, Any]:
    """Return `places`, rows of x (east) and y (north) in metres, and their `world`.

    Args:
        sent: `text` ("49.00012, 8.40034", latitude first) or `pairs` of degrees in the `order` "latitude" or
            "longitude" first; `world` of the document, or None; `others`: whether it already has positions.

    Raises:
        UserError: These are not positions, or they are in another world than the document's.
    """
    degrees = _typed(sent["text"]) if "text" in sent else _pairs(sent)
    if (np.abs(degrees) > [180.0, 90.0]).any():
        raise UserError("expected a latitude from -90 to 90 and a longitude from -180 to 180 degrees")
    world = sent.get("world")
    if not isinstance(world, dict):
        if sent.get("others"):
            raise UserError(
                "the other places are metres, and where their (0, 0) is on the map is not known: type this one in "
                "metres too"
            )
        longitude, latitude = (round(float(v), 6) for v in np.median(degrees, axis=0))
        world = {"origin": {"longitude": longitude, "latitude": latitude}, "axes": "east, north"}
    metres = _metres_in(world, degrees)
    if np.abs(metres).max() > PLAN_RULES.spread_m:
        raise UserError(
            f"lies more than {PLAN_RULES.spread_m / 1000:g} km from the other places; is the latitude first?"
        )
    return {"places": np.round(metres, 3).tolist(), "world": world}


def _metres_in(world: Mapping[str, Any], degrees: Any) -> Any:
    """Return (N, 2) metres from the origin of a world, for (N, 2) longitudes and latitudes."""
    origin, zone = world.get("origin"), UTM_ZONE.fullmatch(str(world.get("utm_zone")))
    origin_fields = origin if isinstance(origin, dict) else {}
    if about := positions([[origin_fields.get("longitude"), origin_fields.get("latitude")]], 2):
        return local_metres(degrees[:, 0], degrees[:, 1], (about[0][0], about[0][1]))
    if zone and (about := positions([[origin_fields.get("easting"), origin_fields.get("northing")]], 2)):
        grid = utm_metres(degrees[:, 0], degrees[:, 1], int(zone[1]), south=zone[2] == "S")
        return grid - about[0]
    raise UserError("where the world's (0, 0) is on the map is not known: type metres")


def _typed(text: Any) -> Any:
    """Return (1, 2) longitude and latitude of a text."""
    found = DEGREE_PAIR.fullmatch(text) if isinstance(text, str) and len(text) < 100 else None
    if not found:
        raise UserError("expected latitude and longitude in degrees, like 49.00012, 8.40034")
    latitude, north, longitude, east = found.groups()
    signs = [-1 if east.upper() == "W" else 1, -1 if north.upper() == "S" else 1]
    return np.array([[float(longitude.replace(",", ".")), float(latitude.replace(",", "."))]]) * signs


def _pairs(sent: Mapping[str, Any]) -> Any:
    """Return (N, 2) longitudes and latitudes of numbers."""
    rows = positions(sent.get("pairs"), 2)
    if not rows:
        raise UserError("pairs: expected rows of two numbers")
    return np.array(rows)[:, ::-1] if sent.get("order") == "latitude" else np.array(rows)


def seen_from_above(camera: Camera, pixels: NDArray[np.uint8] | None) -> dict[str, Any]:
    """Return the view from above of a camera's image (H, W, 3), or of an empty one (None).

    It has `low` and `high`, world x, y of the south-west and north-east corners in metres, `cell_m`, `size` in cells,
    and `image`, a data address.
    """
    low, high = _extent(camera)
    cell = float(np.max(high - low)) / PLAN_RULES.longer_side
    width, height = (int(v) for v in np.maximum(1, np.ceil((high - low) / cell)))
    x = low[0] + (np.arange(width) + 0.5) * cell
    y = high[1] - (np.arange(height) + 0.5) * cell
    places = np.stack([*np.meshgrid(x, y), np.zeros((height, width))], axis=-1)
    at = camera.project(places)[0]
    seen = camera.inside(at)
    above = np.full((height, width, 3), PLAN_RULES.empty, dtype=np.uint8)
    if pixels is not None:
        index = np.where(seen[..., None], at - 0.5, -1e4).astype(np.float32)
        warped = cv2.remap(pixels, index[..., 0], index[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        above[seen] = warped[seen]
    else:
        above[seen] = 245
    picture = encoded(above)
    return {
        "low": low.tolist(),
        "high": [float(low[0] + width * cell), float(high[1])],
        "cell_m": cell,
        "size": [width, height],
        "image": f"data:{picture.media_type};base64,{base64.b64encode(picture.data).decode()}",
    }


def _extent(camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (2,) corners of the rectangle that contains the road near the camera."""
    reach = float(np.clip(PLAN_RULES.reach_heights * camera.position[2], *PLAN_RULES.reach_m))
    u, v = np.meshgrid(np.linspace(0, camera.width, 41), np.linspace(0, camera.height, 41))
    places = intersect_ground(camera, np.stack([u, v], axis=-1)).reshape(-1, 3)
    away = np.linalg.norm(places[:, :2] - camera.position[:2], axis=-1)
    near = places[np.isfinite(away) & (away < reach), :2]
    if len(near) < 3:
        raise UserError("the camera sees no road near it")
    low, high = near.min(axis=0), near.max(axis=0)
    return low, np.maximum(high, low + 1.0)


IMAGE_KINDS: Final = (
    (b"\x89PNG\r\n\x1a\n", ".png", "image/png"),
    (b"\xff\xd8\xff", ".jpg", "image/jpeg"),
    (b"RIFF", ".webp", "image/webp"),
)
"""First bytes, suffix and type of files that every browser shows."""


class PlanPictures:
    """Images by the SHA-256 of their bytes, which is their name on the page: a name of the page is never a path."""

    def __init__(self) -> None:
        self._pictures: dict[str, Picture] = {}
        self._files: dict[str, str] = {}

    def hold(self, data: bytes) -> str:
        """Store an image's bytes and return its name. Raises UserError if browsers cannot show the image."""
        kind = next((media for begin, _, media in IMAGE_KINDS if data.startswith(begin)), None)
        if kind is None or (kind == "image/webp" and data[8:12] != b"WEBP"):
            expected = (
                "a PDF: save its page as PNG" if data.startswith(b"%PDF") else "expected a PNG, JPEG or WebP picture"
            )
            raise UserError(expected)
        if len(data) > PLAN_RULES.most_bytes:
            raise UserError(f"expected a picture of up to {PLAN_RULES.most_bytes >> 20} MB")
        name = hashlib.sha256(data).hexdigest()
        self._pictures.setdefault(name, Picture(media_type=kind, data=data))
        return name

    def hold_file(self, path: Path, as_written: str) -> str | None:
        """Store the image of a file, named `as_written` in the site file; return None if there is none."""
        try:
            name = self.hold(read_bytes(path))
        except UserError:
            return None
        self._files[name] = as_written
        return name

    def picture(self, name: Any) -> Picture | None:
        """Return the image of a name, or None."""
        return self._pictures.get(name) if isinstance(name, str) else None

    def saved_beside(self, site: Path, name: Any) -> str | None:
        """Return the name of an image for the site file, and write the image next to that if it is missing.

        No other file is overwritten. None if there is no image of that name.
        """
        picture = self.picture(name)
        if picture is None:
            return None
        if name in self._files:
            return self._files[name]
        suffix = next(suffix for _, suffix, media in IMAGE_KINDS if media == picture.media_type)
        number = 1
        while True:
            path = site.with_name(f"{site.stem}_plan{'' if number == 1 else f'_{number}'}{suffix}")
            if not path.exists():
                with replacing(path) as part:
                    part.write_bytes(picture.data)
                break
            if path.is_file() and read_bytes(path) == picture.data:
                break
            number += 1
        self._files[name] = path.name
        return path.name


def plan_scale(sent: Mapping[str, Any]) -> dict[str, Any]:
    """Return `metres_per_pixel` of the plan, `origin`: x and y of its top-left corner, and `rotation_deg`.

    A pixel (u, v) of the plan lies at origin + m R (u, -v), where m is the size of a pixel in metres and R rotates
    counter-clockwise. If only one of the two positions is known, north is up: the rotation is 0.

    Args:
        sent: `ends`, two pixels of the plan, `metres` between them, `at`, x and y of the first one, and `second`, x and
            y of the second one if known. Numbers may be texts; empty ones are unknown.

    Raises:
        UserError: A value is missing, invalid, or contradicts the others.
    """
    ends = positions(sent.get("ends"), 2)
    if ends is None or len(ends) != 2:
        raise UserError("click two points of the plan")
    apart = math.dist(*ends)
    if apart < 2:
        raise UserError("the two points are the same: click again")
    first, second = _position(sent.get("at", [0, 0]), "first"), _position(sent.get("second"), "second")
    if first is None:
        raise UserError("x, y: expected metres, two numbers")
    typed = sent.get("metres")
    metres = None if typed in (None, "") else _number(typed)
    needed = second is None or typed not in (None, "")
    if needed and (metres is None or not 0.1 <= metres <= 1e5):
        raise UserError("distance: expected metres from 0.1 to 100000")
    rotation = 0.0
    if second is not None:
        between = math.dist(first, second)
        if not 0.1 <= between <= 1e5:
            raise UserError("the two places are the same, or farther apart than any road's")
        if metres is not None and abs(metres - between) > PLAN_RULES.agreement * between:
            raise UserError(f"the two places are {between:.2f} m apart, not {metres:g}: which is right?")
        metres = between
        on_plan = math.atan2(ends[0][1] - ends[1][1], ends[1][0] - ends[0][0])
        turn = math.atan2(second[1] - first[1], second[0] - first[0]) - on_plan
        rotation = math.degrees(math.remainder(turn, 2 * math.pi))
    assert metres is not None
    scale, turn = metres / apart, math.radians(rotation)
    u, v = (scale * value for value in ends[0])
    corner = [
        first[0] - (u * math.cos(turn) + v * math.sin(turn)),
        first[1] - (u * math.sin(turn) - v * math.cos(turn)),
    ]
    return {"metres_per_pixel": scale, "origin": corner, "rotation_deg": rotation}


def _position(value: Any, which: str) -> tuple[float, float] | None:
    """Return x and y; None if both are empty."""
    pair = value if isinstance(value, list) and len(value) == 2 else [None, None]
    if all(coordinate in (None, "") for coordinate in pair):
        return None
    x, y = (_number(coordinate) for coordinate in pair)
    if x is None or y is None or max(abs(x), abs(y)) > 1e8:
        raise UserError(f"x, y of the {which} one: expected metres, two numbers")
    return x, y


def _number(value: Any) -> float | None:
    try:
        found = float(value)
    except (TypeError, ValueError):
        return None
    return found if math.isfinite(found) else None
