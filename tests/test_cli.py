"""What holds for every command."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from skope.console import Console


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
        (["gen", "convert", "--to", "yolo", "a", "b"], "skope.gen.formats.convert.convert"),
        (["eval", "--annotations", "a.json", "--predictions", "b.json"], "skope.metrics.inputs.read_annotations"),
        (["eval", "compare", "a", "b"], "skope.eval.report.compare.compare"),
    ],
)
def test_ctrl_c_gets_a_line(skope: Any, monkeypatch: pytest.MonkeyPatch, words: list[str], inside: str) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(inside, interrupted)
    code, _, error = skope(*words)
    assert code == 130
    assert error.strip() == "skope: stopped; the same command goes on from here, or begins again"


def test_ctrl_c_to_a_process_and_its_workers_gets_the_same_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "skope", "gen", "--sites", "t01_main_west", "--frames", "500"]
    command += ["--size", "64x36", "--out", str(tmp_path / "d"), "--workers", "2"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout
    process.stdout.readline()  # it has begun
    os.killpg(process.pid, signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error.strip().splitlines()[-1] == "skope: stopped; the same command goes on from here, or begins again"
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
    monkeypatch.setattr("skope.console.time.monotonic", lambda: clock[0])
    bar = Console().bar(total=1000, unit="image", label="slow")
    for _ in range(10):
        clock[0] += 10
        bar.n += 1
        bar.refresh()
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(" of ")[0] for line in lines] == ["slow: 3", "slow: 6", "slow: 9"]
    bar.close()
