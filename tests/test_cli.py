"""What holds for every command."""

import ast
import importlib
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from rich.text import Text
from typer.testing import CliRunner

import skope as package
from skope import cli, schema
from skope.detector.backbones import BACKBONE_CHOICES
from skope.detector.network_settings import BACKEND_CHOICES, PRECISION_CHOICES, TILE_CHOICES
from skope.gen.formats.convert import READER_NAMES, WRITER_NAMES
from skope.gen.labels.ignore_rules import OCCLUSION_RULES
from skope.gen.labels.world_keypoints import LOCALIZER_CHOICES
from skope.gen.output.frames import SUFFIX_OF_FORMAT
from skope.gen.output.writers import DATASET_FORMATS
from skope.gen.pipeline.config import presets
from skope.gen.render.choose_renderer import RENDERER_CHOICES
from skope.gen.scene.conditions import TIMES_OF_DAY
from skope.keypoints import RESULT_SCHEMES
from skope.metrics.keypoint_outcomes import LABELLED_CHOICES, PROTOCOL_NAMES
from skope.metrics.match import BOX_KINDS
from skope.terminal import command_options
from skope.terminal.command_options import Commands, option
from skope.terminal.console import Console
from skope.train.export import EXPORT_SUFFIXES
from skope.train.init_weights import INIT_CHOICES
from skope.train.recipe import RECIPE_CHOICES, SUPERVISE_CHOICES
from tests.samples import make_dataset
from tests.waiting import HANG_S


def tree(command: Any, name: str = "skope") -> Iterator[tuple[str, Any]]:
    """Every command and group of the command line with its full name."""
    yield name, command
    for word, below in getattr(command, "commands", {}).items():
        yield from tree(below, f"{name} {word}")


EVERY = dict(tree(typer.main.get_command(cli.app)))


def parameters() -> Iterator[tuple[str, Any]]:
    """Every option and argument with the name of its command."""
    for name, command in EVERY.items():
        for parameter in command.params:
            yield name, parameter


# ------------------------------------------------------------------------------------------- what every command takes


def test_every_command_takes_quiet() -> None:
    for name, command in EVERY.items():
        flags = {flag for parameter in command.params if not parameter.hidden for flag in parameter.opts}
        # The vehicles' group does nothing by itself.
        assert name == "skope gen vehicles" or {"--quiet", "-q"} <= flags, name
        assert ("--version" in flags) == (name == "skope"), "one place for the version is enough"


def test_the_version_is_printed(skope: Any) -> None:
    assert skope("--version") == (0, f"skope {package.__version__}\n", "")


@dataclass(frozen=True, kw_only=True)
class Weather:
    """Options that commands share."""

    rain: Annotated[str, option(choices=("none", "some"), help="Rain [mm].")] = "none"
    sky: Annotated[str, option(choices=("blue", "grey"), several=True, help="Sky.")] = "blue"
    wind: Annotated[int, option(least=2, help="Wind.")] = 7


def toy() -> Commands:
    app = Commands()

    @app.callback(invoke_without_command=True)
    def group(console: Console, seed: int = 0) -> None:
        console.say("chatter")
        console.result(f"group {seed}")

    @app.command()
    def inner(weather: Weather, console: Console, name: str = "x") -> None:
        console.say("chatter")
        console.result(f"inner {weather.rain} {weather.wind} {name}{weather.sky.removeprefix('blue')}")

    return app


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "chatter\ngroup 0\n"),
        ("-q --seed 3", "group 3\n"),
        ("inner", "chatter\ninner none 7 x\n"),
        ("inner --quiet --rain some --name y", "inner some 7 y\n"),
        ("inner --quiet --sky blue,grey", "inner none 7 x,grey\n"),
        ("-q inner", "inner none 7 x\n"),
        ("-q inner --wind 3", "inner none 3 x\n"),
    ],
)
def test_commands_are_handed_what_they_take(words: str, said: str) -> None:
    result = CliRunner().invoke(toy(), words.split())
    assert (result.exit_code, result.output) == (0, said)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("inner --rain much", "--rain: 'much' is not one of none, some"),
        ("inner --sky grey,red", "--sky: 'red' is not one of blue, grey"),
        ("inner --wind 1", "--wind: expected a whole number from 2, got 1"),
        ("--seed 3 inner", "--seed: is a flag of"),
    ],
)
def test_what_they_do_not_take_is_said(words: str, said: str) -> None:
    assert str(CliRunner().invoke(toy(), words.split()).exception).startswith(said)


