"""Presets, the parameters that decide every byte of a dataset, and the plans of its recordings."""

import math
import re
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cache
from importlib import resources
from typing import Any

from skope.camera import Distortion
from skope.errors import UserError, one_of
from skope.gen.labels.annotate import Rules
from skope.gen.output import licences
from skope.gen.output.frames import Encoding
from skope.gen.output.writers import FORMATS
from skope.gen.render.lens import pinhole_of
from skope.gen.scene import camera_sampling
from skope.gen.scene.conditions import Range, check_settings
from skope.gen.scene.package_versions import versions
from skope.gen.scene.random_streams import Stream, rng
from skope.gen.scene.recording import RecordingPlan
from skope.gen.site_files.site_file import OwnSite
from skope.gen.towns.sites import Site, site, sites
from skope.gen.traffic.sumo import step_for

_SUN = ("sun_elevation_deg", "sun_azimuth_deg", "clouds", "visibility_m")
"""Conditions that follow from weather and hour: a site's own values hold for its first recording only."""


@dataclass(frozen=True, kw_only=True)
class Parameters:
    """Everything that decides a dataset's content; saved in its card."""

    preset: str
    seed: int
    sites: tuple[str, ...]
    frames: Mapping[str, int]
    """Frames per site, by the sites' split."""
    recordings: int
    """Recordings per site, which share its frames."""
    interval_s: float
    size: str
    fov_deg: float
    renderer: str
    driver: str
    """What the renderer draws with, as `choose_renderer` names it; pixels are the same on the same driver only."""
    rules: Rules
    settings: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of conditions that `--set` or the preset gives; the others follow each site's weather and hour."""
    cameras: Mapping[str, Range] = field(default_factory=dict)
    """Ranges that each recording's camera is drawn from; empty to use the sites' own cameras."""
    vehicles: Mapping[str, str] = field(default_factory=dict)
    """Models of the user (`skope gen vehicles add`) that drive beside the fleet: name to SHA-256 of the files."""
    shape_jitter: bool = False
    """Whether each vehicle gets a shape of its own near its model's."""
    own: OwnSite | None = None
    """A user's own site (`--site`), in place of those of the package."""
    encoding: Encoding = field(default_factory=Encoding)
    format: str = "folder"
    """How the dataset is stored, one of `skope.gen.output.writers.FORMATS`."""
    licence: str = licences.DEFAULT
    """What the images may be used under, as the card states it."""

    def __post_init__(self) -> None:
        self.pixels()
        one_of("--format", self.format, FORMATS)
        if not all(self.sites) or not self.sites or len(set(self.sites)) < len(self.sites):
            raise UserError("--sites: expected one or more different sites, separated by commas")
        for name in self.sites:
            self.site(name)
        for frames in self.frames.values():
            if frames < 1:
                raise UserError(f"--frames: expected a whole number from 1, got {frames}")
        if self.seed < 0:
            raise UserError(f"--seed: expected a whole number from 0, got {self.seed}")
        if not 5 <= self.fov_deg <= 150:
            raise UserError(f"--fov: expected degrees from 5 to 150, got {self.fov_deg}")
        step_for(self.interval_s)
        check_settings(self.settings)
        camera_sampling.check_ranges(self.cameras)
        self._check_lens()
        if self.own:
            self._check_own(self.own)

    def _check_lens(self) -> None:
        """Raise a UserError where the strongest distortion at the widest angle would fold the image."""
        widest = self.cameras.get("fov_deg", (self.fov_deg, self.fov_deg))[1]
        low, high = map(round, self.settings.get("fisheye", (0.0, 0.0)))
        for k1 in set(self.settings.get("k1", (0.0, 0.0))):
            for model in ("brown", "fisheye")[low : high + 1]:
                if k1 or model == "fisheye":
                    lens = Distortion(model, (k1, 0.0, 0.0, 0.0))
                    pinhole_of(self.site(self.sites[0]).camera(self.pixels(), widest, lens))

    def _check_own(self, own: OwnSite) -> None:
        camera, photograph, (width, height) = own.road.camera, own.road.photograph, self.pixels()
        if abs(width * camera.height / (height * camera.width) - 1) > 0.01:
            raise UserError(
                f"--size {self.size}: the camera of {own.path} has {camera.width}x{camera.height}: "
                "only sizes of that shape can be had"
            )
        lens = next((name for name in ("k1", "fisheye") if name in self.settings), None)
        if lens and (photograph or camera.distortion.model != "none"):
            raise UserError(f"--set {lens}: {own.path} says already how its camera distorts")
        if self.cameras and photograph:
            raise UserError(f"{own.path}: a photograph shows the road from one camera only: no other can be drawn")
        if self.cameras.keys() & {"fov_deg", "height_m", "pitch_deg"}:
            raise UserError(f"--preset {self.preset}: {own.path} says how its camera hangs (try --camera-jitter)")

    def pixels(self) -> tuple[int, int]:
        """Width and height of the images."""
        match = re.fullmatch(r"(\d+)x(\d+)", self.size)
        if not match or not all(16 <= int(n) <= 8192 for n in match.groups()):
            raise UserError(f"--size: expected WIDTHxHEIGHT of 16 to 8192 pixels, got {self.size!r}")
        return int(match[1]), int(match[2])

    def site(self, name: str) -> Site:
        """The site of that name, or a UserError that lists those of the package."""
        return self.own.site if self.own else site(name)

    def plans(self) -> list[RecordingPlan]:
        """One plan for each recording, site by site; a site's frames are shared out evenly to its recordings."""
        return [
            RecordingPlan(
                site=self._in_its_light(name, index),
                index=index,
                frames=frames,
                interval=self.interval_s,
                size=self.pixels(),
                fov_deg=self.fov_deg,
                seed=self.seed,
                settings=self.settings,
                cameras=self.cameras,
                vehicles=tuple(self.vehicles),
                shape_jitter=self.shape_jitter,
            )
            for name in self.sites
            for index, frames in enumerate(_share_out(self.frames_of(name), self.recordings))
        ]

    def _in_its_light(self, name: str, index: int) -> Site:
        """The site with the weather, hour and traffic of its recording `index`."""
        if self.own is None:
            return in_its_light(site(name), index, self.seed)
        own = replace(self.own.site, split=self.own.splits[index])
        # A photograph shows one light, which all recordings share.
        return own if self.own.road.photograph else in_its_light(own, index, self.seed)

    def frames_of(self, name: str) -> int:
        """Number of frames of the site of that name; where its split is not among `frames`, that of the first split."""
        return self.frames.get(self.site(name).split, next(iter(self.frames.values())))

    @property
    def images(self) -> int:
        """How many images the dataset will hold."""
        return sum(self.frames_of(name) for name in self.sites)

    def to_dict(self) -> dict[str, Any]:
        """The parameters as JSON values for the card, and the versions of skope and libraries that made the dataset."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        own = self.own.to_dict() if self.own else None
        return {
            **values,
            **{
                "own": own,
                "rules": asdict(self.rules),
                "encoding": asdict(self.encoding),
                "sites": list(self.sites),
                "versions": versions(),
            },
        }


def _share_out(frames: int, recordings: int) -> list[int]:
    """Number of frames of each recording, as even as can be; there are no more recordings than frames."""
    count = min(recordings, frames)
    return [frames // count + (i < frames % count) for i in range(count)]


def in_its_light(own: Site, index: int, seed: int) -> Site:
    """A site with the weather, hour and traffic of its recording `index`.

    Recording 0 has the site's own. Later ones follow the table of the site's split in `presets.toml`: lights in turn,
    and a share of the site's vehicles an hour that `seed` draws.
    """
    if index == 0:
        return own
    splits = _tables()["splits"]
    split = splits.get(own.split, splits["train"])
    lights = split["light"]
    if own.road:
        # The site file decides the first recording's light: the others are at other hours.
        lights = [light for light in lights if light.split()[1] != own.time_of_day]
    weather, time_of_day = lights[(index - 1) % len(lights)].split()
    share = rng(seed, own.name, index, Stream.TRAFFIC_SHARE).uniform(*split["traffic"])
    traffic = own.vehicles_per_hour * share
    fixed = {name: pair for name, pair in own.conditions.items() if name not in _SUN}
    return replace(own, weather=weather, time_of_day=time_of_day, vehicles_per_hour=round(traffic, 1), conditions=fixed)


def _range_pairs(table: Mapping[str, list[float]]) -> dict[str, Range]:
    return {name: (low, high) for name, (low, high) in table.items()}


@cache
def _tables() -> Mapping[str, Any]:
    return tomllib.loads(resources.files("skope.gen.pipeline").joinpath("presets.toml").read_text(encoding="utf-8"))


def presets() -> Mapping[str, Mapping[str, Any]]:
    """The presets of `presets.toml` by name."""
    presets: Mapping[str, Mapping[str, Any]] = _tables()["presets"]
    return presets


def from_preset(
    preset: str,
    *,
    seed: int,
    renderer: str,
    driver: str,
    rules: Rules,
    frames: int | None = None,
    own: OwnSite | None = None,
    camera_jitter: bool = False,
    settings: Mapping[str, Range] | None = None,
    **overrides: Any,
) -> Parameters:
    """The parameters of a preset, with changes.

    Args:
        preset: A name of `presets()`.
        seed: From 0; everything random follows from it.
        renderer: "gl" or "pybullet".
        driver: What the renderer draws with, as `choose_renderer` names it.
        rules: What is labelled, what is ignored.
        frames: Frames per site, in place of the preset's.
        own: A user's own site in place of the preset's sites; its file gives camera and image size.
        camera_jitter: Whether each recording's camera hangs a little differently.
        settings: Ranges of conditions, on top of the preset's.
        overrides: Other fields of `Parameters`; None leaves the preset's value.

    Raises:
        UserError: There is no such preset, or a value is out of range.
    """
    row = presets()[one_of("--preset", preset, tuple(presets()))]
    known = {f.name for f in fields(Parameters)}
    values = {name: value for name, value in row.items() if name in known}
    values["sites"] = tuple(name for split in row["frames"] for name in sites() if site(name).split == split)
    if own is not None:
        own, camera = own.with_recordings(row["recordings"]), own.road.camera
        values |= {
            "own": own,
            "sites": (own.site.name,),
            "recordings": len(own.splits),
            "size": f"{camera.width}x{camera.height}",
            "fov_deg": round(math.degrees(2 * math.atan(camera.width / 2 / camera.K[0, 0])), 3),
        }
    values |= {name: value for name, value in overrides.items() if value is not None}
    values["settings"] = _range_pairs(row.get("settings", {})) | dict(settings or {})
    values["cameras"] = _range_pairs(row.get("cameras", {}) | (_tables()["camera_jitter"] if camera_jitter else {}))
    if frames is not None:
        values["frames"] = dict.fromkeys(row["frames"], frames)
    return Parameters(preset=preset, seed=seed, renderer=renderer, driver=driver, rules=rules, **values)
