"""Every command of docs/from-camera-to-tracks.md, on fewer frames than it says."""

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.dataset.camera_of_file import read_camera

ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "docs" / "from-camera-to-tracks.md"
SMALLER = {
    "--frames 60": "--frames 4 --workers 1",
    "--epochs 10": "--epochs 1 --max-images 1 --recipe scratch --min-size 120",
    "--seconds 30": "--seconds 2",
    "--noise 0,1,2,5": "--noise 0,2",
    "--overlay --blur": "--overlay --blur --every 10 --score 0.05",
    "eval track seen": "eval track seen --score 0.05",
    "found.json": "found.json --max-vehicles 30",
    "crossing.mp4 --overlay": "crossing.mp4 --overlay --end 0.6",
    "eval camera crossing": "eval camera --annotations footage/site.json --noise 1 --max-vehicles 30",
}


def commands() -> list[str]:
    return re.findall(r"^\s{4,}skope ([^#\n]+)", GUIDE.read_text(encoding="utf-8"), flags=re.MULTILINE)


def test_the_commands_that_are_made_smaller_stand_in_the_guide() -> None:
    text = "\n".join(commands())
    assert len(commands()) == 16
    assert all(part in text for part in SMALLER)


@pytest.mark.slow
def test_every_command_of_the_guide_runs(skope: Any, tmp_path: Path) -> None:
    shutil.copytree(ROOT / "examples" / "own_road", tmp_path, dirs_exist_ok=True)
    camera, _ = read_camera(Path("camera.yml"))
    xy = camera.position[:2] + (15 + 6 * np.arange(6))[:, None] * np.array(
        [[np.cos(camera.angles[0] + a), np.sin(camera.angles[0] + a)] for a in (-0.2, 0.2, 0, -0.1, 0.15, 0)]
    )
    world = np.column_stack([xy, np.zeros(6)])
    pixels, _, valid = camera.project(world)
    assert valid.all()
    lines = [",".join(map(str, (*uv, *xyz))) for uv, xyz in zip(pixels, world, strict=True)]
    Path("points.csv").write_text("column,row,x,y,z\n" + "\n".join(lines) + "\n")
    for command in commands():
        for long, short in SMALLER.items():
            command = command.replace(long, short)
        code, out, err = skope(*command.split())
        assert code == 0, (command, out, err)
        if command.startswith("gen video"):  # which stands for the reader's own footage
            shutil.copy("footage/site.mp4", "crossing.mp4")