# ------------------------------------------------------------------------------------------------------------- --help


def test_help_says_all_that_was_written() -> None:
    """Rich takes brackets for markup: what stands in them would be missing."""
    for name, parameter in parameters():
        text = parameter.help or ""
        assert Text.from_markup(text).plain == text.replace("\\[", "["), (name, parameter.name)
    for name, command in EVERY.items():
        assert Text.from_markup(command.help or "").plain == (command.help or ""), name


def test_brackets_are_shown(skope: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    assert "(pip install 'skope[ray]')" in skope("gen", "--help")[1]
    told = skope("train", "--help")[1]
    assert "[default: (data/skope)]" in told
    assert "[default: (the recipe's)]" in told


CHOSEN = {
    "--preset": tuple(presets()),
    "--renderer": RENDERER_CHOICES,
    "--localizer": LOCALIZER_CHOICES,
    "--occlusion-rule": OCCLUSION_RULES,
    "--image-format": tuple(SUFFIX_OF_FORMAT),
    "skope gen --format": DATASET_FORMATS,
    "skope gen simulate --format": DATASET_FORMATS,
    "skope gen convert --to": WRITER_NAMES,
    "skope gen convert --from": READER_NAMES,
    "skope train export --to": tuple(EXPORT_SUFFIXES),
    "skope gen vehicles add --type": schema.VEHICLE_TYPES,
    "--weather": schema.WEATHER_NAMES,
    "--time-of-day": TIMES_OF_DAY,
    "--engine": ("local", "ray"),
    "--supervise": SUPERVISE_CHOICES,
    "--recipe": (*RECIPE_CHOICES, "FILE"),
    "--init": (*INIT_CHOICES, "FILE"),
    "skope train --backbone": tuple(BACKBONE_CHOICES),
    "--labelled": LABELLED_CHOICES,
    "--boxes": (*BOX_KINDS, "given"),
    "--scheme": RESULT_SCHEMES,
    "--protocol": PROTOCOL_NAMES,
    "--compare": ("paper",),
    "--precision": PRECISION_CHOICES,
    "--tiles": TILE_CHOICES,
    "--backend": BACKEND_CHOICES,
    "--device": ("auto", "cpu", "cuda", "cuda:N"),
    "--ground": ("auto", "fit", "none", "METRES"),
}


def test_the_choices_of_help_are_those_there_are() -> None:
    shown = {}
    for name, parameter in parameters():
        if parameter.param_type_name == "option" and (parameter.metavar or "").startswith("["):
            flag = parameter.opts[0]
            choices = parameter.metavar.removesuffix(",..")[1:-1]
            shown[flag if flag in CHOSEN else f"{name} {flag}"] = tuple(choices.split("|"))
    assert shown == CHOSEN


def test_help_stands_on_one_screen_and_names_what_there_is(skope: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERMINAL_WIDTH", "80")
    told = skope("--help")[1]
    assert len(told.splitlines()) <= 40
    words = set(told.replace(",", " ").replace(".", " ").replace(";", " ").split())
    below = {name.rpartition(" ")[2] for name in EVERY if name.count(" ") == 2}
    assert below - {"simulate", "render"} <= words  # the two halves of `skope gen`


@pytest.mark.parametrize(
    ("words", "answer"),
    [
        ("predict x.mp4", "predict: `skope` has no such command; there is `skope eval predict`"),
        ("track", "track: `skope` has no such command; there is `skope eval track`"),
        (
            "eval check",
            "check: `skope eval` has no such command; there is `skope gen check` and `skope gen vehicles check`",
        ),
        ("eval calibrate", "calibrate: `skope eval` has no such command; there is `skope eval calibrate-scores`"),
        ("evaluate", "evaluate: `skope` has no such command; there is `skope eval`"),
        ("gen mrege a b", "mrege: `skope gen` has no such command; there is `skope gen merge`"),
        (
            "gen vehicles nothing",
            "nothing: `skope gen vehicles` has no such command; `skope --help` lists what there is",
        ),
    ],
)
def test_an_unknown_word_is_answered_with_the_command_there_is(skope: Any, words: str, answer: str) -> None:
    assert skope(*words.split()) == (2, "", f"skope: {answer}\n")


def test_long_help_stands_in_panels() -> None:
    panels: dict[str, dict[str | None, list[str]]] = {}
    for name, parameter in parameters():
        if parameter.param_type_name == "option" and not parameter.hidden:
            panels.setdefault(name, defaultdict(list))[parameter.rich_help_panel].append(parameter.opts[0])
    titles = {name: {title for title in told if title} for name, told in panels.items()}
    gen = {"Sites and traffic", "Variation", "Camera and image", "Labels", "Output", "Machine"}
    assert titles["skope gen"] == titles["skope gen simulate"] == gen
    assert titles["skope train"] == {"Data", "Training", "Output", "Machine"}
    assert titles["skope eval"] == {"Data", "What counts", "Output", "Machine"}
    for name, told in panels.items():
        assert max(map(len, told.values())) <= 9, (name, told)


def test_a_flag_is_written_alike_everywhere() -> None:
    """One name, one kind of value."""
    kinds = defaultdict(set)
    for _, parameter in parameters():
        if parameter.param_type_name == "option" and not parameter.hidden:
            kind = "flag" if parameter.is_flag else parameter.metavar or parameter.type_descriptor.annotation
            kinds[parameter.opts[0]].add(kind)
    assert {flag: kind for flag, kind in kinds.items() if len(kind) > 1} == {
        "--out": {"DIR", "FILE"},  # what is written
        "--to": {f"[{'|'.join(WRITER_NAMES)}]", f"[{'|'.join(EXPORT_SUFFIXES)}]"},
        "--noise": {"A,B,..", float},
        "--keypoints": {"A,B,..", "flag"},  # names of points to write, and a layer to draw
        "--split": {"A,B,..", "NAME"},
        "--site": {"NAME|FILE", "FILE"},  # `gen sites` checks files only
        # Recordings have several, a video has one.
        "--weather": {choices := f"[{'|'.join(schema.WEATHER_NAMES)}]", f"{choices},.."},
        "--time-of-day": {choices := f"[{'|'.join(TIMES_OF_DAY)}]", f"{choices},.."},
    }


def test_sheets_of_sites(skope: Any, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data")
    assert skope("gen", "show", root, "--sites", "site", "--out", "new") == (0, "wrote new/site.png\n", "")
    assert skope("gen", "show", root, "--sites", "site,nowhere")[2].endswith("no image of site 'nowhere'\n")


def test_default_folders_are_named_in_one_place() -> None:
    root = Path(package.__file__).parent
    for path in (*root.rglob("cli.py"), *root.rglob("cli/*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not node.value.startswith(("data/", "runs/")), (path, node.value)
    assert (str(command_options.DATA_FOLDER), str(command_options.RUN_FOLDER)) == ("data/skope", "runs/skope")


# --------------------------------------------------------------------------------------------------- shell completion


def completed(*words: str, **environment: str) -> str:
    """What `skope` prints in such an environment."""
    call = "import sys; sys.argv[0] = 'skope'; from skope.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", call, *words],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout


def test_the_shell_gets_a_script_that_asks_skope() -> None:
    asked = completed(_SKOPE_COMPLETE="source_bash")
    shown = completed("--show-completion", "bash", _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1")
    for script in (asked, shown):
        assert "_SKOPE_COMPLETE=complete_bash" in script
        assert "complete -o default -F _skope_completion skope" in script


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("skope e", ["eval"]),
        ("skope gen vehicles ", ["list", "check", "show", "add", "remove"]),
        ("skope gen --ren", ["--renderer"]),
        ("skope gen --renderer ", list(RENDERER_CHOICES)),
        ("skope eval --boxes g", ["given"]),
    ],
)
def test_words_are_completed(line: str, words: list[str]) -> None:
    told = completed(_SKOPE_COMPLETE="complete_bash", COMP_WORDS=line, COMP_CWORD=str(len(line.split(" ")) - 1))
    assert told.split() == words


# --------------------------------------------------------------------------------------------- flags and interruptions


@pytest.mark.parametrize(
    ("words", "flag"),
    [
        (["eval", "--data", "x", "compare", "a", "b"], "--data"),
        (["train", "--epochs", "3", "export"], "--epochs"),
        (["gen", "--seed", "3", "check", "x"], "--seed"),
    ],
)
def test_flags_before_a_subcommand_are_refused_not_forgotten(skope: Any, words: list[str], flag: str) -> None:
    code, out, error = skope(*words)
    assert (code, out) == (2, "")
    assert error.startswith(f"skope: {flag}: is a flag of")
    assert f"`{words[3]}` after" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "inside"),
    [
        (["gen", "--out", "d"], "skope.gen.cli.app.Path.exists"),
        (["gen", "sites"], "skope.gen.towns.town.towns"),
        (["gen", "convert", "--to", "yolo", "a", "b"], "skope.gen.formats.convert.convert_dataset"),
        (["eval", "--annotations", "a.json", "--predictions", "b.json"], "skope.metrics.read_inputs.read_annotations"),
        (["eval", "compare", "a", "b"], "skope.eval.report.compare.compare"),
    ],
)
def test_ctrl_c_gets_a_line(skope: Any, monkeypatch: pytest.MonkeyPatch, words: list[str], inside: str) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    importlib.import_module("sumolib")  # whose import, were it interrupted, would leave pyproj in halves
    monkeypatch.setattr(inside, interrupted)
    code, _, error = skope(*words)
    assert code == 130
    assert error.strip() == "skope: stopped; run the same command again to resume or restart"


def test_ctrl_c_to_a_process_and_its_workers_gets_the_same_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "skope", "gen", "--sites", "t01_main_west", "--frames", "500"]
    command += ["--size", "64x36", "--out", str(tmp_path / "d"), "--workers", "2"]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A program that a shell has put into the background is born deaf to Ctrl-C, and so are those that it starts.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        start_new_session=True,
    )
    assert process.stdout
    process.stdout.readline()  # it has begun
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=HANG_S)
    assert process.returncode == 130
    assert error.strip().splitlines()[-1] == "skope: stopped; run the same command again to resume or restart"
    assert "Traceback" not in error


