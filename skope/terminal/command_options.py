"""Options shared by commands of all groups: default folders, declaration of options, `--quiet`, `--version`."""

import inspect
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import typer
from typer.core import TyperGroup

from skope.errors import UserError, one_of
from skope.terminal.console import Console
from skope.version import __version__

DATA_FOLDER: Final = Path("data/skope")
"""Dataset that `skope gen` writes, `skope train` learns from and `skope eval` measures on."""
RUN_FOLDER: Final = Path("runs/skope")
"""Run that `skope train` writes and `skope eval` measures."""
SHEETS_FOLDER: Final = Path("runs/show")
GALLERY_FOLDER: Final = Path("runs/gallery")
SITE_PLANS: Final = Path("runs/sites")
VEHICLE_SHEETS: Final = Path("runs/vehicles")
VIDEO_FOLDER: Final = Path("runs/video")
PREDICTION_FOLDER: Final = Path("runs/predict")
POSE_FOLDER: Final = Path("runs/pose")
DEFAULT_TRACKS: Final = Path("runs/tracks")
TRAFFIC_FOLDER: Final = Path("runs/traffic")
CAMERA_FILE: Final = Path("runs/camera.json")
SITE_FILE: Final = Path("site.toml")

DIR_METAVAR: Final = "DIR"
FILE_METAVAR: Final = "FILE"
LIST_METAVAR: Final = "A,B,.."
SITE_METAVAR: Final = "NAME|FILE"
SIZE_METAVAR: Final = "WIDTHxHEIGHT"

C = TypeVar("C", bound=Callable[..., Any])


def option(
    *names: str,
    help: str,
    choices: tuple[str, ...] = (),
    several: bool = False,
    least: int | None = None,
    **settings: Any,
) -> Any:
    """Return a `typer.Option` for an annotation.

    Args:
        names: Names of the option. Default: the name of the parameter with dashes.
        help: Text for `--help`; brackets are printed as they are.
        choices: Allowed values, which `--help` lists; any other value is a UserError.
        several: Whether several choices are allowed, separated by commas.
        least: Minimum of a whole number; a smaller value is a UserError.
        settings: Further arguments of `typer.Option`.
    """
    if choices:
        settings |= {
            "metavar": f"[{'|'.join(choices)}]{',..' if several else ''}",
            "autocompletion": lambda: list(choices),
            "callback": _all_among(choices) if several else _among(choices),
        }
    if least is not None:
        settings["callback"] = _from(least)
    # Rich would interpret text in brackets as markup and drop it.
    return typer.Option(*names, help=help.replace("[", r"\["), **settings)


def panel(title: str) -> Callable[..., Any]:
    """Return a variant of `option` for options that `--help` shows under this title."""
    return partial(option, rich_help_panel=title)


def _among(choices: tuple[str, ...]) -> Callable[..., Any]:
    def check(param: typer.CallbackParam, value: Any) -> Any:
        return value if value is None else one_of(_flag(param), value, choices)

    return check


def _all_among(choices: tuple[str, ...]) -> Callable[..., Any]:
    def check(param: typer.CallbackParam, value: Any) -> Any:
        for name in value.split(",") if value is not None else ():
            one_of(_flag(param), name, choices)
        return value

    return check


def _from(least: int) -> Callable[..., Any]:
    def check(param: typer.CallbackParam, value: Any) -> Any:
        if value is not None and value < least:
            raise UserError(f"{_flag(param)}: expected a whole number from {least}, got {value}")
        return value

    return check


def _flag(param: Any) -> str:
    """Return the spelling of an option for error messages: the long one."""
    return max(map(str, param.opts), key=len)


def separated(values: list[str] | None) -> list[str]:
    """Return the parts of a flag that may be repeated and may contain several parts separated by commas."""
    return [part.strip() for value in values or () for part in value.split(",") if part.strip()]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"skope {__version__}")
        raise typer.Exit


QuietOption = Annotated[bool, option("--quiet", "-q", help="Print results and errors only.")]
VersionOption = Annotated[
    bool, option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
]
PortOption = Annotated[
    int | None, option(least=0, help="Port to listen on.", show_default="8033, or any free one where it is taken")
]
JsonOption = Annotated[bool, option("--json", help="Print one JSON document with the same content instead.")]


