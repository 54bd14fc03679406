import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from skope.cli import app, main
from skope.dataset import open_dataset
from skope.gen.check import check

SMALL = ["--sites", "t01_mill_corner,t01_main_west", "--frames", "5", "--size", "192x108", "--quiet"]


def gen(out: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "skope", "gen", "--out", str(out), *SMALL, *more]


def content(root: Path) -> dict[str, bytes]:
    """Every file of a dataset, by its path."""
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dataset made in one go by one process."""
    out = tmp_path_factory.mktemp("gen") / "whole"
    subprocess.run(gen(out, "--workers", "1"), check=True, capture_output=True)
    return out


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
    assert len(dataset.card["fleet"]["held_out"]) >= 4
    assert "hood_front_left" in dataset.card["fleet"]["substituted"]["van"]


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


# ---------------------------------------------------------------------------------------------------------------- check


def damaged(whole: Path, tmp_path: Path) -> tuple[Path, dict]:
    root = tmp_path / "damaged"
    subprocess.run(["cp", "-r", str(whole), str(root)], check=True)
    return root, json.loads((root / "annotations" / "medium.json").read_text())


def vehicle_in_view(document: dict) -> dict:
    """An annotation with several visible points."""
    return max(document["annotations"], key=lambda a: a["area"])


def move_keypoint(document: dict) -> None:
    annotation = vehicle_in_view(document)
    k = annotation["keypoints"][2::3].index(2)
    annotation["keypoints"][3 * k] = (annotation["keypoints"][3 * k] + 40) % 190


def show_hidden(document: dict) -> None:
    annotation = vehicle_in_view(document)
    for k in range(33):
        if annotation["keypoints"][3 * k + 2] == 1:
            annotation["keypoints"][3 * k + 2] = 2


def hide_in_image(document: dict) -> None:
    annotation = vehicle_in_view(document)
    k = annotation["keypoints"][2::3].index(2)
    annotation["keypoints"][3 * k : 3 * k + 3] = [0, 0, 0]


def widen_box(document: dict) -> None:
    vehicle_in_view(document)["bbox"][2] = 500


def repeat_id(document: dict) -> None:
    document["annotations"][1]["id"] = document["annotations"][0]["id"]


def other_site(document: dict) -> None:
    document["images"][0]["site"] = "t01_mill_corner"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (move_keypoint, ["keypoints", "px from where keypoints_3d projects"]),
        (show_hidden, ["has v = 2", "depth file"]),
        (hide_in_image, ["has v = 0"]),
        (widen_box, ["bbox", "out of the image"]),
        (repeat_id, ["id", "stands twice"]),
        (other_site, ["site", "t01_mill_corner"]),
    ],
)
def test_check_finds_damaged_labels(damage, words: list[str], whole: Path, tmp_path: Path) -> None:
    root, document = damaged(whole, tmp_path)
    damage(document)
    (root / "annotations" / "medium.json").write_text(json.dumps(document))
    findings = list(check(open_dataset(root)))
    assert any(all(word in finding for word in words) for finding in findings), findings
    assert all("medium.json" in finding or "train.json" in finding for finding in findings)


def test_check_finds_damaged_files(whole: Path, tmp_path: Path) -> None:
    root, document = damaged(whole, tmp_path)
    names = [image["file_name"] for image in document["images"]]
    (root / names[0]).unlink()
    (root / names[1]).write_bytes((root / names[1]).read_bytes()[:700])
    cv2.imwrite(str(root / names[2]), np.zeros((10, 10, 3), np.uint8))
    depth = root / document["images"][3]["depth_file_name"]
    depth.write_bytes(b"no picture")
    result = CliRunner().invoke(app, ["gen", "check", str(root)])
    assert result.exit_code == 1
    for name, word in ((names[0], "no such file"), (names[1], "truncated"), (names[2], "10x10"), (str(depth), "depth")):
        assert any(name in line and word in line for line in result.output.splitlines()), (name, word)
    assert result.output.splitlines()[-1].endswith("4 findings")


def test_check_of_a_sound_dataset(whole: Path) -> None:
    result = CliRunner().invoke(app, ["gen", "check", str(whole)])
    assert result.exit_code == 0
    assert result.output == f"{whole}: no findings\n"
