import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from skope.cli import main
from skope.dataset import open_dataset
from skope.gen.check import check
from tests.gen.small import content, gen


def test_a_dataset_is_whole(whole: Path) -> None:
    dataset = open_dataset(whole)
    assert dataset.splits == ("medium", "train")
    for split in dataset.splits:
        file = dataset.read(split)
        assert len(file.images) == 5
        assert [image.frame_index for image in file.images] == list(range(5))
        assert [image.time_s for image in file.images] == [0, 0.5, 1.0, 1.5, 2.0]
        for image in file.images:
            assert dataset.image(image).shape == (108, 192, 3)
            depth = dataset.depth(image)
            assert depth is not None
            assert depth.shape == (108, 192)
    assert list(check(dataset)) == []
    assert not (whole / ".work").exists()
    assert dataset.card["counts"]["images"] == 10
    assert dataset.card["localizer_difference_m"]["max"] < 0.5
    assert {"skope", "sumo", "pybullet"} <= dataset.card["versions"].keys()


def test_workers_make_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    subprocess.run(gen(tmp_path / "d", "--workers", "2"), check=True, capture_output=True)
    assert content(tmp_path / "d") == content(whole)


def test_killed_at_any_moment_it_goes_on_to_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(4):
        process = subprocess.Popen(
            gen(out, "--workers", "1"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        files = len(list(out.rglob("*"))) if out.exists() else 0
        goal, deadline = files + int(rng.integers(2, 8)), time.monotonic() + 60
        while process.poll() is None and time.monotonic() < deadline:
            if out.exists() and len(list(out.rglob("*"))) >= goal:
                break
            time.sleep(0.005)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        seen.append((out / "dataset.json").exists())
    assert not seen[0]
    subprocess.run(gen(out, "--workers", "1"), check=True, capture_output=True)
    assert content(out) == content(whole)


def test_a_complete_dataset_is_left_alone(whole: Path) -> None:
    before = content(whole)
    result = subprocess.run(gen(whole), check=True, capture_output=True, text=True)
    assert "complete already" in result.stdout
    assert content(whole) == before


def test_other_parameters_are_refused_by_name(whole: Path) -> None:
    result = subprocess.run(gen(whole, "--seed", "1"), capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert "seed = 0, now 1" in result.stderr
    assert "frames" not in result.stderr
    assert "Traceback" not in result.stderr


def test_a_folder_of_other_things_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    result = subprocess.run(gen(tmp_path), capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert str(tmp_path) in result.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--preset", "huge"], ["--preset", "huge", "demo"]),
        (["--sites", "nowhere"], ["nowhere", "t01_mill_corner"]),
        (["--size", "wide"], ["--size", "wide"]),
        (["--size", "0x0"], ["--size"]),
        (["--frames", "0"], ["--frames"]),
        (["--fov", "200"], ["--fov"]),
        (["--workers", "0"], ["--workers"]),
        (["--renderer", "crayon"], ["--renderer", "crayon", "pybullet"]),
        (["--interval", "0.03"], ["--interval"]),
        (["--seed", "-1"], ["--seed"]),
        (["--localizer", "guess"], ["--localizer", "rigid"]),
        (["--occlusion-rule", "none"], ["--occlusion-rule", "others"]),
        (["--min-visible", "2"], ["--min-visible"]),
    ],
)
def test_bad_flags_get_one_line(
    flags: list[str],
    words: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "argv", ["skope", "gen", "--out", str(tmp_path / "d"), *flags])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert all(word in error for word in words)
    assert not (tmp_path / "d").exists()


def test_no_rights_to_write(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    result = subprocess.run(gen(blocked / "d"), capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert str(blocked) in result.stderr
