"""The 33 keypoints of scheme `skope33`: names, flip partners, skeleton, sigmas, colours, maps to other schemes.

`NAMES` is the only definition of the order; every index below is derived from names. `SCHEMES` are the schemes that a
dataset, and a detector trained on it, can have: that of skope, and that of the published SKoPe3D files.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from skope.errors import UserError, one_of

SCHEME: Final = "skope33"
EDITION: Final = 2
"""Edition of the keypoint definition of `skope33` (docs/conventions.md). Files of skope name it; files of skope with
another edition, or without one, are rejected."""

NAMES: Final[tuple[str, ...]] = (
    "roof_front_right", "roof_front_left", "roof_rear_right", "roof_rear_left",
    "windscreen_base_right", "windscreen_base_left", "rear_window_base_right", "rear_window_base_left",
    "headlight_outer_right", "headlight_outer_left", "taillight_outer_right", "taillight_outer_left",
    "headlight_inner_right", "headlight_inner_left", "taillight_inner_right", "taillight_inner_left",
    "wheel_front_right", "wheel_front_left", "wheel_rear_right", "wheel_rear_left",
    "bumper_front_right", "bumper_front_left", "bumper_rear_right", "bumper_rear_left",
    "hood_front_right", "hood_front_left", "trunk_rear_right", "trunk_rear_left",
    "mirror_right", "mirror_left",
    "beltline_right", "beltline_left",
    "front_logo",
)  # fmt: skip
"""Names in file order; right and left are the vehicle's own.

