"""The options that say what a dataset holds, shared by `skope gen` and `skope gen simulate`."""

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from skope.errors import UserError

if TYPE_CHECKING:
    from skope.gen.pipeline.config import Parameters

C = TypeVar("C", bound=Callable[..., Any])


def parameters(
    preset: Annotated[str, typer.Option(help="Which dataset to make (see the README).")] = "demo",
    seed: Annotated[int, typer.Option(help="Same seed, same dataset.", max=2**63 - 1)] = 0,
    renderer: Annotated[str, typer.Option(help="gl, pybullet, or auto: gl where OpenGL can be had.")] = "auto",
    sites: Annotated[str | None, typer.Option(help="Comma-separated sites instead of the preset's.")] = None,
    own: Annotated[
        Path | None, typer.Option("--site", help="A site file: your own road and camera instead of --sites.")
    ] = None,
    frames: Annotated[int | None, typer.Option(help="Frames per site.")] = None,
    interval: Annotated[float | None, typer.Option(help="Seconds between frames.")] = None,
    size: Annotated[str | None, typer.Option(help="Image size, WIDTHxHEIGHT.")] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view, degrees.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="A condition as NAME=VALUE or NAME=LOW..HIGH (see docs/rendering.md); repeatable."),
    ] = None,
    vehicles: Annotated[
        str | None, typer.Option(help="Comma-separated models of `skope gen vehicles add` that drive by too.")
    ] = None,
    shape_jitter: Annotated[
        bool, typer.Option(help="Give every vehicle a shape of its own, near its model's.")
    ] = False,
    camera_jitter: Annotated[
        bool, typer.Option(help="Hang and turn each recording's camera a little differently.")
    ] = False,
    localizer: Annotated[str, typer.Option(help="rigid, or trilateration as in the paper.")] = "rigid",
    occlusion_rule: Annotated[
        str, typer.Option(help="others: ignore what something else hides; paper: remove what is half hidden.")
    ] = "others",
    min_visible: Annotated[float, typer.Option(help="Ignore vehicles of which a smaller share is seen.")] = 0.15,
    min_box: Annotated[float, typer.Option(help="Ignore boxes whose shorter edge is under this, pixels.")] = 12.0,
    image_format: Annotated[str, typer.Option(help="jpeg, png or webp.")] = "jpeg",
    quality: Annotated[int, typer.Option(help="Of JPEG and WebP, 1 to 100.")] = 95,
    depth: Annotated[bool, typer.Option(help="Write depth files.")] = True,
    format_: Annotated[
        str, typer.Option("--format", help="folder, or shards: tar files for hundreds of thousands of images.")
    ] = "folder",
    licence: Annotated[
        str, typer.Option(help="What others may use the images under; stated in the card.")
    ] = "CC BY 4.0",
) -> "tuple[Parameters, str]":
    """What the options ask for, and what to say of the renderer."""
    from skope.gen.labels.annotate import Rules
    from skope.gen.output.frames import Encoding
    from skope.gen.output.licences import named
    from skope.gen.pipeline.config import from_preset
    from skope.gen.render.choose import choose_renderer
    from skope.gen.scene.conditions import parse_settings
    from skope.gen.site_files.site_file import read_site
    from skope.gen.vehicles.added import load

    if own and (sites is not None or fov is not None):
        raise UserError(f"--site: {own} says where the camera is and what it sees: leave --sites and --fov out")
    chosen, driver, why = choose_renderer(renderer)
    wanted = from_preset(
        preset,
        seed=seed,
        renderer=chosen,
        driver=driver,
        rules=Rules(occlusion=occlusion_rule, localizer=localizer, min_visible=min_visible, min_box=min_box),
        encoding=Encoding(image=image_format, quality=quality, depth=depth),
        sites=tuple(sites.split(",")) if sites is not None else None,
        frames=frames,
        interval_s=interval,
        size=size,
        fov_deg=fov,
        settings=parse_settings(settings or []),
        vehicles={name: load(name).digest for name in _models(vehicles)},
        shape_jitter=shape_jitter,
        format=format_,
        licence=named(licence),
        own=read_site(own) if own else None,
        camera_jitter=camera_jitter,
    )
    return wanted, why


def _models(text: str | None) -> list[str]:
    """The names that `--vehicles` gives; none without the flag."""
    names = text.split(",") if text is not None else []
    if not all(names) or len(set(names)) < len(names):
        raise UserError("--vehicles: expected one or more different models, separated by commas")
    return names


def asks_for_a_dataset(command: C) -> C:
    """Give a command, which takes `asked`, all options of `parameters` in its place; `asked()` reads them."""
    own, shared = inspect.signature(command).parameters, inspect.signature(parameters).parameters

    def run(**values: Any) -> Any:
        chosen = {name: values.pop(name) for name in shared}
        return command(**values, asked=lambda: parameters(**chosen))

    rest = [value for name, value in own.items() if name != "asked"]
    merged = [*rest[:1], *shared.values(), *rest[1:]]
    keyword = [value.replace(kind=inspect.Parameter.KEYWORD_ONLY) for value in merged]
    run.__signature__ = inspect.Signature(keyword)  # type: ignore[attr-defined]
    run.__annotations__ = {value.name: value.annotation for value in keyword}
    run.__name__, run.__doc__ = command.__name__, command.__doc__
    return run  # type: ignore[return-value]
