"""Ingredients of a dataset, as its card keeps them: the parameters that decide every byte, and its recordings."""

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
        return CATEGORY_NAMES if self.variation.road_users else VEHICLE_ALONE

    def pixels(self) -> tuple[int, int]:
        """Width and height of the images; a UserError where `size` says none of 16 to 8192 pixels."""
        match = re.fullmatch(r"(\d+)x(\d+)", self.size)
        if not match or not all(16 <= int(n) <= 8192 for n in match.groups()):
            raise UserError(f"--size: expected WIDTHxHEIGHT of 16 to 8192 pixels, got {self.size!r}")
        return int(match[1]), int(match[2])

    def to_dict(self) -> dict[str, Any]:
        """The parameters as JSON values, with the fields of `variation` among them."""
        values = plain_values(self)
        return {**values.pop("variation"), **values}

    @classmethod
    def from_dict(cls, values: Any, where: str = "parameters") -> Self:
        """The parameters of `to_dict`.

        Args:
            values: The JSON values.
            where: The object, as messages name it, for example "card.json: parameters".

        Raises:
            UserError: A field is missing, unknown or of another type. The message names it.
        """
        if not isinstance(values, Mapping):
            raise UserError(f"{where}: expected an object, got {shown(values)}")
        own = [field.name for field in (*fields(cls), *fields(Variation)) if field.name != "variation"]
        check_known(values, own, where)
        varied = {field.name for field in fields(Variation)} & values.keys()
        variation = dataclass_of(Variation, {name: values[name] for name in varied}, where)
        others = {name: value for name, value in values.items() if name not in varied}
        if (edition := others.get("keypoint_edition")) != keypoints.EDITION:
            raise UserError(f"{where}.keypoint_edition: expected {keypoints.EDITION}, got {shown(edition)}")
        return dataclass_of(cls, {**others, "variation": variation}, where)


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
