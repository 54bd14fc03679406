"""Options that several commands of `skope gen` take: what a dataset holds, and who does the work."""

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
    str, machine(choices=("auto", "gl", "pybullet"), help="What draws the images; auto: gl where OpenGL can be had.")
]


@dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """Options on the content of a dataset, of `skope gen` and `skope gen simulate`."""

    preset: Annotated[
        str,
        traffic(
            choices=("demo", "paper", "extra", "full", "varied", "world", "nights", "conditions"),
            help="Which dataset to make. demo: small; paper: as SKoPe3D; full: all sites; extra: sites for tests; "
            "varied: other cameras; world: other roads; nights: wide roads in the dark; conditions: splits by weather "
            "(docs/generating.md).",
        ),
    ] = "demo"
    seed: Annotated[int, traffic(help="Same seed, same dataset.", max=2**63 - 1)] = 0
    sites: Annotated[
        str | None, traffic(metavar=LIST_METAVAR, help="Sites of `skope gen sites` instead of the preset's.")
    ] = None
    site: Annotated[
        str | None,
        traffic(metavar=SITE_METAVAR, help="One site instead of --sites; or a site file, your own road and camera."),
    ] = None
    frames: Annotated[int | None, traffic(help="Frames per site.", show_default="the preset's")] = None
    recordings: Annotated[
        int | None,
        traffic(
            help="Recordings that a site's frames are shared out to, each with its own weather, hour and traffic.",
            show_default="the preset's",
        ),
    ] = None
    interval: Annotated[
        float | None, traffic(help="Seconds from one frame of a recording to the next.", show_default="the preset's")
    ] = None
    vehicles: Annotated[
        str | None,
        traffic(
            metavar=LIST_METAVAR,
            help="Models of `skope gen vehicles list` that drive by too: added ones, with --share also the fleet's.",
        ),
    ] = None
    share: Annotated[
        float | None,
        traffic(
            help="Share of all traffic, 0 to 1, that the --vehicles make together.",
            show_default="each a tenth of the fleet's",
        ),
    ] = None
    views: Annotated[
        int | None,
        variation(
            help="Further cameras for each site, at other corners of its town, that see the same traffic.",
            show_default="the preset's",
        ),
    ] = None
    town_jitter: Annotated[
        bool | None,
        variation(help="Houses, trees and signs along the roads anew for each recording.", show_default="the preset's"),
    ] = None
    shape_jitter: Annotated[
        bool | None,
        variation(
            help="Give every vehicle a shape of its own, within what its type allows.", show_default="the preset's"
        ),
    ] = None
    camera_jitter: Annotated[bool, variation(help="Hang and turn each recording's camera a little differently.")] = (
        False
    )
    weather: Annotated[
        str | None,
        camera(
            choices=WEATHER_CHOICES,
            several=True,
            help="Draw each recording's weather from these.",
            show_default="the sites' and preset's",
        ),
    ] = None
    time_of_day: Annotated[
        str | None,
        camera(
            choices=HOUR_CHOICES,
            several=True,
            help="Draw each recording's hour from these.",
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
            help="A condition of light, air, lens or sensor, as noise=2, or exposure_ev=-1..1 to draw it from a range; "
            "repeatable (docs/rendering.md lists them).",
        ),
    ] = None
    localizer: Annotated[
        str,
        labels(
            choices=("rigid", "trilateration"),
            help="How keypoints are found: rigid: moved with the body; trilateration: from distances, as in the paper.",
        ),
    ] = "rigid"
    occlusion_rule: Annotated[
        str,
        labels(
            choices=("others", "paper"),
            help="When a vehicle is hidden. others: something else covers it; it stays, ignored. paper: half of it is "
            "covered; it is left out.",
        ),
    ] = "others"
    road_users: Annotated[
        bool | None,
        labels(help="Label people on foot and on two wheels too, and draw more of them.", show_default="the preset's"),
    ] = None
    min_visible: Annotated[float, labels(help="Ignore vehicles of which a smaller share is seen.")] = 0.15
    min_box: Annotated[float, labels(help="Ignore boxes whose shorter edge is under this, pixels.")] = 12.0
    image_format: Annotated[str, output(choices=("jpeg", "png", "webp"), help="Format of the images.")] = "jpeg"
    quality: Annotated[int, output(help="Quality of JPEG and WebP files, 1 to 100.")] = 95
    depth: Annotated[bool, output(help="Write a depth file beside each image, metres.")] = True
    format: Annotated[
        str,
        output(choices=("folder", "shards"), help="shards: tar files, for hundreds of thousands of images."),
    ] = "folder"
    licence: Annotated[
        str, output(metavar="NAME", help="What others may use the images under; stated in the card.")
    ] = "CC BY 4.0"
    renderer: RendererOption = "auto"

    def request(self) -> "tuple[DatasetRequest, str]":
        """The request that the options make, and what to say of the renderer."""
        from skope.gen.generation_site import own_site
        from skope.gen.labels.ignore_rules import Rules
        from skope.gen.output.frames import Encoding
        from skope.gen.output.licences import named
        from skope.gen.pipeline.config import from_preset
        from skope.gen.render.choose_renderer import choose_renderer
        from skope.gen.scene.conditions import parse_settings

        if self.site is not None and self.sites is not None:
            raise UserError(f"--site: {self.site} is the site already: leave --sites out")
        own = own_site("--site", self.site) if self.site is not None else None
        if own and self.fov is not None:
            raise UserError(f"--site: {own.path} says where the camera is and what it sees: leave --fov out")
        sites = self.sites if own or self.site is None else self.site
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
            own=own,
            camera_jitter=self.camera_jitter,
        )
        return wanted, why


