"""What mkdocs.yml needs besides docs/: the README as the first page, and pages on commands and Python from the code.

mkdocs calls the functions by their names. Links that leave docs/ become plain text, as what they name is not published.
A line `<!-- program: NAME -->` of a page is replaced by the text of examples/gallery/NAME.py.
"""

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from python_reference import python_reference

from skope import cli

ROOT: Final = Path(__file__).parents[1]
_LINK: Final = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s]+)\)")
_PROGRAM: Final = re.compile(r"^<!-- program: (\w+) -->$", re.MULTILINE)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8").replace("](docs/", "](")
    for name, text in {
        "index.md": readme,
        "command-line.md": command_line(),
        "python-reference.md": python_reference(),
    }.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Keep only the words of links to files that are no pages, and insert the programs of the gallery."""

    def kept(link: re.Match[str]) -> str:
        words, target = link.groups()
        name = target.partition("#")[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(page.file.src_uri), name))
        published = not name or "://" in name or files.get_file_from_path(path) is not None
        return link.group() if published else words

    return _PROGRAM.sub(lambda line: program(line[1]), _LINK.sub(kept, markdown))


def program(name: str) -> str:
    """Return a fenced code block with a program of the gallery."""
    text = (ROOT / "examples" / "gallery" / f"{name}.py").read_text(encoding="utf-8")
    return f"```python\n{text}```"


def command_line() -> str:
    """A Markdown page with every command, its arguments and options."""
    parts = ["# Command line", "Made from the program itself; `--help` says the same."]
    for name, command in commands(typer.main.get_command(cli.app), "skope"):
        parts += [f"## `{name}`", (command.help or "").strip()]
        rows = [row for parameter in command.params if (row := parameter_row(parameter))]
        if rows:
            parts.append("\n".join(["| option | meaning |", "|---|---|", *rows]))
    return "\n\n".join(parts) + "\n"


def commands(command: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Every command and group that is not hidden, with its full name."""
    if not command.hidden:
        yield name, command
        for word, below in getattr(command, "commands", {}).items():
            yield from commands(below, f"{name} {word}")


def parameter_row(parameter: Any) -> str | None:
    """A row of the table; None for what is hidden or the same everywhere."""
    words = getattr(parameter, "help", None)
    if getattr(parameter, "hidden", False) or not words or parameter.name in ("help", "quiet", "version"):
        return None
    flags = parameter.opts if parameter.param_type_name == "option" else [(parameter.metavar or parameter.name).upper()]
    spelled = " ".join(f"`{flag}`" for flag in [*flags, *parameter.secondary_opts])
    escaped = " ".join(str(words).split()).replace("|", "\\|").replace("<", "&lt;")
    return f"| {spelled} | {escaped} |"
