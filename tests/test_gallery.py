"""The gallery: its programs in miniature, its page and its pictures."""

import ast
import importlib.util
import json
import runpy
import tarfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgba
from PIL import Image

import skope as api
from skope.detections import Detections
from skope.files.json_files import json_bytes
from skope.schema import Annotation
from skope.tracks.csv_file import write_tracks
from skope.traffic.observation import Observation
from tests.samples import make_dataset
from tests.traffic.drives import drive, straight
from tests.train.conftest import shrink

ROOT: Final = Path(__file__).parents[1]
GALLERY: Final = ROOT / "examples" / "gallery"
PAGE: Final = ROOT / "docs" / "gallery" / "index.md"
PROGRAMS: Final = (
    "label_images_coco",
    "train_on_own_road",
    "evaluate_other_results",
    "boxes_3d",
    "speed_profile",
    "turning_movements",
    "time_space",
    "near_misses",
    "own_vehicle",
    "export_dataset",
)
MAX_LINES: Final = 40
"""Maximum number of lines of a program, without its docstring and empty lines."""
MAX_BYTES: Final = 120_000
"""Maximum size of a picture of the page."""
SITE: Final = """
[[gates]]
name = "west"
line = [[-20, -8], [-20, 8]]
directions = ["in", "out"]

[[gates]]
name = "east"
line = [[20, 8], [20, -8]]
directions = ["in", "out"]

[[gates]]
name = "north"
line = [[-5, 20], [5, 20]]
directions = ["in", "out"]

[[zones]]
name = "junction"
polygon = [[-10, -10], [10, -10], [10, 10], [-10, 10]]
"""
SPEED_MPS: Final = 10.0


def main_of(name: str) -> Callable[..., None]:
    """Return the function `main` of a program."""
    return runpy.run_path(str(GALLERY / f"{name}.py"))["main"]  # type: ignore[no-any-return]


@pytest.fixture(autouse=True)
def closed_figures() -> Any:
    """Close the figures of a test, which can look at them before."""
    plt.close("all")
    yield
    plt.close("all")


# ------------------------------------------------------------------------------------------------------------ the page


def test_the_page_has_every_program() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert {path.stem for path in GALLERY.glob("*.py")} == {*PROGRAMS, "make_clip"}
    for name in (*PROGRAMS, "make_clip"):
        assert text.count(f"\n<!-- program: {name} -->\n") == 1
        assert f"](../../examples/gallery/{name}.py)" in text
    assert [line for line in text.splitlines() if line.startswith("![")] == [
        line for name in PROGRAMS for line in text.splitlines() if line.startswith("![") and f"]({name}.jpg)" in line
    ]
    assert text.count("\n![") == len(PROGRAMS)


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_is_short(name: str) -> None:
    text = (GALLERY / f"{name}.py").read_text(encoding="utf-8")
    end = ast.parse(text).body[0].end_lineno
    assert 10 <= sum(bool(line.strip()) for line in text.splitlines()[end:]) <= MAX_LINES


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_picture_fits_the_page(name: str) -> None:
    path = PAGE.parent / f"{name}.jpg"
    with Image.open(path) as picture:
        assert 800 <= picture.width <= 1000
    assert path.stat().st_size < MAX_BYTES


def test_the_text_of_a_program_is_inserted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    spec = importlib.util.spec_from_file_location("mkdocs_hooks", ROOT / "docs" / "mkdocs_hooks.py")
    assert spec
    assert spec.loader
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    page = SimpleNamespace(file=SimpleNamespace(src_uri="gallery/index.md"))
    files = SimpleNamespace(get_file_from_path=lambda path: None)
    built = hooks.on_page_markdown(PAGE.read_text(encoding="utf-8"), page, None, files)
    assert "<!-- program" not in built
    for name in PROGRAMS:
        text = (GALLERY / f"{name}.py").read_text(encoding="utf-8")
        assert f"```python\n{text}```\n" in built


# ----------------------------------------------------------------------------------------------------- traffic programs