The front roof points are where the windscreen meets the roof; the rear ones are on the roof's rounded rear edge. A bus
has a strip of its body above them: there they are the upper corners of the windscreen's frame and of the rear window,
0.3 and 0.5 m below the top."""

K: Final = len(NAMES)
INDEX: Final = {name: i for i, name in enumerate(NAMES)}
SIGMAS: Final = (0.05,) * K
"""Standard deviations of the object keypoint similarity, one per keypoint."""


def _mirrored(name: str) -> str:
    if name.endswith("_right"):
        return name.removesuffix("right") + "left"
    if name.endswith("_left"):
        return name.removesuffix("left") + "right"
    return name


FLIP: Final = tuple(INDEX[_mirrored(name)] for name in NAMES)
"""`FLIP[i]` is the keypoint that `i` becomes when the image is mirrored (a permutation, as Ultralytics' flip_idx)."""

_FRONT_AND_REAR: Final = {
    "roof_front": "roof_rear",
    "windscreen_base": "rear_window_base",
    "headlight_outer": "taillight_outer",
    "headlight_inner": "taillight_inner",
    "wheel_front": "wheel_rear",
    "bumper_front": "bumper_rear",
    "hood_front": "trunk_rear",
}
"""The counterpart at the rear of each part at the front that has one."""


def _at_other_end(name: str) -> str:
    part, _, side = name.rpartition("_")
    counterparts = _FRONT_AND_REAR | {rear: front for front, rear in _FRONT_AND_REAR.items()}
    return f"{counterparts[part]}_{side}" if part in counterparts else name


OTHER_END: Final = tuple(INDEX[_at_other_end(name)] for name in NAMES)
"""`OTHER_END[i]` is the keypoint that `i` becomes if front and rear are exchanged (a permutation).

Mirrors, beltline and logo have no counterpart: they stay."""

WHEELS: Final = tuple(INDEX[f"wheel_{end}_{side}"] for end in ("front", "rear") for side in ("right", "left"))
"""The four wheel centres: front right, front left, rear right, rear left."""


def _chain(*names: str) -> tuple[tuple[int, int], ...]:
    return tuple((INDEX[a], INDEX[b]) for a, b in itertools.pairwise(names))


def _both_sides(*stems: str) -> tuple[tuple[int, int], ...]:
    return _chain(*(f"{stem}_right" for stem in stems)) + _chain(*(f"{stem}_left" for stem in stems))


SKELETON: Final[tuple[tuple[int, int], ...]] = (
    # roof
    *_chain("roof_front_right", "roof_front_left", "roof_rear_left", "roof_rear_right", "roof_front_right"),
    # pillars and glass bases
    *_both_sides("roof_front", "windscreen_base"),
    *_both_sides("roof_rear", "rear_window_base"),
    *_chain("windscreen_base_right", "windscreen_base_left"),
    *_chain("rear_window_base_right", "rear_window_base_left"),
    # hood and trunk
    *_both_sides("windscreen_base", "hood_front"),
    *_chain("hood_front_right", "hood_front_left"),
    *_both_sides("rear_window_base", "trunk_rear"),
    *_chain("trunk_rear_right", "trunk_rear_left"),
    # front
    *_both_sides("hood_front", "headlight_outer", "headlight_inner"),
    *_chain("headlight_inner_right", "front_logo", "headlight_inner_left"),
    *_both_sides("headlight_outer", "bumper_front"),
    *_chain("bumper_front_right", "bumper_front_left"),
    # rear
    *_both_sides("trunk_rear", "taillight_outer", "taillight_inner"),
    *_chain("taillight_inner_right", "taillight_inner_left"),
    *_both_sides("taillight_outer", "bumper_rear"),
    *_chain("bumper_rear_right", "bumper_rear_left"),
    # sides
    *_both_sides("bumper_front", "wheel_front", "wheel_rear", "bumper_rear"),
    # mirrors and beltline
    *_both_sides("windscreen_base", "mirror"),
    *_both_sides("windscreen_base", "beltline", "rear_window_base"),
)
"""Edges as 0-based index pairs (COCO files carry them 1-based)."""

_GROUP_COLORS: Final = {
    "roof": (86, 180, 233),
    "windscreen": (0, 114, 178),
    "rear_window": (0, 114, 178),
    "headlight": (240, 228, 66),
    "taillight": (213, 94, 0),
    "wheel": (0, 158, 115),
    "bumper": (204, 121, 167),
    "hood": (230, 159, 0),
    "trunk": (230, 159, 0),
    "mirror": (255, 255, 255),
    "beltline": (160, 160, 255),
    "front_logo": (255, 64, 64),
}
"""sRGB by part, after the palette of Okabe and Ito, which colour-blind readers can distinguish."""

COLORS: Final = tuple(next(c for part, c in _GROUP_COLORS.items() if name.startswith(part)) for name in NAMES)

Map = dict[int, int]
"""Foreign index to index in `NAMES`, for the points that have the same meaning in both schemes."""


def _foreign(*names: str | None) -> Map:
    return {i: INDEX[name] for i, name in enumerate(names) if name is not None}


# A foreign lamp that is one point (its centre, or one unnamed corner) has no counterpart among our outer and inner
# points and is omitted, as are exhausts, plates and centres.
APOLLO24: Final = _foreign(
    "roof_front_right", "roof_front_left", None, None, "bumper_front_right", "bumper_front_left",
    None, "wheel_front_left", "wheel_rear_left", None, "roof_rear_left", "roof_rear_right",
    None, None, "bumper_rear_left", "bumper_rear_right", None, None,
    "wheel_rear_right", "wheel_front_right", None, None, "mirror_left", "mirror_right",
)  # fmt: skip
"""ApolloCar3D's 24 points in OpenPifPaf's order."""

CARFUSION14: Final = _foreign(
    "wheel_front_right", "wheel_front_left", "wheel_rear_right", "wheel_rear_left",
    None, None, None, None, None,
    "roof_front_right", "roof_front_left", "roof_rear_right", "roof_rear_left", None,
)  # fmt: skip
"""CarFusion's 14 points."""

VERI20: Final = _foreign(
    "wheel_front_left", "wheel_rear_left", "wheel_front_right", "wheel_rear_right",
    None, None, None, None, "front_logo", None, "mirror_left", "mirror_right",
    "roof_front_right", "roof_front_left", "roof_rear_left", "roof_rear_right", None, None, None, None,
)  # fmt: skip
"""VeRi-776's 20 points (Wang et al. 2017)."""

SKOPE3D: Final = _foreign(*NAMES[:4], *(None,) * 28, NAMES[32])
"""The published SKoPe3D files: only the roof corners and the logo. Users disagree on the order of the wheels."""

FOREIGN_SCHEMES: Final[dict[str, Map]] = {
    "apollo24": APOLLO24,
    "carfusion14": CARFUSION14,
    "veri20": VERI20,
    "skope3d": SKOPE3D,
}

BOX_SCHEMES: Final = ("boxes", "coco")
"""Schemes of detectors without keypoints: with the category numbers of skope, and with those of COCO."""
RESULT_SCHEMES: Final = (SCHEME, *FOREIGN_SCHEMES, *BOX_SCHEMES)
"""Schemes of results that can be compared with the ground truth."""

FOREIGN_K: Final[dict[str, int]] = {"apollo24": 24, "carfusion14": 14, "veri20": 20, "skope3d": 33}
"""Number of each scheme's keypoints, including those without a counterpart."""


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """Keypoint scheme: the meaning of the K keypoints of a dataset or detector."""

    name: str
    names: tuple[str, ...]
    flip: tuple[int, ...] | None
    """(K,) index of each keypoint's mirror partner. None if the partners are not known; images can then not be
    mirrored."""
    skeleton: tuple[tuple[int, int], ...]
    """Pairs of 0-based indices."""
    sigmas: tuple[float, ...]
    colors: tuple[tuple[int, int, int], ...]

    def fields(self, name_field: str = "keypoint_scheme") -> dict[str, Any]:
        """Fields that identify the scheme in files; `scheme_in` reads them."""
        return {name_field: self.name} | ({"keypoint_edition": EDITION} if self.name == SCHEME else {})

    def __post_init__(self) -> None:
        assert len(self.names) == len(set(self.names)) == len(self.sigmas) == len(self.colors) == K


SKOPE33: Final = Scheme(name=SCHEME, names=NAMES, flip=FLIP, skeleton=SKELETON, sigmas=SIGMAS, colors=COLORS)

_UNKNOWN_COLOR: Final = (190, 190, 190)
PUBLISHED: Final = Scheme(
    name="skope3d",
    names=tuple(f"skope3d_{i:02d}" for i in range(K)),
    flip=None,
    skeleton=tuple((a, b) for a, b in SKELETON if {a, b} <= SKOPE3D.keys()),
    sigmas=SIGMAS,
    colors=tuple(COLORS[SKOPE3D[i]] if i in SKOPE3D else _UNKNOWN_COLOR for i in range(K)),
)
"""Keypoints of the published files. Their order differs from ours and is undocumented, except for `SKOPE3D`."""

SCHEMES: Final[dict[str, Scheme]] = {scheme.name: scheme for scheme in (SKOPE33, PUBLISHED)}


def scheme_in(values: Mapping[str, Any], name_field: str = "keypoint_scheme") -> Scheme:
    """Return the scheme that a file specifies by `Scheme.fields`. Raises UserError for an unknown name or edition."""
    name = one_of(name_field, values.get(name_field), tuple(SCHEMES))
    edition = values.get("keypoint_edition")
    if name == SCHEME and edition != EDITION:
        raise UserError(f"keypoint_edition: expected {EDITION}, got {'nothing' if edition is None else repr(edition)}")
    return SCHEMES[name]


assert K == 33
assert all(max(FOREIGN_SCHEMES[name]) < count for name, count in FOREIGN_K.items())
assert FOREIGN_K.keys() == FOREIGN_SCHEMES.keys()
assert all(FLIP[FLIP[i]] == i for i in range(K))
assert all(OTHER_END[OTHER_END[i]] == i for i in range(K))
assert all(FLIP[OTHER_END[i]] == OTHER_END[FLIP[i]] for i in range(K))
assert {tuple(sorted((FLIP[a], FLIP[b]))) for a, b in SKELETON} == {tuple(sorted(edge)) for edge in SKELETON}