def test_progress_without_a_terminal_is_a_line_each_tenth(capsys: pytest.CaptureFixture[str]) -> None:
    for _ in Console().bar(range(200), unit="image", label="rendering"):
        time.sleep(0.005)
    with Console().bar(total=3, unit="epoch", label="training") as bar:
        bar.set_postfix({"loss": "0.1"})
        bar.update(3)
    for _ in Console(quiet=True).bar(range(3), unit="image", label="nothing"):
        pass
    error = capsys.readouterr().err
    assert "\r" not in error
    lines = error.splitlines()
    assert lines[-1] == "training: 3 of 3 epochs (100%), loss=0.1"
    assert lines[-2] == "rendering: 200 of 200 images (100%)"
    assert 2 <= len(lines) - 1 <= 11
    assert all(line.startswith("rendering: ") and line.endswith(" left") for line in lines[:-2])


def test_slow_work_without_a_terminal_says_something_each_half_minute(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = [0.0]
    monkeypatch.setattr("skope.terminal.console.time.monotonic", lambda: clock[0])
    bar = Console().bar(total=1000, unit="image", label="slow")
    for _ in range(10):
        clock[0] += 10
        bar.n += 1
        bar.refresh()
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(" of ")[0] for line in lines] == ["slow: 3", "slow: 6", "slow: 9"]
    bar.close()


@pytest.mark.parametrize(("given", "threads"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")])
def test_the_command_limits_numpy_to_one_thread_before_numpy_is_imported(given: dict[str, str], threads: str) -> None:
    name = "OPENBLAS_NUM_THREADS"
    code = (
        "import os, sys, importlib.abc\n"
        "class Watch(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, module, *_):\n"
        f"        if module == 'numpy': print(os.environ.get('{name}'))\n"
        "sys.meta_path.insert(0, Watch())\n"
        "import skope.__main__\n"
    )
    environment = {key: value for key, value in os.environ.items() if key != name} | given
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == [threads]
