"""Figures on the package's own code: documented parameters, names with several homes, long functions, the import graph.

    python scripts/house_figures.py                      # of this checkout
    python scripts/house_figures.py --before OLDER_TREE  # beside those of another checkout
    python scripts/house_figures.py --names              # and the names behind the figures

It reads source text alone and imports nothing of the trees.
"""

import argparse
import ast
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

DOCUMENTED_PARAMETERS: Final = 3
"""Public functions of so many parameters and more are expected to explain them."""
LONG_FUNCTION_LINES: Final = 60
SHARED_CONSTANT_MODULES: Final = 2
"""A constant's name of one word may stand in so many modules."""
GROUPS: Final = ("skope", "skope.gen", "skope.eval")
"""Packages whose folders and modules are rooms, as in tests/test_imports.py."""
QUESTION: Final = re.compile(r"(What|Where|How|Which|Who)\b")

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass
class Figures:
    """What is counted in one tree; each list holds the names, whose number is the figure."""

    documented: list[str] = field(default_factory=list)
    """Public functions of three and more parameters with `Args` in their docstring."""
    undocumented: list[str] = field(default_factory=list)
    """Those without."""
    shared_constants: list[str] = field(default_factory=list)
    """Constants of one word that stand in more than two modules."""
    several_homes: list[str] = field(default_factory=list)
    """Public names that more than one module defines."""
    long_functions: list[str] = field(default_factory=list)
    long_bodies: list[str] = field(default_factory=list)
    """Functions whose statements alone, without parameters and docstring, are as long."""
    questions: list[str] = field(default_factory=list)
    """Docstrings that begin with a word of a question."""
    graphs: dict[str, dict[str, set[str]]] = field(default_factory=dict)
    """The rooms that each room imports, by group."""
    circles: list[str] = field(default_factory=list)
    """Modules that import each other, by way of others or not."""

    def rows(self) -> dict[str, str]:
        """The figures by what they are called, as text."""
        asked = len(self.documented) + len(self.undocumented)
        share = f"{len(self.documented)} of {asked} ({len(self.documented) / max(asked, 1):.0%})"
        rows = {
            f"public functions of {DOCUMENTED_PARAMETERS}+ parameters with Args": share,
            f"one-word constants in more than {SHARED_CONSTANT_MODULES} modules": str(len(self.shared_constants)),
            "public names with several homes": str(len(self.several_homes)),
            f"functions over {LONG_FUNCTION_LINES} lines": str(len(self.long_functions)),
            f"functions over {LONG_FUNCTION_LINES} lines of statements": str(len(self.long_bodies)),
            "docstrings that begin with a question": str(len(self.questions)),
        }
        for group, graph in self.graphs.items():
            arrows = sum(map(len, graph.values()))
            rows[f"rooms, arrows, floors of {group}"] = f"{len(graph)}, {arrows}, {floors(graph)}"
        return {**rows, "circles of modules": str(len(self.circles))}

    def names(self) -> dict[str, list[str]]:
        """The names behind the figures."""
        return {
            "without Args": self.undocumented,
            "one-word constants": self.shared_constants,
            "several homes": self.several_homes,
            "long functions": self.long_functions,
            "questions": self.questions,
            "circles": self.circles,
        }


def figures(tree: Path) -> Figures:
    """Count in a checkout that has the package in its folder `skope`."""
    paths = modules(tree)
    parsed = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in paths.items()}
    found = Figures()
    constants: dict[str, list[str]] = defaultdict(list)
    homes: dict[str, list[str]] = defaultdict(list)
    for name, body in parsed.items():
        for constant in constants_of(body):
            if re.fullmatch(r"_?[A-Z][A-Z0-9]*", constant):
                constants[constant].append(name)
        for public in public_names(body):
            homes[public].append(name)
        for function, is_public in functions_of(body):
            place = f"{name}:{function.lineno} {function.name}"
            if is_public and len(parameters(function)) >= DOCUMENTED_PARAMETERS:
                told = "Args:" in (ast.get_docstring(function) or "")
                (found.documented if told else found.undocumented).append(place)
            if (function.end_lineno or function.lineno) - function.lineno >= LONG_FUNCTION_LINES:
                found.long_functions.append(place)
            if statement_lines(function) > LONG_FUNCTION_LINES:
                found.long_bodies.append(place)
        found.questions += [f"{name}:{line} {text}" for line, text in docstrings(body) if QUESTION.match(text)]
    found.shared_constants = [
        f"{constant}: {', '.join(where)}"
        for constant, where in sorted(constants.items())
        if len(where) > SHARED_CONSTANT_MODULES
    ]
    found.several_homes = [f"{name}: {', '.join(where)}" for name, where in sorted(homes.items()) if len(where) > 1]
    imports = import_graph(parsed, paths)
    found.graphs = {group: room_graph(imports, group) for group in GROUPS}
    found.circles = [" <-> ".join(sorted(circle)) for circle in circles(imports)]
    return found


def modules(tree: Path) -> dict[str, Path]:
    """The files of the package by the modules' dotted names."""
    found = {}
    for path in sorted((tree / "skope").rglob("*.py")):
        parts = path.relative_to(tree).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def assigned(node: ast.stmt) -> list[str]:
    """Names that a statement assigns to, but those of type variables, which are alike everywhere."""
    if isinstance(node, ast.Assign) and ast.unparse(node.value).startswith("TypeVar("):
        return []
    if isinstance(node, ast.AnnAssign):
        targets: list[ast.expr] = [node.target]
    else:
        targets = node.targets if isinstance(node, ast.Assign) else []
    return [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]


