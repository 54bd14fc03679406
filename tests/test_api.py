"""`import skope`: light, and each function says what the command line says."""

import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import skope as door
from skope.dataset import coco
from skope.detections import Detections
from skope.detector.checkpoint import load_weights
from skope.detector.detect import detect
from skope.errors import UserError
from skope.pose.pose_records import records
from skope.schema import Result, RoadUserResult
from tests import hostile, road_users
from tests.samples import make_dataset
from tests.sightings import CAMERA, drive


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two splits of three images; the first keypoint of each vehicle is hidden."""
    root = make_dataset(tmp_path_factory.mktemp("api") / "d", images=3)
    for path in (root / "annotations").iterdir():
        file = coco.read(path)
        hidden = np.array([[1, 1, 0.5], *[[1, 1, 1]] * 32])
        changed = tuple(replace(a, keypoints=a.keypoints * hidden) for a in file.annotations)
        coco.write(path, replace(file, annotations=changed))
    return root


def test_importing_loads_nothing_else() -> None:
    code = "import sys; before = set(sys.modules); import skope; print(*(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    others = {name.partition(".")[0] for name in done.stdout.split()} - sys.stdlib_module_names
    assert others == {"skope"}
    assert len(done.stdout.split()) < 30


def test_every_name_is_there_and_no_other() -> None:
    for name in door.__all__:
        assert getattr(door, name) is not None
        assert name in dir(door)
    with pytest.raises(AttributeError, match="has no attribute 'lacate'"):
        _ = door.lacate


def test_a_dataset_is_gone_through(dataset: Path) -> None:
    opened = door.open_dataset(str(dataset))
    seen = list(opened)
    assert [one.split for one in seen] == ["easy"] * 3 + ["train"] * 3
    for one in seen:
        assert one.pixels().shape == (one.record.height, one.record.width, 3)
        assert len(one.annotations) == 2
        assert {a.image_id for a in one.annotations} == {one.record.id}
        assert one.camera is one.record.camera
        assert one.depth() is None
    assert len(list(opened.images("train"))) == 3
    with pytest.raises(UserError, match="no split 'hard'"):
        opened.images("hard")
    with pytest.raises(UserError, match="no such dataset folder"):
        door.open_dataset(dataset / "nothing")


def test_torch_gets_what_torchvision_takes(dataset: Path) -> None:
    from torchvision.models.detection import keypointrcnn_resnet50_fpn

    images = door.torch_dataset(dataset, "train")
    assert len(images) == 3
    pixels, target = images[0]
    first = next(door.open_dataset(dataset).images("train"))
    np.testing.assert_allclose(pixels.permute(1, 2, 0).numpy() * 255, first.pixels(), atol=1e-3)
    np.testing.assert_allclose(target["boxes"][0], [*first.annotations[0].bbox[:2], *sum_of(first.annotations[0].bbox)])
    model = keypointrcnn_resnet50_fpn(weights=None, weights_backbone=None, num_keypoints=33, min_size=64)
    losses = model.train()([pixels], [target])
    assert all(math.isfinite(loss.item()) for loss in losses.values())
    hidden = door.torch_dataset(dataset, "train", supervise="all")[0][1]["keypoints"]
    assert (hidden[..., 2] > 0).sum() == (target["keypoints"][..., 2] > 0).sum() + 2
    with pytest.raises(UserError, match="supervise"):
        door.torch_dataset(dataset, "train", supervise="none")


def sum_of(bbox: np.ndarray) -> np.ndarray:
    return bbox[:2] + bbox[2:]


def test_a_detector_answers_as_its_model(random_run: Path, dataset: Path) -> None:
    detector = door.load_detector(random_run, device="cpu", backend="torch", precision="float32")
    image = next(iter(door.open_dataset(dataset)))
    found = detector(image.pixels())
    model, _, _ = load_weights(detector.checkpoint, "cpu")
    (expected,) = detect(model, [image.pixels()], "cpu")
    assert len(found) == len(expected) > 0
    np.testing.assert_array_equal(found.boxes_xyxy, expected.boxes_xyxy)
    np.testing.assert_array_equal(found.keypoints, expected.keypoints)
    assert found.size == (image.record.width, image.record.height)
    again = detector(dataset / image.record.file_name)
    np.testing.assert_array_equal(again.scores, found.scores)
    best = float(np.sort(found.scores)[-2])
    assert found.above(best).scores.tolist() == [s for s in found.scores.tolist() if s > best]
    both = detector.detect_batch([image.pixels(), image.pixels()[:100]])
    assert [one.size[1] for one in both] == [image.record.height, 100]
    with pytest.raises(ValueError, match="uint8"):
        detector(image.pixels().astype(np.float32))
    with pytest.raises(UserError, match="no such checkpoint"):
        door.load_detector("nowhere")


@pytest.mark.filterwarnings("error")
def test_a_detector_takes_images_in_any_order_of_memory(random_run: Path, dataset: Path) -> None:
    detector = door.load_detector(random_run, device="cpu", backend="torch", precision="float32")
    rgb = next(iter(door.open_dataset(dataset))).pixels()
    locked = rgb.copy()
    locked.flags.writeable = False
    for view in (rgb[..., ::-1], np.flipud(rgb), rgb[:, ::-1], rgb[::2, ::3], np.asfortranarray(rgb), locked):
        found, expected = detector(view), detector(view.copy(order="C"))
        np.testing.assert_array_equal(found.scores, expected.scores)
        np.testing.assert_array_equal(found.keypoints, expected.keypoints)
        (own,) = detect(load_weights(detector.checkpoint, "cpu")[0], [view], "cpu")
        np.testing.assert_array_equal(own.scores, expected.scores)


def test_a_detector_rejects_other_arrays_in_one_line(random_run: Path, dataset: Path) -> None:
    detector = door.load_detector(random_run, device="cpu", backend="torch", precision="float32")
    rgb = next(iter(door.open_dataset(dataset))).pixels()
    wrong: list[Any] = [rgb[:0], rgb[:, :0], rgb[..., 0], np.dstack([rgb, rgb[..., :1]]), rgb / 255.0, None]
    for image in wrong:
        with pytest.raises(UserError, match=r"^image: expected \(H, W, 3\) RGB pixels of type uint8.*, got ") as error:
            detector(image)
        assert "\n" not in str(error.value)
        with pytest.raises(UserError, match=r"^images\[1\]: expected \(H, W, 3\) RGB pixels of type uint8.*, got "):
            detector.detect_batch([rgb, image])


def frames(count: int = 20) -> list[tuple[Detections, float]]:
    """What a perfect detector finds of two sedans, at 10 frames a second."""
    file = drive(count / 10, 10.0)
    own, out = file.by_image(), []
    for image in file.images:
        bbox = np.array([a.bbox for a in own[image.id]]).reshape(-1, 4)
        points = np.array([a.keypoints for a in own[image.id]]).reshape(-1, 33, 3)
        points[..., 2] = points[..., 2] == 2
        corners = np.concatenate([bbox[:, :2], bbox[:, :2] + bbox[:, 2:]], axis=1)
        out.append((Detections(corners, np.ones(len(bbox)), points, (image.width, image.height)), image.time_s or 0.0))
    return out


def test_vehicles_are_located_and_followed() -> None:
    file = drive(2.0, 10.0)
    seen = frames()
    located = [door.estimate_poses(detections, CAMERA) for detections, _ in seen]
    middle = located[10]
    truth = [a.box_3d.center[:2] for a in file.by_image()[11] if a.box_3d]
    assert middle.good.all()
    assert np.linalg.norm(middle.poses.position[:, :2] - truth, axis=1).max() < 0.3
    assert [row["refused"] for row in records(middle)] == [None] * len(truth)
    tracks = door.track(located, [time for _, time in seen])
    assert sorted(round(float(np.median(track.speed))) for track in tracks) == [0, 12]
    with pytest.raises(ValueError, match="increasing"):
        door.track(located, [0.0] * len(located))


def test_without_a_known_ground_size_tells_the_distance() -> None:
    detections, _ = frames()[10]
    known, unknown = (door.estimate_poses(detections, CAMERA, ground=ground) for ground in (0.0, None))
    assert np.abs(unknown.poses.position - known.poses.position).max() < 2.5
    assert np.trace(unknown.poses.covariance[0]) > np.trace(known.poses.covariance[0])


def test_a_camera_of_another_shape_is_refused() -> None:
    detections, _ = frames(2)[1]
    with pytest.raises(UserError, match=r"expected the aspect ratio of the camera, 1920x1080, got 400x400"):
        door.estimate_poses(replace(detections, size=(400, 400)), CAMERA)


def test_scores_are_those_of_the_command(skope: Any, dataset: Path, tmp_path: Path) -> None:
    labels = dataset / "annotations" / "easy.json"
    file = coco.read(labels)
    results = [
        {"image_id": a.image_id, "category_id": 1, "bbox": a.bbox.tolist(), "score": 0.95,
         "keypoints": (a.keypoints + [3, 0, 0]).ravel().tolist()}
        for a in file.annotations
    ]  # fmt: skip
    path = tmp_path / "predictions.json"
    path.write_text(json.dumps(results))
    assert skope("eval", "--annotations", labels, "--predictions", path, "--out", "scored")[0] == 0
    (entry,) = json.loads((tmp_path / "scored" / "metrics.json").read_text())["splits"].values()
    scores = door.score(path, labels)
    assert scores["iou"] == entry["iou"]
    assert door.score(coco.read_results(path), file)["iou"] == scores["iou"]
    assert door.score(path, labels, alpha=0.001)["iou"]["0.6"]["pck"] < scores["iou"]["0.6"]["pck"]


def test_generating_is_the_command(skope: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("skope.gen.pipeline.workers.make_renderer", hostile.FlatRenderer)
    asked = {"sites": ["t01_mill_corner"], "frames": 2, "size": "64x48", "workers": 1, "renderer": "pybullet"}
    made = door.generate(tmp_path / "a", **asked, seed=3)
    words = ["--sites", "t01_mill_corner", "--frames", 2, "--size", "64x48", "--workers", 1, "--seed", 3]
    assert skope("gen", *words, "--renderer", "pybullet", "--out", "b")[0] == 0
    for split in made.splits:
        name = f"annotations/{split}.json"
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    with pytest.raises(UserError, match="--frames"):
        door.generate(tmp_path / "c", **{**asked, "frames": 0})
    assert not (tmp_path / "c").exists()


def test_other_road_users_are_found_and_scored_beside_vehicles(
    random_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = road_users.make_dataset(tmp_path / "data", images=1, splits=("train",))
    (image,) = door.open_dataset(root).images("train")
    assert len(door.load_detector(random_run, device="cpu")(image.pixels()).road_users) == 0
    _, target = door.torch_dataset(root, "train")[0]
    assert target["labels"].tolist() == [1, 1, 4, 2]
    file = door.open_dataset(root).read("train")
    perfect = [
        *(Result(image_id=1, score=0.95, bbox=a.bbox, keypoints=a.keypoints) for a in file.annotations),
        *(RoadUserResult(image_id=1, score=0.95, bbox=u.bbox, category_id=u.category_id) for u in file.road_users[:1]),
    ]
    entry = door.score(perfect, file)
    assert entry["iou"]["0.6"]["pck"] == 1.0
    assert {name: by["all"]["recall"] for name, by in entry["categories"].items()} == {
        "bicycle": 0.0, "motorcycle": None, "pedestrian": 1.0
    }  # fmt: skip
    assert "categories" not in door.score(perfect[:2], file)
    coco.write_results(tmp_path / "found.json", perfect)
    assert door.score(tmp_path / "found.json", root / "annotations" / "train.json") == entry


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"weathers": "rain"}, "weathers: unknown option of `skope gen`; expected one of camera_jitter, "),
        ({"weather": ["rain", "hail"]}, "weather: 'hail' is not one of clear, cloudy"),
        (
            {"sites": "t01_mill_corner"},
            r"sites: expected a list of names such as \['t01_mill_corner'\], got one string",
        ),
        (
            {"conditions": {"rain": "much"}},
            "conditions: rain: expected a number or the two ends of a range, got 'much'",
        ),
        ({"conditions": {"hail": 1.0}}, "hail"),
        ({"seed": -1}, "seed: expected a number from 0, got -1"),
        ({"size": (0, 48)}, "--size"),
    ],
)
def test_what_cannot_be_generated_is_said_before_anything_is_written(
    tmp_path: Path, options: dict[str, Any], told: str
) -> None:
    with pytest.raises(UserError, match=told):
        door.generate(tmp_path / "made", **options)
    assert not (tmp_path / "made").exists()


def test_a_camera_is_calibrated_saved_and_read(tmp_path: Path) -> None:
    places = np.array([[12, 4, 0], [14, -5, 0], [20, 6, 0], [25, -8, 0], [32, 3, 0], [28, 9, 1]], dtype=float)
    true = door.Camera.looking([0, 0, 6.5], yaw=0.0, pitch_down=0.3, size=(1920, 1080))
    found = door.calibrate_camera((true.project(places)[0], places), size=(1920, 1080))
    np.testing.assert_allclose(found.camera.position, true.position, atol=0.1)
    door.save_camera(tmp_path / "camera.json", found)
    np.testing.assert_allclose(door.read_camera(tmp_path / "camera.json").K, found.camera.K)
    assert json.loads((tmp_path / "camera.json").read_text())["covariance"]["of"] == list(found.parameters)
    door.save_camera(tmp_path / "bare.json", true)
    np.testing.assert_array_equal(door.read_camera(tmp_path / "bare.json").T_camera_world, true.T_camera_world)
    with pytest.raises(UserError, match="size: expected width and height"):
        door.calibrate_camera((places[:, :2], places))
    with pytest.raises(UserError, match=r"marks: expected \(N, 2\) pixels and \(N, 3\) places"):
        door.calibrate_camera((places, places), size=(1920, 1080))


def test_training_is_refused_in_one_line(dataset: Path, tmp_path: Path) -> None:
    for options, told in (
        ({"epochs": 0}, "epochs: expected a number from 1"),
        ({"supervise": "none"}, "supervise: 'none' is not one of visible, all"),
        ({"settings": {"augment.blurr": 1}}, "blurr"),
        ({"init": "nowhere"}, "nowhere"),
        ({"categories": ["tram"]}, "tram"),
    ):
        with pytest.raises(UserError, match=told):
            door.train_detector(dataset, tmp_path / "run", device="cpu", **options)
    with pytest.raises(UserError, match="data: expected one or more dataset folders"):
        door.train_detector([], tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_site_is_read(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text('[[gates]]\nname = "north"\nline = [[0, 0], [5, 0]]\n')
    assert [gate.name for gate in door.read_site(tmp_path / "site.toml").gates] == ["north"]
    with pytest.raises(UserError, match=r"none\.toml"):
        door.read_site(tmp_path / "none.toml")