class CommandGroup(TyperGroup):
    """Command group that suggests commands with the same or a similar name for an unknown word."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        word = args[0]
        if self.get_command(ctx, word) is None and not word.startswith("-"):
            group_name = " ".join(
                ["skope", *ctx.command_path.split(" ")[ctx.find_root().command_path.count(" ") + 1 :]]
            )
            raise UserError(f"{word}: `{group_name}` has no such command; {_meant(ctx.find_root().command, word)}")
        return super().resolve_command(ctx, args)


def _meant(root: Any, word: str) -> str:
    """Return a text with the commands of the whole program that a word may refer to."""
    names = {path: path.rpartition(" ")[2] for path in _paths(root, "skope")}
    near = get_close_matches(word, names.values(), n=2, cutoff=0.7)
    for alike in (
        lambda name: name == word,
        lambda name: word in name.split("-"),
        lambda name: word.startswith(name) or name in near,
    ):
        if found := [f"`{path}`" for path, name in names.items() if alike(name)]:
            return f"there is {' and '.join(found)}"
    return "`skope --help` lists what there is"


def _paths(group: Any, path: str) -> Iterator[str]:
    """Return the full names of all commands below a group, except hidden ones."""
    for name, command in getattr(group, "commands", {}).items():
        if not command.hidden:
            yield f"{path} {name}"
            yield from _paths(command, f"{path} {name}")


class Commands(typer.Typer):
    """A command group that adds `--quiet` to all its commands.

    A parameter of type `Console` receives a console that is silent with `--quiet`. A parameter with a dataclass type
    becomes one option for each field. If a group is itself a command, as `skope gen` is, its function is not called
    when a subcommand follows.
    """

    def __init__(self, *, cls: type[CommandGroup] = CommandGroup, **settings: Any) -> None:
        super().__init__(cls=cls, **settings)

    def command(self, *args: Any, **settings: Any) -> Callable[[C], C]:
        return _registering(super().command(*args, **settings))

    def callback(self, *args: Any, **settings: Any) -> Callable[[C], C]:
        return _registering(super().callback(*args, **settings))


def _registering(register: Callable[[Any], Any]) -> Callable[[C], C]:
    """Register the function that typer calls; the decorated function itself is unchanged."""

    def decorate(function: C) -> C:
        register(_for_typer(function))
        return function

    return decorate


def _for_typer(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function that typer calls instead of `function`; it also has the options of `Commands`."""
    parameters = inspect.signature(function).parameters
    options = [typer_option for parameter in parameters.values() for typer_option in _options(parameter)]

    def run(context: typer.Context, **values: Any) -> None:
        if context.invoked_subcommand is not None:
            _refuse_flags(context)
            return
        function(**{name: _argument(parameter, context, values) for name, parameter in parameters.items()})

    options.append(_keyword("quiet", QuietOption, False))
    signature = inspect.Signature([_keyword("context", typer.Context, inspect.Parameter.empty), *options])
    run.__signature__ = signature  # type: ignore[attr-defined]
    run.__annotations__ = {name: parameter.annotation for name, parameter in signature.parameters.items()}
    run.__name__, run.__doc__ = function.__name__, function.__doc__
    return run


def _keyword(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=annotation, default=default)


def _options(parameter: inspect.Parameter) -> Iterator[inspect.Parameter]:
    """Yield the parameters from which typer makes options and arguments, for one parameter of a function."""
    if parameter.annotation is Console:
        return
    group = is_dataclass(parameter.annotation)
    for member in inspect.signature(parameter.annotation).parameters.values() if group else (parameter,):
        yield _keyword(member.name, member.annotation, member.default)


def _argument(parameter: inspect.Parameter, context: typer.Context, values: dict[str, Any]) -> Any:
    """Return the value of one parameter for the call of a function."""
    kind = parameter.annotation
    if kind is Console:
        return Console(quiet=_quiet(context))
    if not is_dataclass(kind):
        return values[parameter.name]
    make: Any = kind
    return make(**{field.name: values[field.name] for field in fields(kind)})


def _quiet(context: Any) -> bool:
    """Return whether a command, or a group above it, was called with `--quiet`."""
    return bool(context.params.get("quiet")) or (context.parent is not None and _quiet(context.parent))


def _given(context: typer.Context, name: str) -> bool:
    """Return whether an option is on the command line."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _refuse_flags(context: typer.Context) -> None:
    """Raise a UserError if flags of a group are given before one of its commands."""
    for parameter in context.command.params:
        if parameter.name != "quiet" and _given(context, parameter.name or ""):
            raise UserError(
                f"{parameter.opts[0]}: is a flag of `{context.command_path}` by itself; write those of "
                f"`{context.invoked_subcommand}` after that word"
            )
