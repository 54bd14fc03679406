"""Ingredients of a dataset, as its card keeps them: the parameters that decide every byte, and its recordings."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Final, Self

from skope import keypoints
from skope.dataset.folder import check_takes
from skope.errors import UserError
from skope.field_checks import is_number
from skope.gen.labels.annotate import Rules
from skope.gen.output import licences
from skope.gen.output.frames import Encoding
from skope.gen.scene.package_versions import versions
from skope.gen.scene.random_streams import Variation
from skope.gen.scene.recording import RecordingInfo
from skope.schema import CATEGORIES, VEHICLE_ALONE
from skope.types import Range


@dataclass(frozen=True, kw_only=True)
class OwnSiteRecord:
    """Record of a user's own site on the card: enough to tell it from another one, and no path of the user's disk."""

    file: str
    """Name of the site file."""
    digests: Mapping[str, str]
    """SHA-256 of the site file ("site") and of the files that it names, by their keys."""
    town: str
    photograph: bool
    """Whether images show the user's photograph as background."""
    splits: tuple[str, ...]
    """Split of each recording."""

    def to_dict(self) -> dict[str, Any]:
        """The record as JSON values."""
        return {**asdict(self), "splits": list(self.splits)}


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """Everything that decides a dataset's content; read and written by itself, saved in the dataset's card."""

    preset: str
    seed: int
    sites: tuple[str, ...]
    frames: Mapping[str, int]
    """Frames per site, by the sites' split."""
    recordings: int = 1
    """Recordings per site, which share its frames."""
    interval_s: float
    size: str
    """Width and height of the images, as in "1280x720"."""
    fov_deg: float
    renderer: str
    """Empty while recordings are made that another machine renders; `driver` likewise."""
    driver: str
    """Means by which the renderer draws, as `choose_renderer` names it; pixels are the same on the same driver only."""
    rules: Rules
    variation: Variation = field(default_factory=Variation)
    """Things that are drawn for each recording, and their ranges; the card names its fields among these."""
    keypoint_edition: int = keypoints.EDITION
    """Edition of the definition of the keypoints."""
    vehicles: Mapping[str, str] = field(default_factory=dict)
    """Models that were asked for: name to SHA-256 of the files of a model of the user (`skope gen vehicles add`), to
    nothing for a model of the fleet."""
    vehicle_share: float | None = None
    """Share of the traffic that `vehicles` make together; None for a tenth of the fleet's number each."""
    weather: tuple[str, ...] = ()
    """Weathers that recordings may have; empty for those of the sites and of `presets.toml`."""
    time_of_day: tuple[str, ...] = ()
    """Hours that recordings may have; empty likewise."""
    traffic: Range | None = None
    """Range of a recording's traffic, times its site's; None for what `presets.toml` says of the split."""
    own: OwnSiteRecord | None = None
    """A user's own site (`--site`), in place of those of the package."""
    encoding: Encoding = field(default_factory=Encoding)
    format: str = "folder"
    """Form in which the dataset is stored, one of `skope.gen.output.writers.DATASET_FORMATS`."""
    licence: str = licences.DEFAULT_LICENCE
    """Licence of the images, as the card states it."""
    versions: Mapping[str, str] = field(default_factory=versions)
    """Versions of skope and of the libraries that decide bytes."""

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of the categories that the labels have."""
        return CATEGORIES if self.variation.road_users else VEHICLE_ALONE

    def pixels(self) -> tuple[int, int]:
        """Width and height of the images; a UserError where `size` says none of 16 to 8192 pixels."""
        match = re.fullmatch(r"(\d+)x(\d+)", self.size)
        if not match or not all(16 <= int(n) <= 8192 for n in match.groups()):
            raise UserError(f"--size: expected WIDTHxHEIGHT of 16 to 8192 pixels, got {self.size!r}")
        return int(match[1]), int(match[2])

    def to_dict(self) -> dict[str, Any]:
        """The parameters as JSON values, those of `variation` among them, in the order of `_FIELD_KINDS`."""
        values = {f.name: getattr(of, f.name) for of in (self, self.variation) for f in fields(of)}
        values |= {
            "rules": asdict(self.rules),
            "own": self.own.to_dict() if self.own else None,
            "encoding": asdict(self.encoding),
            **{name: list(values[name]) for name in ("sites", *_NAMES)},
            **{name: {key: list(pair) for key, pair in values[name].items()} for name in _RANGES_BY_NAME},
            **{name: list(pair) if (pair := values[name]) else None for name in _RANGES},
        }
        return {name: values[name] for name in _FIELD_KINDS if name not in _ASKED or values[name]}

    @classmethod
    def from_dict(cls, values: Any, where: str = "parameters") -> Self:
        """The parameters of `to_dict`.

        Args:
            values: The JSON values.
            where: What a message begins with, for example the file.

        Raises:
            UserError: A field is missing, unknown or of another kind; it is named.
        """
        _check_fields(where, values, _FIELD_KINDS, optional=_ASKED)
        made = dict(values)
        for name, kind in (("rules", Rules), ("encoding", Encoding)):
            made[name] = _made(f"{where}.{name}", kind, values[name])
        if made["own"] is not None:
            _check_fields(f"{where}.own", made["own"], _OWN_KINDS)
            made["own"] = OwnSiteRecord(**{**made["own"], "splits": tuple(made["own"]["splits"])})
        for name in _RANGES:
            if values.get(name):
                low, high = values[name]
                made[name] = (low, high)
        for name in _RANGES_BY_NAME:
            made[name] = {key: (low, high) for key, (low, high) in values.get(name, {}).items()}
        for name in ("sites", *_NAMES):
            made[name] = tuple(values.get(name, ()))
        varied = {f.name: made.pop(f.name) for f in fields(Variation) if f.name in made}
        return cls(variation=Variation(**varied), **made)


@dataclass(frozen=True)
class DatasetPlan:
    """Plan of a dataset folder: what it holds or is to become."""

    parameters: Parameters
    recordings: tuple[RecordingInfo, ...]
    """In the order in which ids of images count."""

    def to_dict(self) -> dict[str, Any]:
        """The plan as JSON values: "parameters", and "takes" with site, name, split and frames of each recording."""
        takes = [[info.site, info.name, info.split, info.frames] for info in self.recordings]
        return {"parameters": self.parameters.to_dict(), "takes": takes}

    @classmethod
    def from_dict(cls, values: Any, path: Path) -> Self:
        """The plan of `to_dict`, or of a card; a UserError names the file at `path` and the field that is wrong."""
        if not isinstance(values, dict):
            raise UserError(f"{path}: expected an object with parameters and takes")
        parameters = Parameters.from_dict(values.get("parameters"), f"{path}: parameters")
        check_takes(path, values.get("takes"))
        return cls(parameters, tuple(RecordingInfo(*row) for row in values["takes"]))


# ----------------------------------------------------------------------------------------------- kinds of JSON values


@dataclass(frozen=True)
class _Kind:
    """A kind of JSON value: its name in messages, and whether a value is one."""

    name: str
    holds: Callable[[Any], bool]


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_range(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(is_number, value))


def _object_of(holds: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, dict) and all(map(holds, value.values()))


_TEXT: Final = _Kind("text", _is_text)
_WHOLE_NUMBER: Final = _Kind("a whole number", _is_whole)
_EDITION: Final = _Kind(str(keypoints.EDITION), lambda value: value == keypoints.EDITION)
_NUMBER: Final = _Kind("a number", is_number)
_SWITCH: Final = _Kind("true or false", lambda value: isinstance(value, bool))
_OBJECT: Final = _Kind("an object", lambda value: isinstance(value, dict))
_OBJECT_OR_NULL: Final = _Kind("an object or null", lambda value: isinstance(value, dict | None))
_NUMBER_OR_NULL: Final = _Kind("a number or null", lambda value: value is None or is_number(value))
_RANGE_OR_NULL: Final = _Kind("a pair of numbers or null", lambda value: value is None or _is_range(value))
_TEXTS: Final = _Kind("names", lambda value: isinstance(value, list) and all(map(_is_text, value)))
_TEXT_BY_NAME: Final = _Kind("an object of texts", _object_of(_is_text))
_COUNT_BY_NAME: Final = _Kind("an object of whole numbers", _object_of(_is_whole))
_RANGE_BY_NAME: Final = _Kind("an object of pairs of numbers", _object_of(_is_range))

_RANGES: Final = ("traffic", "largest_vehicle", "distractors", "lit_objects")
"""Fields that hold a range or None."""
_RANGES_BY_NAME: Final = ("settings", "night", "cameras")
"""Fields that hold ranges by their names."""
_NAMES: Final = ("weather", "time_of_day")
"""Fields that hold names that were asked for."""
_ASKED: Final = ("night", "vehicle_share", "largest_vehicle", "lit_objects", "further_models", "road_users", *_NAMES)
"""Fields that are written only where they were asked for."""
_FIELD_KINDS: Final[Mapping[str, _Kind]] = {
    "preset": _TEXT,
    "seed": _WHOLE_NUMBER,
    "sites": _TEXTS,
    "frames": _COUNT_BY_NAME,
    "recordings": _WHOLE_NUMBER,
    "interval_s": _NUMBER,
    "size": _TEXT,
    "fov_deg": _NUMBER,
    "renderer": _TEXT,
    "driver": _TEXT,
    "rules": _OBJECT,
    "settings": _RANGE_BY_NAME,
    "night": _RANGE_BY_NAME,
    "cameras": _RANGE_BY_NAME,
    "keypoint_edition": _EDITION,
    "vehicles": _TEXT_BY_NAME,
    "vehicle_share": _NUMBER_OR_NULL,
    "weather": _TEXTS,
    "time_of_day": _TEXTS,
    "shape_jitter": _SWITCH,
    "views": _WHOLE_NUMBER,
    "largest_vehicle": _RANGE_OR_NULL,
    "traffic": _RANGE_OR_NULL,
    "town_jitter": _SWITCH,
    "distractors": _RANGE_OR_NULL,
    "lit_objects": _RANGE_OR_NULL,
    "seasons": _SWITCH,
    "further_models": _SWITCH,
    "road_users": _SWITCH,
    "randomised": _NUMBER,
    "own": _OBJECT_OR_NULL,
    "encoding": _OBJECT,
    "format": _TEXT,
    "licence": _TEXT,
    "versions": _TEXT_BY_NAME,
}
"""Kind of each field, of `Parameters` and of `Variation`, in the order in which files have them."""
_OWN_KINDS: Final[Mapping[str, _Kind]] = {
    "file": _TEXT,
    "digests": _TEXT_BY_NAME,
    "town": _TEXT,
    "photograph": _SWITCH,
    "splits": _TEXTS,
}


def _check_fields(where: str, values: Any, kinds: Mapping[str, _Kind], optional: Sequence[str] = ()) -> None:
    """Raise a UserError unless `values` is an object with fields of these kinds, but for `optional`, and no others."""
    if not isinstance(values, dict):
        raise UserError(f"{where}: expected an object, got {_shortened(values)}")
    for name, kind in kinds.items():
        if name not in (*values, *optional) or (name in values and not kind.holds(values[name])):
            raise UserError(f"{where}.{name}: expected {kind.name}, got {_shortened(values.get(name))}")
    for name in values.keys() - kinds.keys():
        raise UserError(f"{where}.{name}: is a field that this version of skope does not know")


def _made(where: str, kind: type[Any], values: Mapping[str, Any]) -> Any:
    """An instance of a dataclass of plain values; a UserError says which fields it has, or which value is wrong."""
    names = [f.name for f in fields(kind)]
    if values.keys() != set(names):
        raise UserError(f"{where}: expected {', '.join(names)}, got {_shortened(values)}")
    try:
        return kind(**values)
    except (UserError, TypeError) as error:
        raise UserError(f"{where}: {error}") from None


def _shortened(value: Any) -> str:
    return "nothing" if value is None else f"{value!r:.60}"
