"""The notebooks of examples/ run as they stand, in miniature and in full, and measure what is true."""

import json
import shutil
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from shapely import LineString

from tests.metrics import brute

EXAMPLES = Path(__file__).parents[1] / "examples"
NOTEBOOKS = sorted((EXAMPLES / "notebooks").glob("*.ipynb"))
DETECTOR = "from_nothing_to_a_detector"
COUNTS = "from_a_video_to_counts_and_speeds"

SMALL_DETECTOR = {
    "TRAIN_SITES": ["t01_mill_corner"],
    "FRAMES": 3,
    "SIZE": (640, 360),
    "EPOCHS": 1,
    "MIN_SIZE": 270,
    "TUNE": {"trainable_layers": 0, "keypoint_regions": 1, "regions": 8},
    "RANDOM": {
        "min_size": 64,
        "max_size": 114,
        "keypoint_regions": 1,
        "regions": 8,
        "network.pyramid_width": 16,
        "network.keypoint_layers": 1,
        "network.keypoint_width": 16,
        "network.box_width": 16,
    },
}
SMALL_COUNTS = {
    "SECONDS": 6,
    "FPS": 5,
    "SIZE": "480x270",
    "GATES": '[[gates]]\nname = "east"\nline = [[10, -9], [10, 9]]\ndirections = ["in", "out"]\n',
}
"""Values that replace those of the settings at the top."""


@pytest.fixture(autouse=True)
def apart(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Keep the files of Jupyter and its kernels out of the user's folders."""
    folder = tmp_path_factory.mktemp("jupyter")
    for name in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(folder))


def executed(name: str, folder: Path, settings: dict[str, Any], wanted: str) -> Any:
    """Run a notebook in a copy of the folder with other settings; return the value of an expression at its end.

    The settings go into a cell of their own, below the one with the tag "parameters".
    """
    shutil.copytree(EXAMPLES / "own_road", folder / "own_road")
    (folder / "notebooks").mkdir()
    notebook = nbformat.read(EXAMPLES / "notebooks" / f"{name}.ipynb", as_version=4)
    (place,) = (i for i, cell in enumerate(notebook.cells) if "parameters" in cell.metadata.get("tags", ()))
    code = "\n".join(f"assert {name} is not ...\n{name} = {value!r}" for name, value in settings.items())
    notebook.cells.insert(place + 1, nbformat.v4.new_code_cell(code))
    notebook.cells.append(nbformat.v4.new_code_cell(f"import json\nprint(json.dumps({wanted}))"))
    NotebookClient(notebook, timeout=1200, resources={"metadata": {"path": str(folder / "notebooks")}}).execute()
    pictures = [output for cell in notebook.cells for output in cell.get("outputs", ()) if "image/png" in str(output)]
    assert len(pictures) >= 2
    return json.loads(notebook.cells[-1].outputs[-1].text)


# ----------------------------------------------------------------------------------------------------- as they are kept


def test_there_are_two_notebooks() -> None:
    assert {path.stem for path in NOTEBOOKS} == {DETECTOR, COUNTS}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_without_results(path: Path) -> None:
    document = json.loads(path.read_text(encoding="utf-8"))
    nbformat.validate(document)
    assert {*document["metadata"]} == {"kernelspec"}
    assert document["metadata"]["kernelspec"] == {"display_name": "Python 3", "language": "python", "name": "python3"}
    for cell in document["cells"]:
        assert cell.get("outputs", []) == []
        assert cell.get("execution_count") is None
        assert {*cell["metadata"]} <= {"tags"}
    assert sum("tags" in cell["metadata"] for cell in document["cells"]) == 1


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_links_of_a_notebook_lead_somewhere(path: Path) -> None:
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    text = "".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    links = [part.split(")")[0] for part in text.split("](")[1:]]
    assert links
    assert all((path.parent / link).exists() for link in links)


# --------------------------------------------------------------------------------------------------------- the detector


@pytest.mark.slow
@pytest.mark.parametrize("settings", [pytest.param(SMALL_DETECTOR, id="small"), pytest.param({}, id="full")])
def test_the_detector_is_trained_and_scored(settings: dict[str, Any], tmp_path: Path) -> None:
    wanted = "{'scores': scores, 'losses': losses, 'split': test_split}"
    told = executed(DETECTOR, tmp_path, settings, wanted)
    data, runs = tmp_path / "notebooks" / "data", tmp_path / "notebooks" / "runs"
    truth = json.loads((data / "roads" / "annotations" / f"{told['split']}.json").read_text())
    assert {image["site"] for image in truth["images"]} == {"t06_plaza_opening"}
    for name in ("road33", "tuned", "random"):
        found = json.loads((runs / f"{name}.json").read_text())
        assert told["scores"][name]["matched"] == matched(truth, found)
    assert told["scores"]["road33"]["matched"] > 0
    assert told["losses"]["tuned"][0] < told["losses"]["random"][0]
    if not settings:
        assert told["scores"]["road33"]["box_recall"]["pooled"] > 0.5
        assert told["losses"]["random"][-1] < told["losses"]["random"][0]


def matched(truth: Any, found: Any) -> int:
    """Number of labelled vehicles that a detection above 0.5 overlaps by 60%, worked out vehicle by vehicle."""
    count = 0
    for image in truth["images"]:
        vehicles = [
            one["bbox"] for one in truth["annotations"] if one["image_id"] == image["id"] and "ignore_reason" not in one
        ]
        boxes = [one["bbox"] for one in found if one["image_id"] == image["id"] and one["score"] > 0.5]
        count += sum(any(brute.iou(vehicle, box) >= 0.6 for box in boxes) for vehicle in vehicles)
    return count


# ---------------------------------------------------------------------------------------------------- counts and speeds


@pytest.mark.parametrize(
    "settings", [pytest.param(SMALL_COUNTS, id="small"), pytest.param({}, id="full", marks=pytest.mark.slow)]
)
def test_vehicles_are_counted_as_they_drove(settings: dict[str, Any], tmp_path: Path) -> None:
    wanted = "{'counts': [[*key, n] for key, n in counts.items()], 'speeds': speeds, 'error_m': error_m}"
    told = executed(COUNTS, tmp_path, settings, wanted)
    truth = crossings(
        json.loads((tmp_path / "notebooks" / "runs" / "clip" / "site.json").read_text()),
        (tmp_path / "notebooks" / "runs" / "site.toml").read_text(),
    )
    assert {(gate, direction): n for gate, direction, n in told["counts"]} == truth
    assert sum(truth.values()) >= 2
    assert told["error_m"] < 0.1
    speed, sigma, true = np.array(told["speeds"]).T
    assert len(speed) == sum(truth.values())
    assert (np.abs(speed - true) < 3 + 3 * sigma).all()


def crossings(truth: Any, site: str) -> dict[tuple[str, str], int]:
    """Number of vehicles by gate and direction, from where each path begins and ends."""
    paths: dict[int, list[list[float]]] = {}
    for vehicle in truth["annotations"]:
        paths.setdefault(vehicle["track_id"], []).append(vehicle["box_3d"]["center"][:2])
    count: Counter[tuple[str, str]] = Counter()
    for gate in tomllib.loads(site)["gates"]:
        (x0, y0), (x1, y1) = gate["line"]
        for path in paths.values():
            if LineString(path).crosses(LineString(gate["line"])):
                (x, y) = path[0]
                left = (x1 - x0) * (y - y0) > (y1 - y0) * (x - x0)
                count[gate["name"], gate["directions"][0 if left else 1]] += 1
    return dict(count)