@pytest.fixture(scope="module")
def junction(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A folder of tracks and a site file. All vehicles drive at 36 km/h.

    Four vehicles drive from west to east, two turn from west to north. One more passes from north to south 2 s behind
    the last of the four.
    """
    folder = tmp_path_factory.mktemp("junction")
    site = folder / "site.toml"
    site.write_text(SITE)
    tracks = [
        straight(number, (-60.0, -2.0), (SPEED_MPS, 0.0), 12.0, begin_s=20.0 * number, sigma=0.02)
        for number in range(4)
    ]
    since = np.arange(121) * 0.1 * SPEED_MPS
    turning = np.column_stack([np.minimum(-60 + since, 2.0), np.maximum(-2.0, since - 64)])
    tracks += [drive(4 + k, turning, 10 + 20.0 * k + np.arange(121) * 0.1, sigma=0.02) for k in range(2)]
    # The last of the four is at x = 0 at 66 s, this one at y = -2 at 68 s.
    tracks.append(straight(6, (0.0, 58.0), (0.0, -SPEED_MPS), 9.0, begin_s=62.0, sigma=0.02))
    (folder / "tracks").mkdir()
    times_s = np.arange(751, dtype=np.float64) * 0.1
    tracks = [replace(track, frames=np.rint(track.times_s * 10).astype(np.intp)) for track in tracks]
    write_tracks(folder / "tracks" / "tracks.csv", tracks)
    observed = Observation(times_s=times_s, common_scale_sigma=0.0)
    (folder / "tracks" / "footage.json").write_bytes(json_bytes(observed.to_dict()))
    return folder / "tracks", site


def test_turning_movements_are_counted(
    junction: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main_of("turning_movements")(*junction, tmp_path / "a.jpg")
    assert capsys.readouterr().out.splitlines() == ["west to east: 4", "west to north: 2"]
    axes = plt.gcf().axes[0]
    wide, narrow = (line for line in axes.get_lines() if " to " in str(line.get_label()))
    assert wide.get_linewidth() == 2 * narrow.get_linewidth()
    assert np.asarray(wide.get_xydata()) == pytest.approx(
        np.column_stack([np.linspace(-20, 20, 60), np.full(60, -2.0)]), abs=0.01
    )
    assert np.asarray(narrow.get_xydata())[-1] == pytest.approx([2, 20], abs=0.01)


def test_the_speed_profile_is_the_speed(
    junction: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main_of("speed_profile")(*junction, tmp_path / "a.jpg", "west", "east")
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert {row[2] for row in rows} == {"36.0"}
    axes = plt.gcf().axes[0]
    (median,) = (line for line in axes.get_lines() if line.get_label() == "median")
    distance, speed = np.asarray(median.get_xydata()).T
    assert (distance[0], distance[-1]) == pytest.approx((-40, 39), abs=1)  # seen from x = -60, to the gate at 20
    assert speed == pytest.approx(np.full(len(speed), 36.0), abs=0.05)
    assert "one vehicle (n = 4)" in [line.get_label() for line in axes.get_lines()]


def test_the_time_space_diagram_has_each_vehicle(junction: tuple[Path, Path], tmp_path: Path) -> None:
    main_of("time_space")(*junction, tmp_path / "a.jpg", "west")
    lines = plt.gcf().axes[0].collections
    at_gate = []
    for line in lines:
        points = np.array([segment[0] for segment in line.get_segments()])  # type: ignore[attr-defined]
        assert np.diff(points[:, 1]) / np.diff(points[:, 0]) == pytest.approx(np.full(len(points) - 1, SPEED_MPS))
        assert np.median(np.asarray(line.get_array())) == pytest.approx(3.6 * SPEED_MPS, abs=0.05)
        at_gate.append(float(np.interp(0, points[:, 1], points[:, 0])))
    assert sorted(at_gate) == pytest.approx([4, 14, 24, 34, 44, 64])


def test_near_misses_are_on_the_map(
    junction: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main_of("near_misses")(*junction, tmp_path / "a.jpg")
    (row,) = capsys.readouterr().out.splitlines()
    # Vehicles of 4 m x 2 m at 10 m/s. The first is near the path of the second until 0.3 s after its middle crosses it;
    # the front of the second is at the side of the first 0.3 s before its middle.
    assert row.split()[2:] == ["crossing", "PET", "1.4", "s", "TTC", "nan", "s", "3", "and", "6"]
    drawn, _ = (one for one in plt.gcf().axes[0].collections)
    assert np.abs(np.asarray(drawn.get_offsets()) - [0, -2]).max() < 5


# ------------------------------------------------------------------------------------------------ detector and datasets


def test_labels_are_coco(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = make_dataset(tmp_path / "data", images=2, splits=("easy",))
    truth = api.open_dataset(root).read("easy")
    for label in truth.annotations:
        label.keypoints[5, 2] = 1
    (tmp_path / "images").mkdir()
    for image in truth.images:
        with Image.open(root / image.file_name) as picture:
            picture.save(tmp_path / "images" / f"{image.id}.jpg")
    found = iter(detections(truth.by_image()[image.id]) for image in truth.images)
    monkeypatch.setattr(api, "load_detector", lambda: lambda pixels: next(found), raising=False)
    main_of("label_images_coco")(tmp_path / "images", tmp_path / "out")
    written = api.coco.read(tmp_path / "out" / "labels.json")
    assert [image.file_name for image in written.images] == ["1.jpg", "2.jpg"]
    assert len(written.annotations) == len(truth.annotations)
    for label, expected in zip(written.annotations, truth.annotations, strict=True):
        assert label.image_id == expected.image_id
        assert label.bbox == pytest.approx(expected.bbox, abs=0.01)
        assert label.keypoints[:, 2].tolist() == expected.keypoints[:, 2].tolist()
        seen = expected.keypoints[:, 2] > 0
        assert label.keypoints[seen, :2] == pytest.approx(expected.keypoints[seen, :2], abs=0.01)
    with Image.open(tmp_path / "out" / "label_images_coco.jpg") as picture:
        assert picture.width == 1000


def detections(labels: list[Annotation]) -> Detections:
    """Return labels as detections: visible points with probability 0.9, hidden ones with 0.3, others outside."""
    boxes = np.array([label.bbox for label in labels])
    points = np.array([label.keypoints for label in labels])
    outside = points[..., 2] == 0
    points[outside] = [-9, -9, 0]
    points[..., 2] = np.select([points[..., 2] == 2, points[..., 2] == 1], [0.9, 0.3], 0.1)
    return Detections(
        boxes_xyxy=np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1),
        scores=np.full(len(labels), 0.9),
        keypoints=points,
        size=(160, 120),
    )


def test_the_curve_is_that_of_the_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Four vehicles. Ordered by score: right, wrong, right, right; the fourth vehicle is missed."""
    root = make_dataset(tmp_path / "data", images=2, splits=("easy",))
    annotations = root / "annotations" / "easy.json"
    labels = api.coco.read(annotations).annotations
    boxes = [labels[0].bbox, np.array([0, 0, 5, 5]), labels[1].bbox, labels[2].bbox]
    image_ids = [labels[0].image_id, 1, labels[1].image_id, labels[2].image_id]
    rows = [
        {"image_id": image_id, "category_id": 3, "bbox": box.tolist(), "score": score}
        for image_id, box, score in zip(image_ids, boxes, (0.9, 0.8, 0.7, 0.6), strict=True)
    ]
    (tmp_path / "results.json").write_text(json.dumps(rows))
    main_of("evaluate_other_results")(tmp_path / "results.json", annotations, tmp_path / "a.jpg")
    line = plt.gcf().axes[0].get_lines()[0]
    expected = [(3 / 4, 3 / 4), (2 / 4, 2 / 3), (1 / 4, 1 / 2), (1 / 4, 1)]
    assert np.asarray(line.get_xydata()) == pytest.approx(np.array(expected))
    assert "IoU 0.5: recall 0.750, recall at precision 0.9 0.250" in capsys.readouterr().out


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    """Datasets are generated with few small images, in this process."""
    real = api.generate

    def generate(out: Path, **options: Any) -> Any:
        small = {
            "frames": 3 if "recordings" in options else 2,
            "size": (320, 180),
            "workers": 1,
            "renderer": "pybullet",
        }
        return real(out, **{**options, **small})

    monkeypatch.setattr(api, "generate", generate, raising=False)


def test_exports_have_the_same_labels(tiny: None, tmp_path: Path) -> None:
    main_of("export_dataset")(tmp_path)
    (image, *_) = dataset = list(api.open_dataset(tmp_path / "dataset"))
    expected = sorted(label.bbox.tolist() for label in image.annotations)
    assert expected
    document = json.loads((tmp_path / "fiftyone" / "annotations" / "train.json").read_text())
    with tarfile.open(tmp_path / "webdataset" / "shards" / "train-000000.tar") as shard:
        names = shard.getnames()
        sample = json.load(shard.extractfile(next(n for n in names if n.endswith(".json"))))  # type: ignore[arg-type]
    with zipfile.ZipFile(tmp_path / "cvat.zip") as archive:
        corrected = json.loads(archive.read("annotations/person_keypoints_train.json"))
    assert sum(name.endswith(".jpg") for name in names) == len(dataset)
    of_first = [row for row in document["annotations"] if row["image_id"] == image.record.id]
    of_cvat = [row for row in corrected["annotations"] if row["image_id"] == image.record.id]
    for rows in (of_first, sample["annotations"], of_cvat):
        assert np.array(sorted(row["bbox"] for row in rows)) == pytest.approx(np.array(expected), abs=0.01)
    assert json.loads((tmp_path / "dataset" / "croissant.json").read_text())["@type"] == "sc:Dataset"


def test_images_have_the_own_vehicle(tiny: None, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    main_of("own_vehicle")(ROOT / "examples" / "own_vehicle" / "courier.glb", tmp_path)
    models = [label.model for image in api.open_dataset(tmp_path / "data") for label in image.annotations]
    assert "courier" in models
    assert "vehicles of model courier in 2 images" in capfd.readouterr().out
    with Image.open(tmp_path / "own_vehicle.jpg") as picture:
        assert 480 <= picture.width <= 1000


@pytest.mark.slow
def test_the_own_road_is_trained_on(
    tiny: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], random_run: Path
) -> None:
    shrink(monkeypatch)
    train, load = api.train_detector, api.load_detector

    def small_train(*folders: Path, **options: Any) -> Path:
        return train(*folders, **{**options, "init": "random", "min_size": 64, "epochs": 2, "device": "cpu"})

    monkeypatch.setattr(api, "train_detector", small_train, raising=False)
    monkeypatch.setattr(
        api,
        "load_detector",
        lambda path: load(random_run if path == "road33-lite" else path, backend="torch"),
        raising=False,
    )
    main_of("train_on_own_road")(ROOT / "examples" / "own_road" / "site.toml", tmp_path)
    curve, before, after = plt.gcf().axes
    losses = [json.loads(row)["loss"] for row in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert np.asarray(curve.get_lines()[0].get_ydata()) == pytest.approx(losses)
    assert len(losses) == 2
    assert (before.get_title()[:7], after.get_title()[:6]) == ("before:", "after:")


@pytest.mark.slow
def test_boxes_of_a_clip_are_where_the_labels_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = tmp_path / "clip"
    main_of("make_clip")(clip, "4")
    report = api.measure_traffic(clip / "report" / "tracks", clip / "traffic.toml")
    assert len(report.trajectories) > 2
    main_of("boxes_3d")(
        str(clip / "site.mp4"), str(clip / "site.json"), "2", str(tmp_path / "a.jpg"), str(clip / "site.json")
    )
    plan = plt.gcf().axes[1]
    boxes = [patch for patch in plan.patches if len(np.asarray(patch.get_path().vertices)) == 5]
    centres = np.array([np.asarray(patch.get_path().vertices)[:4].mean(axis=0) for patch in boxes])
    filled = np.array([to_rgba(patch.get_facecolor())[3] > 0 for patch in boxes])
    estimated, labelled = centres[filled], centres[~filled]
    errors = [np.linalg.norm(labelled - place, axis=1).min() for place in estimated]
    assert len(errors) > 2
    assert np.median(errors) < 0.5
