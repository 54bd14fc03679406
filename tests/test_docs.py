"""README and docs: short where they should be, links that lead somewhere, commands whose options exist."""

import inspect
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

import skope
from skope import cli

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "skope").rglob("*.md")])
LINK = re.compile(r"\]\(([^)\s]+)\)")
COMMAND = re.compile(r"^ {4,}(?:torchrun .* -m )?skope ([^#\n]+)", flags=re.MULTILINE)
MADE_UP = "..."
"""Stands in a command for what a reader chooses."""


def slug(heading: str) -> str:
    """The anchor of a heading, as code hosts make it."""
    return re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-")


def commands() -> list[tuple[str, str]]:
    found = [(page.name, line.strip()) for page in PAGES for line in COMMAND.findall(page.read_text(encoding="utf-8"))]
    return list(dict.fromkeys(found))


def resolved(words: list[str]) -> tuple[Any, list[str]]:
    """The command that words name, and what follows its name."""
    command: Any = typer.main.get_command(cli.app)
    while words and words[0] in getattr(command, "commands", {}):
        command, words = command.commands[words[0]], words[1:]
    return command, words


def test_the_website_is_built_without_a_warning(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "mkdocs",
        "build",
        "--quiet",
        "--config-file",
        ROOT / "mkdocs.yml",
        "-d",
        tmp_path / "site",
    ]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    page = (tmp_path / "site" / "command-line" / "index.html").read_text(encoding="utf-8")
    assert all(
        f"<code>{words}</code>" in page for words in ("skope gen", "skope eval predict", "--frames", "--every-frame")
    )
    reference = (tmp_path / "site" / "python-reference" / "index.html").read_text(encoding="utf-8")
    named = [
        name for name in skope.__all__ if inspect.isfunction(value := getattr(skope, name)) or inspect.isclass(value)
    ]
    assert [name for name in named if f"<code>skope.{name}</code>" not in reference] == []
    assert "<code>Detector.video</code>" in reference


def test_what_python_calls_says_what_it_takes() -> None:
    functions = [value for name in skope.__all__ if inspect.isfunction(value := getattr(skope, name))]
    assert len(functions) > 10
    for function in functions:
        told = inspect.getdoc(function) or ""
        arguments = [name for name in inspect.signature(function).parameters if f"\n    {name}: " not in told]
        assert arguments == [], function.__name__
        assert "Raises:" in told


def test_the_readme_is_read_to_its_end() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 90


def test_every_page_is_linked_from_the_readme_or_a_page_that_is() -> None:
    reached, left = set(), [ROOT / "README.md"]
    while left:
        page = left.pop()
        reached.add(page)
        links = (page.parent / link.split("#")[0] for link in LINK.findall(page.read_text(encoding="utf-8")))
        pages = {link.resolve() for link in links if link.suffix == ".md" and link.is_file()}
        left += pages - reached
    assert set(PAGES) <= reached


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if link.startswith(("http://", "https://")):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), flags=re.MULTILINE)
            assert anchor in map(slug, headings), link


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/architecture.md"])
def test_files_in_backticks_are_there(page: str) -> None:
    names = re.findall(r"`([\w./]+\.(?:py|toml|md|js))`", (ROOT / page).read_text(encoding="utf-8"))
    assert len(names) > 20
    files = [path for top in ("skope", "tests", "scripts") for path in (ROOT / top).rglob("*.*")]
    for name in names:
        assert (ROOT / name).is_file() or any(path.match(f"*/{name}") for path in files) or "NN" in name, name


@pytest.mark.parametrize(("page", "line"), commands(), ids=lambda text: text[:60])
def test_options_of_commands_exist(page: str, line: str) -> None:
    command, words = resolved(shlex.split(line.replace(MADE_UP, "")))
    options = {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
    named = [word.partition("=")[0] for word in words if word.startswith("--")]
    assert set(named) <= options | {"--help", "--version", "--quiet"}, line
