"""Counts at a gate in the image by a camera that is knocked: boxes before and after it, in each view's own pixels."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from skope.camera.motion.view_registration import transformed
from skope.dataset import coco
from skope.dataset.folder import CHANGES_KEY
from skope.schema import AnnotationFile, Result, RoadUserResult
from skope.site.gates_zones_lanes import Gate
from skope.tracking.image_trajectories import read_image_trajectories
from tests.camera.motion.test_view_registration import turned_and_zoomed
from tests.sightings import drive

FPS = 10.0
KNOCKED = turned_and_zoomed(-3, 0.5, 1.5)
LEFT_S, SETTLED_S = 6.0, 6.4
GATE = Gate(name="g", pixels=((240.0, 300.0), (240.0, 60.0)), directions=("right", "left"))
Skope = Callable[..., tuple[int, str, str]]


def write_seen(folder: Path, matrix: NDArray[np.float64] | None, *, known: bool = True) -> None:
    """Twelve vehicles that drive to the right, one a second, 80 px/s each; `matrix` is the view after `LEFT_S`.

    Vehicle k crosses column 240 at 1.05 + k seconds, in another lane of five.
    """
    driven = drive(14.0, FPS, speeds=(0.0,))
    images = tuple(replace(image, width=640, height=360, camera=None) for image in driven.images)
    rows: list[Result | RoadUserResult] = []
    for image in images:
        time_s = image.time_s or 0.0
        for k in range(12):
            foot = np.array([240 + 80 * (time_s - 1.05 - k), 120 + 40.0 * (k % 5)])
            if matrix is not None and time_s >= LEFT_S:
                foot = transformed(matrix, foot) if time_s >= SETTLED_S else foot + [200, 0]
            if 30 < foot[0] < 610:
                box = np.array([foot[0] - 20, foot[1] - 30, 40, 30])
                rows.append(Result(image_id=image.id, score=0.9, bbox=box, keypoints=np.zeros((33, 3)), track_id=k + 1))
    info: dict[str, Any] = {"source": "a.mp4"}
    if matrix is not None:
        change: dict[str, Any] = {"time_s": LEFT_S, "cut": False, "shift": 0.04}
        followed = {"settled_s": SETTLED_S, "homography": matrix.tolist(), "residual_px": 0.1, "corner_error_px": 0.1}
        info[CHANGES_KEY] = [change | (followed if known else {})]
    folder.mkdir()
    coco.write(
        folder / "frames.json",
        AnnotationFile(images=images, annotations=(), info=info, name="a.mp4", scheme=driven.scheme),
    )
    coco.write_results(folder / "predictions.json", rows)


def test_all_vehicles_are_counted_before_and_after_a_knock(skope: Skope) -> None:
    Path("site.toml").write_text(
        '[[gates]]\nname = "g"\npixels = [[240, 300], [240, 60]]\ndirections = ["right", "left"]\n'
    )
    events = {}
    for name, matrix, known in (("still", None, True), ("knocked", KNOCKED, True), ("lost", KNOCKED, False)):
        write_seen(Path(name), matrix, known=known)
        code, out, error = skope("eval", "traffic", name, "--out", f"{name}_report")
        assert code == 0, error
        rows = list(csv.DictReader(Path(f"{name}_report/events.csv").read_text().splitlines()))
        events[name] = {row["track"]: row for row in rows}
        if name == "lost":
            assert "skope eval predict VIDEO --start 7.0 --out second" in " ".join(out.split())
    assert len(events["still"]) == 12
    assert len(events["knocked"]) == 12
    assert len(events["lost"]) == 5
    assert {row["direction"] for row in events["knocked"].values()} == {"right"}
    for track, row in events["still"].items():
        moved = events["knocked"][track]
        assert float(moved["time_s"]) == pytest.approx(float(row["time_s"]), abs=0.06)
        assert float(moved["y"]) == pytest.approx(float(row["y"]), abs=0.5)
    for name, seconds in (("still", 14.0), ("knocked", 14.0 - (SETTLED_S - LEFT_S)), ("lost", LEFT_S)):
        summary = json.loads(Path(f"{name}_report/summary.json").read_text())
        assert summary["observed_s"] == pytest.approx(seconds, abs=0.01)


def test_only_the_movement_is_not_observed(tmp_path: Path) -> None:
    write_seen(tmp_path / "knocked", KNOCKED)
    tracks, observation, notes = read_image_trajectories(tmp_path / "knocked", [GATE])
    assert observation.spans == pytest.approx(np.array([[0, 6.0], [6.4, 14.0]]))
    assert observation.camera_moved_s == pytest.approx([6.0, 6.1, 6.2, 6.3])
    assert len(tracks) == 12
    (note,) = notes
    assert "from 6.4 s on" in note
    for track in tracks:  # each drives on in its lane, at its speed
        assert np.ptp(track.position[:, 1]) < 0.01
        assert np.diff(track.position[:, 0]) / np.diff(track.times_s) == pytest.approx(80.0, abs=0.5)


def test_a_view_that_does_not_show_a_gate_is_not_observed(tmp_path: Path) -> None:
    """Most of the picture is still in view, but not the gate at its left edge."""
    aside = np.array([[1, 0, -120], [0, 1, 0], [0, 0, 1.0]])
    write_seen(tmp_path / "knocked", aside)
    edge = replace(GATE, name="edge", pixels=((100.0, 300.0), (100.0, 60.0)))
    _, observation, notes = read_image_trajectories(tmp_path / "knocked", [GATE, edge])
    assert observation.observed_s == pytest.approx(LEFT_S)
    assert "does not show all of gate 'edge' (0%)" in notes[0]
    assert read_image_trajectories(tmp_path / "knocked", [GATE])[1].observed_s == pytest.approx(13.6)
