"""What a dataset will hold: presets, the parameters that decide every byte, and the recordings they ask for."""

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
from skope.gen.scene.recording import RecordingPlan
from skope.gen.scene.streams import Stream, rng
from skope.gen.scene.versions import versions
from skope.gen.site_files.site_file import OwnSite
from skope.gen.towns.sites import Site, site, sites
from skope.gen.traffic.sumo import step_for

_SUN = ("sun_elevation_deg", "sun_azimuth_deg", "clouds", "visibility_m")
"""Conditions that belong to a light."""


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
    """What the renderer draws with: pixels are the same on the same one only."""
    rules: Rules
    settings: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of conditions that are set; the others follow each site's weather and hour."""
    cameras: Mapping[str, Range] = field(default_factory=dict)
    """Ranges that each recording's camera is drawn from; none for the sites' own cameras."""
    vehicles: Mapping[str, str] = field(default_factory=dict)
    """Models that were added and drive by too, with the digests of their files."""
    shape_jitter: bool = False
    own: OwnSite | None = None
    """A user's own site, in place of those of the package."""
    encoding: Encoding = field(default_factory=Encoding)
    format: str = "folder"
    """What the dataset is kept in, one of `skope.gen.output.writers.FORMATS`."""
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
        """The strongest distortions at the widest view must not fold the image."""
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
        """The recordings, site by site; a site's frames are shared out evenly."""
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
            for index, frames in enumerate(_shared(self.frames_of(name), self.recordings))
        ]

    def _in_its_light(self, name: str, index: int) -> Site:
        """A site as its recording `index` has it."""
        if self.own is None:
            return in_its_light(site(name), index, self.seed)
        own = replace(self.own.site, split=self.own.splits[index])
        # A photograph has its own light.
        return own if self.own.road.photograph else in_its_light(own, index, self.seed)

    def frames_of(self, name: str) -> int:
        """How many frames a site has; one of a split that the preset has not, as many as the first one."""
        return self.frames.get(self.site(name).split, next(iter(self.frames.values())))

    @property
    def images(self) -> int:
        """How many images the dataset will hold."""
        return sum(self.frames_of(name) for name in self.sites)

    def to_dict(self) -> dict[str, Any]:
        """As the card holds them, with the versions that decide the content too."""
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


def _shared(frames: int, recordings: int) -> list[int]:
    """Frames of each recording, as even as can be."""
    count = min(recordings, frames)
    return [frames // count + (i < frames % count) for i in range(count)]


def in_its_light(own: Site, index: int, seed: int) -> Site:
    """A site in the light and with the traffic of its recording `index`, as its split has them; its own at 0."""
    if index == 0:
        return own
    splits = _tables()["splits"]
    split = splits.get(own.split, splits["train"])
    lights = split["light"]
    if own.road:
        # Its first recording may be in any light: the others are at other hours.
        lights = [light for light in lights if light.split()[1] != own.time_of_day]
    weather, time_of_day = lights[(index - 1) % len(lights)].split()
    share = rng(seed, own.name, index, Stream.TRAFFIC_SHARE).uniform(*split["traffic"])
    traffic = own.vehicles_per_hour * share
    fixed = {name: pair for name, pair in own.conditions.items() if name not in _SUN}
    return replace(own, weather=weather, time_of_day=time_of_day, vehicles_per_hour=round(traffic, 1), conditions=fixed)


def _spans(table: Mapping[str, list[float]]) -> dict[str, Range]:
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
    """A preset's parameters with those `overrides` that are not None in their place; `frames` are per site.

    `settings` of conditions add to the preset's; with `camera_jitter` each recording's camera hangs a little
    differently. An `own` site comes in place of the preset's sites, with its camera and its number of recordings.
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
    values["settings"] = _spans(row.get("settings", {})) | dict(settings or {})
    values["cameras"] = _spans(row.get("cameras", {}) | (_tables()["camera_jitter"] if camera_jitter else {}))
    if frames is not None:
        values["frames"] = dict.fromkeys(row["frames"], frames)
    return Parameters(preset=preset, seed=seed, renderer=renderer, driver=driver, rules=rules, **values)
