"""The page on Python: every function and class of `import skope`, made from signatures and docstrings."""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from types import ModuleType
from typing import Any, Final

from python_examples import EXAMPLES

import skope
from skope.camera.calibrate import SiteCalibration
from skope.camera.fit.fit_camera import CameraEstimate
from skope.dataset.folder import Dataset, LabelledImage
from skope.detections import RoadUserDetections
from skope.pose.estimate_pose import Poses
from skope.pose.pose_records import Located
from skope.tracking.track_list import TrackedRoadUser, Tracks
from skope.tracking.tracks import Track
from skope.traffic.gate_counts import Count
from skope.traffic.traffic_report import TrafficReport

GIVEN: Final = (
    *(Dataset, LabelledImage, RoadUserDetections, Located, Poses, Track, Tracks, TrackedRoadUser),
    *(Count, TrafficReport, SiteCalibration, CameraEstimate),
)
"""Classes that nobody makes by hand, but that functions give."""
_SECTION: Final = re.compile(r"^(Args|Returns|Raises|Yields):\n((?:(?: .*)?\n)*)", re.MULTILINE)
_ENTRY: Final = re.compile(r"^    (\S[^:\n]*): ", re.MULTILINE)
_WORDS: Final = {"Args": "Arguments", "Returns": "Returns", "Raises": "Raises", "Yields": "Yields"}


def python_reference() -> str:
    """The page, as Markdown."""
    named = {name: getattr(skope, name) for name in skope.__all__}
    functions = {name: value for name, value in named.items() if inspect.isfunction(value)}
    classes = {name: value for name, value in named.items() if inspect.isclass(value)}
    modules = {name: value for name, value in named.items() if inspect.ismodule(value)}
    parts = ["# Python reference", "Made from the program itself. [The guide](python.md) has longer examples."]
    parts.append("Lines that begin with `#>` are the output of an example for a small video and dataset.")
    parts.append("## Functions")
    for name, value in functions.items():
        parts += described(f"skope.{name}", value)
        parts.append(example(name))
    parts.append("## Classes")
    for name, value in classes.items():
        parts += class_described(f"skope.{name}", value)
    parts.append("## What functions give")
    for value in GIVEN:
        parts += class_described(value.__name__, value)
    parts.append("## Modules and version")
    for name, value in modules.items():
        parts += [f"### `skope.{name}`", inspect.getdoc(value) or "", example(name)]
        for function in own_functions(value):
            parts += described(f"{name}.{function.__name__}", function, "####")
    parts += ["### `skope.__version__`", "Version of skope.", example("__version__")]
    return "\n\n".join(parts) + "\n"


def example(name: str) -> str:
    """The example of a public name, as a block of code."""
    return f"```python\n{EXAMPLES[name].strip()}\n```"


def own_functions(module: ModuleType) -> list[Any]:
    """The public functions that a module defines, in the order of its text."""
    found = (value for name, value in vars(module).items() if inspect.isfunction(value) and not name.startswith("_"))
    return [value for value in found if value.__module__ == module.__name__]


def described(name: str, function: Any, level: str = "###") -> Iterator[str]:
    """Heading, signature and docstring of a function."""
    yield f"{level} `{name}`"
    yield f"```python\n{signature(name.rpartition('.')[2], function)}\n```"
    yield formatted(inspect.getdoc(function) or "")


def signature(name: str, function: Any) -> str:
    """A function's signature as it is called, in lines that are read without scrolling."""
    node = parsed(function)
    assert isinstance(node, ast.FunctionDef)
    asked = [part for part in commas(ast.unparse(node.args)) if part not in ("self", "cls")]
    gives = f" -> {bare(node.returns)}" if node.returns else ""
    asked = [re.sub(r"^(\*{0,2}\w+: .*?)=", r"\1 = ", re.sub(r": '([^']*)'", r": \1", part)) for part in asked]
    line = f"{name}({', '.join(asked)}){gives}"
    return line if len(line) <= 110 else f"{name}(\n    " + ",\n    ".join(asked) + f",\n){gives}"


def parsed(value: Any) -> ast.stmt:
    """The definition of a function or class."""
    return ast.parse(textwrap.dedent(inspect.getsource(value))).body[0]


def bare(annotation: ast.expr) -> str:
    """A type as text, also where it is text in the code."""
    text = ast.unparse(annotation)
    return text[1:-1] if text.startswith("'") else text


def commas(text: str) -> list[str]:
    """A text cut at the commas that stand in no bracket."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "([{") - (letter in ")]}")
        if letter == "," and not depth:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def formatted(doc: str) -> str:
    """A docstring with its sections as lists."""

    def listed(section: re.Match[str]) -> str:
        body = textwrap.dedent(section[2]).strip()
        if section[1] in ("Args", "Raises"):
            entries = _ENTRY.split(section[2])[1:]
            pairs = zip(entries[::2], entries[1::2], strict=True)
            body = "\n".join(f"- `{name}`: {' '.join(text.split())}" for name, text in pairs)
        return f"**{_WORDS[section[1]]}**\n\n{body}\n\n"

    return _SECTION.sub(listed, doc + "\n").strip()


def class_described(name: str, kind: type) -> Iterator[str]:
    """A class with its fields, properties and methods, also those that it has from another class of skope."""
    yield f"### `{name}`"
    yield formatted(inspect.getdoc(kind) or "")
    yield example(name.rpartition(".")[2])
    rows: dict[str, str] = {}
    methods: dict[str, Any] = {}
    for one in reversed(kind.__mro__):
        if not one.__module__.startswith("skope."):
            continue
        rows |= fields(one)
        for member, value in vars(one).items():
            if member.startswith("_") and member not in ("__call__", "__getitem__", "__iter__"):
                continue
            bare = getattr(value, "fget", None) or getattr(value, "func", None)
            if bare is not None:
                rows[member] = inspect.getdoc(bare) or ""
            elif inspect.isfunction(value) and inspect.getdoc(value):
                methods[member] = value
    if rows:
        cells = (f"| `{member}` | {escaped(text)} |" for member, text in rows.items())
        yield "\n".join(["| field | meaning |", "|---|---|", *cells])
    for member, value in methods.items():
        yield from described(f"{kind.__name__}.{member}", value, "####")


def escaped(text: str) -> str:
    """A text as a cell of a table."""
    return " ".join(text.split()).replace("|", "\\|")


def fields(kind: type) -> dict[str, str]:
    """The public fields of a class with the docstrings below them; where there is none, their type."""
    tree = parsed(kind)
    assert isinstance(tree, ast.ClassDef)
    found: dict[str, str] = {}
    for node, below in zip(tree.body, [*tree.body[1:], None], strict=True):
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        told = below.value if isinstance(below, ast.Expr) else None
        text = (
            told.value
            if isinstance(told, ast.Constant) and isinstance(told.value, str)
            else f"`{bare(node.annotation)}`"
        )
        if not node.target.id.startswith("_"):
            found[node.target.id] = text
    return found
