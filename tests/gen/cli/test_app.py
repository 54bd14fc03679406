"""What `skope gen` says before and after its work."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from skope.cli import app


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Run `skope gen` without making anything; returns its lines."""
    monkeypatch.setattr("skope.gen.pipeline.generate.generate_dataset", lambda *_: True)

    def call(*words: str) -> list[str]:
        common = ["gen", "--renderer", "pybullet", "--workers", "1", "--out", str(tmp_path / "d")]
        result = CliRunner().invoke(app, [*common, *words], catch_exceptions=False)
        assert result.exit_code == 0, result.output
        return result.output.splitlines()

    return call


def test_the_first_line_counts_sites_and_recordings(said: Any) -> None:
    first, second, *_ = said("--sites", "t01_mill_corner", "--frames", "40")
    assert first.startswith("preset demo: 40 images of 640x360 from 1 site in 1 recording, seed 0, 1 worker, ")
    assert second.startswith("40 images to make, about ")
    assert said("--preset", "paper")[0].startswith(
        "preset paper: 13500 images of 1920x1080 from 13 sites in 130 record"
    )
    dry = said("--sites", "t01_mill_corner", "--frames", "40", "--dry-run")
    assert len(dry) == 2
    assert dry[0] == first


def test_a_long_recording_is_said_to_have_one_light(said: Any) -> None:
    words = "151 frames in a row have one weather and light: --recordings shares them out to several"
    assert words in said("--sites", "t01_mill_corner", "--frames", "151")
    assert not any("frames in a row" in line for line in said("--sites", "t01_mill_corner", "--frames", "150"))
    assert not any("frames in a row" in line for line in said("--preset", "full"))


@pytest.mark.parametrize(("site", "command"), [("t01_mill_corner", "train"), ("t01_main_west", "eval")])
def test_what_comes_next_fits_the_splits(said: Any, site: str, command: str) -> None:
    assert f"; next: skope {command} --data " in said("--sites", site, "--frames", "2")[-1]
