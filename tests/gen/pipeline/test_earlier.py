"""What an earlier layout of the package left behind is read and gone on with: a recording, a dataset half made.

The folder earlier was made at commit eb2d498, before modules and classes had their present places and names.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from skope.dataset.folder import open_dataset
from skope.gen.scene import recording as recordings
from skope.gen.scene.package_versions import versions
from skope.gen.towns.town import Town
from tests import hostile

EARLIER = Path(__file__).parent / "earlier"


def test_recordings_load() -> None:
    recording = recordings.load(EARLIER / "begun" / "recordings" / "t01_main_west_00.npz")
    assert recording.town == Town("town01")
    assert (recording.site, len(recording)) == ("t01_main_west", 3)
    assert len(recording.moment(0).labelled().vehicles) > 3
    own = recordings.load(EARLIER / "own_road_00.npz")
    assert own.town.road is not None
    assert own.town == Town.of(own.town.road)
    assert own.town.network.read_bytes() == b"<net/>"


def test_a_dataset_that_was_begun_is_finished_by_the_same_edition(
    skope: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shutil.copytree(EARLIER / "begun", tmp_path / "d")
    path = tmp_path / "d" / ".work" / "parameters.json"
    begun = json.loads(path.read_text())
    # Releases of other packages may have come since: this test is not about them.
    begun["parameters"]["versions"] = versions()
    path.write_text(json.dumps(begun))
    before = {file.relative_to(EARLIER / "begun"): file.read_bytes() for file in EARLIER.rglob("*.png")}
    assert len(before) == 2
    monkeypatch.setattr("skope.gen.pipeline.workers.make_renderer", hostile.FlatRenderer)
    words = "--sites t01_main_west --frames 3 --size 64x48 --seed 4 --renderer pybullet --no-depth --image-format png"
    code, _, error = skope("gen", *words.split(), "--workers", 1, "--out", "d")
    said = "skope: d: was begun when models were marked by edition 1 of the keypoints' definition, and labels are"
    assert (code, error.startswith(said)) == (2, True), error
    code, _, error = skope("gen", "render", "d", "--workers", 1)
    assert (code, error.startswith(said)) == (2, True), error
    begun["parameters"]["keypoint_edition"] = 2
    path.write_text(json.dumps(begun))
    code, _, error = skope("gen", *words.split(), "--workers", 1, "--out", "d")
    assert code == 0, error
    made = open_dataset(tmp_path / "d").read("medium")
    assert len(made.images) == 3
    assert all((tmp_path / "d" / name).read_bytes() == data for name, data in before.items())
    done = [json.loads(line) for name in ("00_000000", "00_000001") for line in rows(name)]
    kept = [a for a in made.annotations if a.image_id in {image.id for image in made.images[:2]}]
    assert [row["track_id"] for row in done] == [a.track_id for a in kept]


def rows(frame: str) -> list[str]:
    """The annotations that were written down for a frame."""
    path = EARLIER / "begun" / ".work" / "frames" / "t01_main_west" / f"{frame}.jsonl"
    return path.read_text().splitlines()[1:]