def _models(text: str | None) -> list[str]:
    """The names that `--vehicles` gives; none without the flag."""
    names = text.split(",") if text is not None else []
    if not all(names) or len(set(names)) < len(names):
        raise UserError("--vehicles: expected one or more different models, separated by commas")
    return names


def _digest(model: str) -> str:
    """A mark that tells a model of the user from another one of its name; nothing for a model of the fleet."""
    from skope.gen.vehicles.fleet import fleet
    from skope.gen.vehicles.user_models import load_model

    return "" if model in fleet() else load_model(model).digest


@dataclass(frozen=True, kw_only=True)
class WorkerOptions:
    """Options on who does the work: processes of this machine, or those of a Ray cluster."""

    workers: Annotated[int | None, machine(help="Worker processes.", show_default="one per core")] = None
    engine: Annotated[
        str,
        machine(
            choices=("local", "ray"),
            help="local: processes of this machine; ray: those of a Ray cluster (pip install skope[ray]).",
        ),
    ] = "local"
    address: Annotated[
        str | None,
        machine(help="Address of the Ray cluster.", show_default="one that this machine belongs to, or a new one here"),
    ] = None

    def count(self) -> int | None:
        """Number of worker processes on this machine; None for those of a cluster."""
        from skope.gen.pipeline.workers import check_workers

        if self.engine == "ray":
            return None
        return check_workers(self.workers) if self.workers is not None else usable_processors()

    def pool_factory(self) -> tuple[Callable[[], "AbstractContextManager[WorkerPool]"], str]:
        """A function that starts the worker processes, and what they are in words."""
        from skope.gen.pipeline.workers import check_workers, local_pool

        count = check_workers(self.workers) if self.workers is not None else None
        if self.engine == "ray":
            from skope.gen.pipeline.ray_workers import ray_pool

            return partial(ray_pool, count, self.address), f"{count or 'all'} workers of Ray"
        if self.address is not None:
            raise UserError("--address: is for --engine ray")
        count = count or usable_processors()
        return partial(local_pool, count), counted(count, "worker")
