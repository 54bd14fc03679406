"""Options that several commands of `skope gen` share: content of a dataset, and workers."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Final

from skope.cpu_count import usable_processors
from skope.errors import UserError
from skope.terminal.command_options import LIST_METAVAR, SITE_METAVAR, SIZE_METAVAR, panel
from skope.terminal.console import counted

if TYPE_CHECKING:
    from skope.gen.pipeline.config import DatasetRequest
    from skope.gen.pipeline.workers import WorkerPool

traffic = panel("Sites and traffic")
variation = panel("Variation")
camera = panel("Camera and image")
labels = panel("Labels")
output = panel("Output")
machine = panel("Machine")

WEATHER_CHOICES: Final = ("clear", "cloudy", "overcast", "rain", "after_rain", "fog", "snow")
HOUR_CHOICES: Final = ("noon", "low_sun", "dawn", "dusk", "night")

RendererOption = Annotated[
    str, machine(choices=("auto", "gl", "pybullet"), help="Renderer. auto: gl if OpenGL is available, else pybullet.")
]


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """Options on the content of a dataset, of `skope gen` and `skope gen simulate`."""

    preset: Annotated[
        str,
        traffic(
            choices=("demo", "paper", "extra", "full", "varied", "world", "nights", "conditions"),
            help="Kind of dataset. demo: small; paper: as SKoPe3D; full: all sites; extra: sites for tests; "
            "varied: other cameras; world: other roads; nights: wide roads in the dark; conditions: splits by weather "
            "(docs/generating.md).",
        ),
    ] = "demo"
    seed: Annotated[int, traffic(help="Seed; the same seed gives the same dataset.", max=2**63 - 1)] = 0
    sites: Annotated[
        str | None,
        traffic(metavar=LIST_METAVAR, help="Camera sites instead of those of the preset (see `skope gen sites`)."),
    ] = None
    site: Annotated[
        str | None,
        traffic(
            metavar=SITE_METAVAR, help="One site instead of --sites, or a site file with your own road and camera."
        ),
    ] = None
    frames: Annotated[int | None, traffic(help="Number of frames per site.", show_default="the preset's")] = None
    recordings: Annotated[
        int | None,
        traffic(
            help="Number of recordings per site. The frames are divided among them; each has its own weather, hour "
            "and traffic.",
            show_default="the preset's",
        ),
    ] = None
    interval: Annotated[
        float | None, traffic(help="Time between the frames of a recording, seconds.", show_default="the preset's")
    ] = None
    vehicles: Annotated[
        str | None,
        traffic(
            metavar=LIST_METAVAR,
            help="Vehicle models to add to the traffic (see `skope gen vehicles list`). Models of the fleet need "
            "--share.",
        ),
    ] = None
    share: Annotated[
        float | None,
        traffic(
            help="Combined share of the --vehicles in the traffic, 0 to 1.",
            show_default="one vehicle of each model per ten of the fleet",
        ),
    ] = None
    views: Annotated[
        int | None,
        variation(
            help="Record the simulated traffic of each site from this many sampled cameras in its town.",
            show_default="the preset's",
        ),
    ] = None
    town_jitter: Annotated[
        bool | None,
        variation(help="Sample new houses, trees and signs for each simulated traffic.", show_default="the preset's"),
    ] = None
    shape_jitter: Annotated[
        bool | None,
        variation(help="Vary the shape of each vehicle within the limits of its type.", show_default="the preset's"),
    ] = None
    camera_jitter: Annotated[
        bool, variation(help="Vary position, orientation and zoom of the camera in each recording.")
    ] = False
    weather: Annotated[
        str | None,
        camera(
            choices=WEATHER_CHOICES,
            several=True,
            help="Weather of the recordings; several values are taken in turn.",
            show_default="the sites' and preset's",
        ),
    ] = None
    time_of_day: Annotated[
        str | None,
        camera(
            choices=HOUR_CHOICES,
            several=True,
            help="Time of day of the recordings; several values are taken in turn.",
            show_default="the sites' and preset's",
        ),
    ] = None
    size: Annotated[
        str | None,
        camera(metavar=SIZE_METAVAR, help="Width and height of the images, pixels.", show_default="the preset's"),
    ] = None
    fov: Annotated[float | None, camera(help="Horizontal field of view, degrees.", show_default="the preset's")] = None
    settings: Annotated[
        list[str] | None,
        camera(
            "--set",
            metavar="NAME=VALUE",
            help="Condition of light, air, lens or sensor: a value (noise=2) or a range to draw from "
            "(exposure_ev=-1..1). Repeatable; docs/rendering.md lists the names.",
        ),
    ] = None
    localizer: Annotated[
        str,
        labels(
            choices=("rigid", "trilateration"),
            help="Method of keypoint positions. rigid: moved with the body. trilateration: from distances, as in the "
            "paper.",
        ),
    ] = "rigid"
    occlusion_rule: Annotated[
        str,
        labels(
            choices=("others", "paper"),
            help="Definition of a hidden vehicle. others: another object covers more than half of its keypoints; it is "
            "marked as ignored. paper: more than half of its keypoints are covered; it is omitted.",
        ),
    ] = "others"
    road_users: Annotated[
        bool | None,
        labels(
            help="Also label people on foot and on two wheels, and generate more of them.", show_default="the preset's"
        ),
    ] = None
    min_visible: Annotated[
        float, labels(help="Minimum visible fraction of a vehicle, 0 to 1; a vehicle below it is marked as ignored.")
    ] = 0.15
    min_box: Annotated[
        float, labels(help="Minimum shorter edge of a box, pixels; a smaller box is marked as ignored.")
    ] = 12.0
    image_format: Annotated[str, output(choices=("jpeg", "png", "webp"), help="Format of the images.")] = "jpeg"
    quality: Annotated[int, output(help="Quality of JPEG and WebP files, 1 to 100.")] = 95
    depth: Annotated[bool, output(help="Write a depth file beside each image, metres.")] = True
    format: Annotated[
        str,
        output(choices=("folder", "shards"), help="Storage. shards: tar files, for hundreds of thousands of images."),
    ] = "folder"
    licence: Annotated[str, output(metavar="NAME", help="Licence of the images, stated in the card.")] = "CC BY 4.0"
    renderer: RendererOption = "auto"

    def request(self) -> "tuple[DatasetRequest, str]":
        """Return the dataset request of the options, and a message about the renderer."""
        from skope.gen.generation_site import own_site
        from skope.gen.labels.ignore_rules import Rules
        from skope.gen.output.frames import Encoding
        from skope.gen.output.licences import named
        from skope.gen.pipeline.config import from_preset
        from skope.gen.render.choose_renderer import choose_renderer
        from skope.gen.scene.conditions import parse_settings

        if self.site is not None and self.sites is not None:
            raise UserError(f"--site: {self.site} already names the site; omit --sites")
        user_site = own_site("--site", self.site) if self.site is not None else None
        if user_site and self.fov is not None:
            raise UserError(f"--site: {user_site.path} has a camera of its own; omit --fov")
        sites = self.sites if user_site or self.site is None else self.site
        chosen, driver, why = choose_renderer(self.renderer)
        wanted = from_preset(
            self.preset,
            seed=self.seed,
            renderer=chosen,
            driver=driver,
            rules=Rules(
                occlusion=self.occlusion_rule,
                localizer=self.localizer,
                min_visible=self.min_visible,
                min_box=self.min_box,
            ),
            encoding=Encoding(image=self.image_format, quality=self.quality, depth=self.depth),
            sites=tuple(sites.split(",")) if sites is not None else None,
            frames=self.frames,
            recordings=self.recordings,
            interval_s=self.interval,
            size=self.size,
            fov_deg=self.fov,
            settings=parse_settings(self.settings or []),
            weather=tuple(self.weather.split(",")) if self.weather is not None else None,
            time_of_day=tuple(self.time_of_day.split(",")) if self.time_of_day is not None else None,
            vehicles={name: _digest(name) for name in _models(self.vehicles)},
            vehicle_share=self.share,
            shape_jitter=self.shape_jitter,
            views=self.views,
            town_jitter=self.town_jitter,
            road_users=self.road_users,
            format=self.format,
            licence=named(self.licence),
            user_site=user_site,
            camera_jitter=self.camera_jitter,
        )
        return wanted, why


def _models(text: str | None) -> list[str]:
    """Return the names in `--vehicles`; empty without the option."""
    names = text.split(",") if text is not None else []
    if not all(names) or len(set(names)) < len(names):
        raise UserError("--vehicles: expected one or more different models, separated by commas")
    return names


def _digest(model: str) -> str:
    """Return the digest of a user model; empty for a model of the fleet."""
    from skope.gen.vehicles.fleet import fleet
    from skope.gen.vehicles.user_models import load_model

    return "" if model in fleet() else load_model(model).digest


@dataclass(frozen=True, kw_only=True)
class WorkerOptions:
    """Options of the workers: processes of this machine or of a Ray cluster."""

    workers: Annotated[int | None, machine(help="Number of worker processes.", show_default="one per core")] = None
    engine: Annotated[
        str,
        machine(
            choices=("local", "ray"),
            help="Workers. local: processes of this machine. ray: a Ray cluster (pip install 'skope[ray]').",
        ),
    ] = "local"
    address: Annotated[
        str | None,
        machine(help="Address of the Ray cluster.", show_default="the cluster of this machine, else a new one"),
    ] = None

    def count(self) -> int | None:
        """Return the number of worker processes on this machine; None for a cluster."""
        from skope.gen.pipeline.workers import check_workers

        if self.engine == "ray":
            return None
        return check_workers(self.workers) if self.workers is not None else usable_processors()

    def pool_factory(self) -> tuple[Callable[[], "AbstractContextManager[WorkerPool]"], str]:
        """Return a function that starts the worker processes, and a description of them."""
        from skope.gen.pipeline.workers import check_workers, local_pool

        count = check_workers(self.workers) if self.workers is not None else None
        if self.engine == "ray":
            from skope.gen.pipeline.ray_workers import ray_pool

            return partial(ray_pool, count, self.address), f"{count or 'all'} workers of Ray"
        if self.address is not None:
            raise UserError("--address: needs --engine ray")
        count = count or usable_processors()
        return partial(local_pool, count), counted(count, "worker")