def constants_of(body: ast.Module) -> list[str]:
    """Names of a module's constants, in capitals."""
    return [name for node in body.body for name in assigned(node) if name.isupper()]


def public_names(body: ast.Module) -> set[str]:
    """What a module defines for others: functions, classes, constants and types."""
    defined = {node.name for node in body.body if isinstance(node, ast.ClassDef | Function)}
    return {name for name in defined.union(*map(assigned, body.body)) if not name.startswith("_")}


def functions_of(body: ast.Module) -> Iterator[tuple[Function, bool]]:
    """Every function, and whether it is public: a module's or a public class's own, and no command with its options."""
    public = [*body.body]
    for node in body.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            public += node.body
    shown = {id(node) for node in public}
    for one in ast.walk(body):
        if isinstance(one, Function):
            yield one, id(one) in shown and not one.name.startswith("_") and not is_command(one)


def is_command(function: Function) -> bool:
    """Whether its parameters are options of the command line, which have help texts instead."""
    text = " ".join(ast.unparse(decorator) for decorator in function.decorator_list)
    return bool(re.search(r"\.(command|callback)\(", text))


def statement_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function's statements, without its decorators, parameters and docstring."""
    documented = ast.get_docstring(function) is not None
    statements = function.body[1:] if documented else function.body
    return (function.end_lineno or 0) - statements[0].lineno + 1 if statements else 0


def parameters(function: Function) -> list[str]:
    """A function's parameters but `self` and `cls`."""
    own = function.args
    every = [*own.posonlyargs, *own.args, *own.kwonlyargs, *filter(None, (own.vararg, own.kwarg))]
    return [one.arg for one in every if one.arg not in ("self", "cls")]


def docstrings(body: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and text of each string that stands alone: in modules, classes, functions and below fields."""
    for node in ast.walk(body):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value.strip().partition("\n")[0]


def import_graph(parsed: Mapping[str, ast.Module], paths: Mapping[str, Path]) -> dict[str, set[str]]:
    """The modules of the package that each module imports, anywhere in it."""
    graph: dict[str, set[str]] = {}
    for name, body in parsed.items():
        package = name if paths[name].name == "__init__.py" else name.rpartition(".")[0]
        imported: set[str] = set()
        for node in ast.walk(body):
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
                base = ".".join([*above, *filter(None, [node.module])])
                imported |= {f"{base}.{alias.name}" for alias in node.names}
        known = {one if one in parsed else one.rpartition(".")[0] for one in imported}
        graph[name] = (known & parsed.keys()) - {name}
    return graph


def room_graph(imports: Mapping[str, set[str]], group: str) -> dict[str, set[str]]:
    """The rooms of a group, its folders and modules, each with the rooms that it imports."""

    def room(name: str) -> str:
        return name.removeprefix(f"{group}.").partition(".")[0] if name.startswith(f"{group}.") else ""

    graph: dict[str, set[str]] = {}
    for name, others in imports.items():
        if own := room(name):
            graph.setdefault(own, set()).update(other for one in others if (other := room(one)) not in ("", own))
    return graph


def floors(graph: Mapping[str, set[str]]) -> int:
    """Rooms on the longest way down through imports; those of a circle stand on one floor."""
    left, count = dict(graph), 0
    while left:
        free = {name for name, others in left.items() if not others & left.keys()} or set(left)
        left = {name: others for name, others in left.items() if name not in free}
        count += 1
    return count


def circles(graph: Mapping[str, set[str]]) -> list[set[str]]:
    """Groups of modules that reach each other."""
    left = dict(graph)
    while free := {name for name, others in left.items() if not others & left.keys()}:
        left = {name: others for name, others in left.items() if name not in free}
    reached = {name: reach(left, name) for name in left}
    found: list[set[str]] = []
    for name in left:
        own = {other for other in reached[name] if name in reached[other]}
        if own and own not in found:
            found.append(own)
    return found


def reach(graph: Mapping[str, set[str]], begin: str) -> set[str]:
    """Everything that a module imports by way of others."""
    seen: set[str] = set()
    waiting = [begin]
    while waiting:
        new = graph.get(waiting.pop(), set()) - seen
        seen |= new
        waiting += new
    return seen & graph.keys()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tree", nargs="?", type=Path, default=Path(__file__).parents[1], help="a checkout of skope")
    parser.add_argument("--before", type=Path, help="another checkout, whose figures come first")
    parser.add_argument("--names", action="store_true", help="list what is counted, too")
    asked = parser.parse_args()
    for tree in filter(None, (asked.tree, asked.before)):
        if not (tree / "skope").is_dir():
            parser.error(f"{tree}: has no folder skope")
    now = figures(asked.tree)
    before = figures(asked.before).rows() if asked.before else {}
    print("| figure | before | now |\n|---|---|---|" if before else "| figure | now |\n|---|---|")
    for name, value in now.rows().items():
        print(f"| {name} | {before[name]} | {value} |" if before else f"| {name} | {value} |")
    if asked.names:
        for name, every in now.names().items():
            print(f"\n{name}", *every, sep="\n  ")


if __name__ == "__main__":
    main()
