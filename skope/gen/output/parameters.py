"""Parameters that determine every byte of a dataset, and its recordings, as the dataset card stores them."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Self

from skope import keypoints
from skope.dataset.folder import check_takes
from skope.errors import UserError
from skope.gen.labels.ignore_rules import Rules
from skope.gen.output import licences
from skope.gen.output.frames import Encoding
from skope.gen.scene.package_versions import versions
from skope.gen.scene.recording import RecordingInfo
from skope.gen.scene.variation import Variation
from skope.records import check_known, dataclass_of, plain_values, shown
from skope.schema import CATEGORY_NAMES, VEHICLE_ALONE
from skope.types import Range


@dataclass(frozen=True, kw_only=True)
class OwnSiteRecord:
    """Record of a user's own site on the card: enough to identify it, without paths of the user's disk."""

    file: str
    """Name of the site file."""
    digests: Mapping[str, str]
    """SHA-256 of the site file ("site") and of the files that it names, by their keys."""
    town: str
    photograph: bool
    """Whether images show the user's photograph as background."""
    splits: tuple[str, ...]
    """Split of each recording."""


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """Everything that determines a dataset's content; stored in the dataset's card."""

    preset: str
    seed: int
    sites: tuple[str, ...]
    frames: Mapping[str, int]
    """Frames per site, by the split of the sites."""
    recordings: int = 1
    """Number of recordings per site; the site's frames are divided among them."""
    interval_s: float
    size: str
    """Width and height of the images, as in "1280x720"."""
    fov_deg: float
    renderer: str
    """Renderer; empty, like `driver`, while the recordings are made for rendering on another machine."""
    driver: str
    """Name of the renderer's driver, from `choose_renderer`. Only equal drivers give equal pixels."""
    rules: Rules
    variation: Variation = field(default_factory=Variation)
    """Optional variation between recordings. The card lists its fields among the parameters."""
    keypoint_edition: int = keypoints.EDITION
    """Edition of the keypoint definition."""
    vehicles: Mapping[str, str] = field(default_factory=dict)
    """Requested models by name: SHA-256 of the files of a user's model, empty for a model of the fleet."""
    vehicle_share: float | None = None
    """Combined traffic share of all `vehicles`, 0 to 1; None for one vehicle of each model per ten of the fleet."""
    weather: tuple[str, ...] = ()
    """Permitted weathers of recordings; empty for those of the sites and of `presets.toml`."""
    time_of_day: tuple[str, ...] = ()
    """Permitted hours of recordings; empty for those of the sites and of `presets.toml`."""
    traffic: Range | None = None
    """Range of the factor on the traffic of a recording's site; None for the range in `presets.toml`."""
    own: OwnSiteRecord | None = None
    """User's own site (`--site`), which replaces those of the package."""
    encoding: Encoding = field(default_factory=Encoding)
    format: str = "folder"
    """Storage format of the dataset, one of `skope.gen.output.writers.DATASET_FORMATS`."""
    licence: str = licences.DEFAULT_LICENCE
    """Licence of the images, as the card states it."""
    versions: Mapping[str, str] = field(default_factory=versions)
    """Versions of skope and of the libraries that determine the bytes."""

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of the labelled categories."""
        return CATEGORY_NAMES if self.variation.road_users else VEHICLE_ALONE

    def pixels(self) -> tuple[int, int]:
        """Return width and height of the images. Raises UserError unless both are from 16 to 8192 pixels."""
        match = re.fullmatch(r"(\d+)x(\d+)", self.size)
        if not match or not all(16 <= int(n) <= 8192 for n in match.groups()):
            raise UserError(f"--size: expected WIDTHxHEIGHT of 16 to 8192 pixels, got {self.size!r}")
        return int(match[1]), int(match[2])

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters as JSON values; the fields of `variation` are at the top level."""
        values = plain_values(self)
        return {**values.pop("variation"), **values}

    @classmethod
    def from_dict(cls, values: Any, where: str = "parameters") -> Self:
        """Return the parameters from the result of `to_dict`.

        Args:
            values: The JSON values.
            where: Name of the object in messages, for example "card.json: parameters".

        Raises:
            UserError: A field is missing, unknown or of the wrong type. The message names it.
        """
        if not isinstance(values, Mapping):
            raise UserError(f"{where}: expected an object, got {shown(values)}")
        field_names = [field.name for field in (*fields(cls), *fields(Variation)) if field.name != "variation"]
        check_known(values, field_names, where)
        varied = {field.name for field in fields(Variation)} & values.keys()
        variation = dataclass_of(Variation, {name: values[name] for name in varied}, where)
        fixed = {name: value for name, value in values.items() if name not in varied}
        if (edition := fixed.get("keypoint_edition")) != keypoints.EDITION:
            raise UserError(f"{where}.keypoint_edition: expected {keypoints.EDITION}, got {shown(edition)}")
        return dataclass_of(cls, {**fixed, "variation": variation}, where)


@dataclass(frozen=True)
class DatasetPlan:
    """Plan of a dataset folder: its present or intended content."""

    parameters: Parameters
    recordings: tuple[RecordingInfo, ...]
    """Recordings in the order of their image ids."""

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as JSON values: "parameters", and "takes" with site, name, split and frames per recording."""
        takes = [[info.site, info.name, info.split, info.frames] for info in self.recordings]
        return {"parameters": self.parameters.to_dict(), "takes": takes}

    @classmethod
    def from_dict(cls, values: Any, path: Path) -> Self:
        """Return the plan from the result of `to_dict` or a card.

        Raises UserError with the invalid field. `path` is used only in error messages.
        """
        if not isinstance(values, dict):
            raise UserError(f"{path}: expected an object with parameters and takes")
        parameters = Parameters.from_dict(values.get("parameters"), f"{path}: parameters")
        check_takes(path, values.get("takes"))
        return cls(parameters, tuple(RecordingInfo(*row) for row in values["takes"]))
