"""Estimates of images, disk space and time. Their accuracy is measured in docs/evidence/scale.md."""

from pathlib import Path
from typing import Any

import pytest

from skope.gen.output.frames import Encoding
from skope.gen.pipeline.dataset_store import Store
from skope.gen.pipeline.estimate import Estimate, estimate
from tests.gen.pipeline.test_config import asked

FLAGS = ["gen", "--sites", "t01_main_west", "--frames", 3, "--renderer", "pybullet", "--dry-run", "--out", "d"]


@pytest.fixture(autouse=True)
def many_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skope.gen.pipeline.estimate.usable_processors", lambda: 4)


def seconds(root: Path, workers: int = 1, **changes: Any) -> float:
    found = estimate(asked("demo", **{"frames": 40, "driver": "llvmpipe", **changes}), Store(root), workers).seconds
    assert found is not None
    return found


def test_a_dry_run_says_one_line_and_writes_nothing(skope: Any) -> None:
    code, out, error = skope(*FLAGS, "--workers", 2, "--quiet")
    assert (code, error) == (0, "")
    assert out.startswith("3 images to make, about 1 MB and ")
    assert out.endswith(" s with 2 workers\n")
    assert out.count("\n") == 1
    assert not list(Path().iterdir())


def test_a_dry_run_refuses_what_the_run_would_refuse(skope: Any) -> None:
    Path("d").mkdir()
    Path("d/thesis.txt").write_text("mine")
    code, out, error = skope(*FLAGS)
    assert (code, out) == (2, "")
    assert error == "skope: d: contains other files and no dataset; choose an empty folder with --out\n"
    Path("d/thesis.txt").unlink()
    Path("d").rmdir()
    Path("d").write_text("mine")
    assert skope(*FLAGS)[2] == "skope: d: cannot be written: d is a file\n"
    Path("d").unlink()
    Store(Path("d")).begin(asked(seed=4).dataset_plan())
    assert "was started with other parameters" in skope(*FLAGS)[2]


def test_what_is_there_is_not_made_again(tmp_path: Path) -> None:
    request = asked("demo", sites=("t01_main_west",), frames=4)
    store = Store(tmp_path)
    store.begin(request.dataset_plan())
    whole = estimate(request, store, 1)
    for frame in range(3):
        path = tmp_path / ".work" / "frames" / "t01_main_west" / f"00_{frame:06d}.jsonl"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    rest = estimate(request, store, 1)
    assert (whole.images, rest.images) == (4, 1)
    assert rest.disk_bytes == whole.disk_bytes / 4
    assert rest.seconds is not None
    assert whole.seconds is not None
    assert rest.seconds < whole.seconds
    path.with_name("00_000003.jsonl").touch()
    assert estimate(request, store, 1).line == "all images exist already"


def test_more_work_takes_longer_and_more_workers_do_not(tmp_path: Path) -> None:
    plain = seconds(tmp_path)
    assert plain < seconds(tmp_path, frames=80) < 2 * plain
    assert seconds(tmp_path, size="1920x1080") > plain
    assert seconds(tmp_path, weather=("rain",)) > seconds(tmp_path, weather=("clear",))
    assert plain > 2 * seconds(tmp_path, driver="a GPU")
    assert seconds(tmp_path, town_jitter=True) > plain
    assert seconds(tmp_path, shape_jitter=True) > plain
    assert plain / 2 > seconds(tmp_path, workers=4) == seconds(tmp_path, workers=64)  # there are four cores
    # One recording is simulated by one worker.
    alone = {"sites": ("t01_main_west",), "frames": 400, "size": "32x32"}
    assert seconds(tmp_path, workers=4, **alone) > seconds(tmp_path, workers=1, **alone) / 3


def test_a_file_without_depth_or_of_less_quality_is_smaller(tmp_path: Path) -> None:
    sizes = [
        estimate(asked("demo", encoding=encoding), Store(tmp_path), 1).disk_bytes
        for encoding in (Encoding(image="png"), Encoding(), Encoding(quality=85), Encoding(quality=85, depth=False))
    ]
    assert sizes == sorted(sizes, reverse=True)
    assert len(set(sizes)) == 4


def test_an_estimate_in_words() -> None:
    assert Estimate(1, 2.5e9, 3000.0, 1, 1).line == "1 image to make, about 2.5 GB and 50 min with 1 worker"
    assert Estimate(7, 2.5e6, 60.0, 16, 2).line == "7 images to make, about 2 MB and 60 s with 16 workers on 2 cores"
    assert (
        Estimate(7, 2.5e6, None, None, None).line == "7 images to make, about 2 MB; the time on a cluster is not known"
    )


def test_a_wrong_number_of_workers_is_refused(skope: Any) -> None:
    assert skope(*FLAGS, "--workers", 0)[2] == "skope: --workers: expected a whole number from 1, got 0\n"
