"""Names in backticks in docstrings are names of something that is there."""

import ast
import builtins
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import skope

ROOT = Path(skope.__file__).parent
NAME = re.compile(r"[A-Za-z_]\w*(\.\w+)*")
OF_OTHERS = {
    "NAME.md": "a pattern",
    "NAME.safetensors": "a pattern",
    "NAME.steps": "a pattern",
    "Validation": "a name as others write it",
    "calib": "a folder of Rope3D",
    "calib3d": "a module of OpenCV",
    "denorm": "a folder of Rope3D",
    "heatmaps_to_keypoints": "a function of torchvision",
    "instances_val2017": "a file of COCO",
    "kp_32": "a name as users write it",
    "loadRes": "a method of pycocotools",
    "logging": "an extra of pyproject.toml",
    "np.cross": "a function of numpy",
    "ry": "a column of KITTI",
    "torch.utils.data.DataLoader": "a class of torch",
    "torch.utils.data.Dataset": "a class of torch",
    "torchrun": "a program of torch",
    "xywh": "a format of boxes",
    "xyxy": "a format of boxes",
}
"""Names in docstrings that stand nowhere in the code, since others gave them."""


def texts_of(nodes: list[ast.AST]) -> list[ast.Constant]:
    """Texts that stand alone: in modules, classes and functions, and below constants and fields."""
    alone = (node.value for node in nodes if isinstance(node, ast.Expr))
    return [value for value in alone if isinstance(value, ast.Constant) and isinstance(value.value, str)]


def defined(body: list[ast.stmt]) -> set[str]:
    """Names that statements define or import."""
    found: set[str] = set()
    for node in body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            found |= {alias.asname or alias.name for alias in node.names}
        else:
            found |= {one.id for one in ast.walk(node) if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)}
    return found


class Module:
    """What a module has that a docstring can speak of."""

    def __init__(self, path: Path) -> None:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        nodes = list(ast.walk(tree))
        self.docstrings = texts_of(nodes)
        told = set(map(id, self.docstrings))
        strings = [one.value for one in nodes if isinstance(one, ast.Constant) and isinstance(one.value, str)]
        in_code = [one.value for one in nodes if isinstance(one, ast.Constant) and id(one) not in told]
        self.defined = defined(tree.body)
        self.values = {text.rpartition("/")[2] for text in strings}
        """Strings: keys and values in files; of paths the names of the files."""
        self.identifiers = set(re.findall(r"\w+", " ".join(text for text in in_code if isinstance(text, str))))
        """Names of variables, arguments, attributes and imports, and words of strings."""
        for node in nodes:
            for kind in ("id", "attr", "arg", "name", "asname", "module"):
                if isinstance(value := getattr(node, kind, None), str):
                    self.identifiers |= set(value.split("."))
        self.members = {node.name: members_of(node) for node in nodes if isinstance(node, ast.ClassDef)}
        """Names of attributes by the name of their class."""


def members_of(node: ast.ClassDef) -> set[str]:
    """Names of a class's fields, methods and of attributes in its methods."""
    return defined(node.body) | {one.attr for one in ast.walk(node) if isinstance(one, ast.Attribute)}


class Package:
    """What there is in a package that a docstring can speak of."""

    def __init__(self, root: Path) -> None:
        self.name = root.name
        self.modules: dict[str, Module] = {}
        self.members: dict[str, set[str]] = {}
        for path in root.rglob("*.py"):
            parts = [root.name, *path.relative_to(root).with_suffix("").parts]
            module = Module(path)
            self.modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = module
            for name, members in module.members.items():
                self.members.setdefault(name, set()).update(members)
        names = {name.rpartition(".")[2] for name in self.modules}
        names |= set().union(*(module.defined for module in self.modules.values()), *self.members.values())
        self.public = {name for name in names if not name.startswith("_")}
        self.values = set().union(*(module.values for module in self.modules.values()))

    def has(self, path: str) -> bool:
        """Whether a dotted name that begins with the package's is that of a module or of something in one."""
        place, _, name = path.rpartition(".")
        if path in self.modules:
            return True
        if place not in self.modules:
            return False
        module = self.modules[place]
        # What the package itself hands on is loaded when it is first used: its name is text there.
        return name in module.defined | (module.values if place == self.name else set())

    def unknown(self) -> list[str]:
        """Module, line and name of each name in backticks that is not there."""
        return sorted({f"{module}:{line}: {name}" for module, line, name in self._unknown()})

    def _unknown(self) -> Iterator[tuple[str, int, str]]:
        for place, module in self.modules.items():
            here = module.identifiers | set(dir(builtins))
            for text in module.docstrings:
                for name in re.findall(r"`([^`\n]+)`", str(text.value)):
                    if not NAME.fullmatch(name) or name in OF_OTHERS or name in self.values:
                        continue
                    first, *rest = name.split(".")
                    if first == self.name:
                        there = self.has(name)
                    elif rest and first in self.members:
                        there = set(rest) <= self.members[first]
                    else:
                        there = {first, *rest} <= here | self.public
                    if not there:
                        yield place, text.lineno, name


def test_every_name_in_a_docstring_is_there() -> None:
    assert Package(ROOT).unknown() == []


def test_what_others_named_is_told_of() -> None:
    told = "".join(path.read_text(encoding="utf-8") for path in ROOT.rglob("*.py"))
    assert [name for name in OF_OTHERS if f"`{name}`" not in told] == []


@pytest.mark.parametrize(
    ("told", "unknown"),
    [
        ("`here` and `there.Thing` and `Thing.part`, `small.there.made`, `--flag`, `skope gen`, `a + b`", []),
        ("`gone`", ["gone"]),
        ("`Thing.gone`", ["Thing.gone"]),
        ("`small.there.gone` and `small.gone`", ["small.gone", "small.there.gone"]),
        ("`there.gone`", ["there.gone"]),
        ("`_inner`", ["_inner"]),
    ],
)
def test_what_is_not_there_is_found(tmp_path: Path, told: str, unknown: list[str]) -> None:
    root = tmp_path / "small"
    root.mkdir()
    (root / "__init__.py").write_text("")
    (root / "there.py").write_text("class Thing:\n    part: int\n\n\ndef made():\n    _inner = 1\n    return _inner\n")
    (root / "module.py").write_text(f'def here():\n    """Tells of {told}."""\n')
    assert [line.rpartition(" ")[2] for line in Package(root).unknown()] == unknown
