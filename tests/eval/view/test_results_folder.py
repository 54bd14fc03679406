"""What `skope eval view` makes of folders that `skope eval` and `skope eval predict` wrote."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skope.dataset import coco
from skope.dataset.image_selection import take
from skope.errors import UserError
from skope.eval.view.results_folder import read_results_folder
from skope.files.json_files import write_json
from skope.schema import AnnotationFile, Image, Result, RoadUserResult
from skope.terminal.console import Console
from skope.video import frame_cache
from skope.video.footage import FOUND_AT
from skope.video.write import write_video
from skope.viewer.collection import Collection
from skope.viewer.documents import Documents
from tests.eval.report.test_page import detector_of
from tests.samples import make_dataset

QUIET = Console(quiet=True)


@pytest.fixture
def evaluated(skope: Any, tmp_path: Path) -> Callable[..., Path]:
    """Evaluate results of split easy of a dataset, with these further options; returns the output folder."""
    root = make_dataset(tmp_path / "roads", images=6)
    coco.write_results(tmp_path / "found.json", detector_of(coco.read(root / "annotations/easy.json")))

    def call(*more: str) -> Path:
        data = () if "--annotations" in more else ("--data", "roads", "--split", "easy")
        words = (*data, "--predictions", "found.json", "--score", "0.5", "--out", "out", *more)
        code, _, error = skope("eval", *words, "-q")
        assert (code, error) == (0, "")
        return Path("out")

    return call


def collection(folder: Path) -> Collection:
    return read_results_folder(folder, QUIET)


def test_an_evaluation_knows_its_data_predictions_and_options(evaluated: Callable[..., Path]) -> None:
    folder = evaluated("--alpha", "0.2", "--labelled", "all")
    seen = collection(folder)
    assert seen.title == "found.json on roads (easy)"
    assert seen.options is not None
    assert (seen.options.score, seen.options.alpha, seen.options.labelled) == (0.5, 0.2, "all")
    (split,) = seen.splits
    assert len(split.file.images) == 6
    assert len(split.results) == len(detector_of(split.file))
    assert seen.picture(split.file.images[0]).data == Path("roads/images/site/00_000007.png").read_bytes()
    scores = Documents(seen).scores(500)
    failures = json.loads((folder / "metrics.json").read_text())["splits"]["easy"]["failures"]["0.6"]
    assert (sum(map(len, scores["missed"])), sum(scores["false"])) == (failures["missed"], failures["false"])


def test_only_the_images_that_were_evaluated_are_shown(evaluated: Callable[..., Path]) -> None:
    (split,) = collection(evaluated("--max-images", "2")).splits
    whole = coco.read(Path("roads/annotations/easy.json"))
    assert [image.id for image in split.file.images] == [image.id for image in take(whole, 2).images]


def test_an_annotation_file_by_itself(evaluated: Callable[..., Path]) -> None:
    Path("roads/dataset.json").unlink()
    seen = collection(evaluated("--annotations", "roads/annotations/easy.json"))
    assert seen.title == "found.json on roads (easy)"
    assert seen.picture(seen.splits[0].file.images[0]).media_type == "image/png"


def test_predictions_of_a_checkpoint_lie_in_the_folder(evaluated: Callable[..., Path]) -> None:
    folder = evaluated()
    path = folder / "metrics.json"
    metrics = json.loads(path.read_text())
    (truth, digest), _ = metrics["of"]["inputs"].items()
    write_json(
        path, {**metrics, "calibrated": False, "of": {"inputs": {truth: digest, "runs/a/last.safetensors": "0"}}}
    )
    with pytest.raises(UserError, match=r"out/predictions_easy\.json: no such file"):
        collection(folder)
    Path("found.json").rename(folder / "predictions_easy.json")
    seen = collection(folder)
    assert seen.title == "a/last.safetensors on roads (easy)"
    assert seen.splits[0].results


def spoilt(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], object]:
    def spoil(folder: Path) -> None:
        path = folder / "metrics.json"
        metrics = json.loads(path.read_text())
        change(metrics)
        path.write_text(json.dumps(metrics))

    return spoil


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda out: (out / "metrics.json").unlink(), "out: neither metrics.json"),
        (lambda out: (out / "tallies.json").unlink(), "out/tallies.json: no such file"),
        (
            lambda out: Path("found.json").unlink(),
            "found.json: no such file, but out/metrics.json refers to it; the path",
        ),
        (lambda out: Path("found.json").write_text("[]"), "found.json: has changed since out/metrics.json was written"),
        (
            lambda out: Path("roads/annotations/easy.json").write_text("{}"),
            "roads/annotations/easy.json: has changed since",
        ),
        (spoilt(lambda m: m.update(of=None)), "out/metrics.json: of.inputs: expected the files"),
        (spoilt(lambda m: m.update(of={"inputs": []})), "out/metrics.json: of.inputs: expected the files"),
        (spoilt(lambda m: m.pop("alpha")), "out/metrics.json: field alpha is missing"),
        (spoilt(lambda m: m.update(alpha="x")), "out/metrics.json: "),
        (spoilt(lambda m: m.update(score_threshold=7)), "out/metrics.json: --score: expected a number from 0 to 1"),
        (spoilt(lambda m: m.update(points=[99])), "out/metrics.json: points: expected whole numbers"),
        (spoilt(lambda m: m.update(points=3)), "out/metrics.json: "),
        (spoilt(lambda m: m.update(scheme="odd")), "out/metrics.json: scheme: 'odd'"),
        (spoilt(lambda m: m.update(version=9)), "out/metrics.json: not a file of `skope eval` of version 1"),
        (spoilt(lambda m: m.update(splits=[])), "out: metrics.json, tallies.json: splits: expected an object"),
        (spoilt(lambda m: m.update(splits={"../x": {"iou": {}}})), "roads: no split '../x'"),
        (spoilt(lambda m: m["splits"].update(easy=3)), "out/metrics.json: "),
    ],
)
def test_what_is_missing_or_wrong_is_one_line(
    skope: Any, evaluated: Callable[..., Path], spoil: Callable[[Path], object], said: str
) -> None:
    spoil(evaluated())
    code, out, error = skope("eval", "view", "out", "-q")
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert error.startswith(f"skope: {said}")


def test_tallies_without_image_ids_are_named(evaluated: Callable[..., Path]) -> None:
    folder = evaluated()
    write_json(folder / "tallies.json", {"version": 1, "splits": {"easy": []}})
    with pytest.raises(UserError, match=r"tallies\.json: splits\.easy\.image_ids: expected a list"):
        collection(folder)


def test_a_folder_that_is_none_is_refused(skope: Any) -> None:
    assert skope("eval", "view", "gone")[::2] == (2, "skope: gone: no such folder; `skope eval --out gone` makes it\n")


# ----------------------------------------------------------------------------------------------------------- footage


def predicted(folder: Path, images: tuple[Image, ...], found_at: str | None) -> Path:
    """What `skope eval predict` leaves, with nothing found."""
    info = {"source": "bridge", "fps": None} | ({FOUND_AT: found_at} if found_at else {})
    coco.write(folder / "frames.json", AnnotationFile(images=images, annotations=(), info=info))
    coco.write_results(folder / "predictions.json", [])
    write_json(folder / "work.json", {"inputs": {"runs/a/last.safetensors": "0"}})
    return folder


def frames(count: int, size: tuple[int, int] = (64, 48)) -> list[Any]:
    """Grey frames, each 20 brighter than the one before."""
    return [np.full((size[1], size[0], 3), 20 + 20 * i, dtype=np.uint8) for i in range(count)]


def brightness(seen: Collection, image: Image) -> float:
    data = np.frombuffer(seen.picture(image).data, np.uint8)
    return float(cv2.imdecode(data, cv2.IMREAD_COLOR).mean())


def records(count: int, name: str = "bridge/{:06d}") -> tuple[Image, ...]:
    return tuple(
        Image(id=i + 1, file_name=name.format(i), width=64, height=48, frame_index=i, time_s=i / 10)
        for i in range(count)
    )


def test_images_of_footage_come_from_their_folder(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for i, pixels in enumerate(frames(3)):
        cv2.imwrite(str(tmp_path / f"in/{i}.png"), pixels)
    seen = collection(predicted(tmp_path / "out", records(3, "{}.png"), "../in"))
    assert seen.title == "a/last.safetensors on bridge"
    assert not seen.truth
    documents = Documents(seen)
    assert documents.index()["facets"][0] == {"name": "split", "values": [], "of": [-1] * 3}
    assert documents.details(1)["facts"] == [["size", "64x48"], ["frame", "1"], ["time", "0.10 s"]]
    assert [brightness(seen, image) for image in seen.splits[0].file.images] == [20, 40, 60]
    with pytest.raises(UserError, match=r"in/9\.png: no such file"):
        seen.picture(replace(records(1)[0], file_name="9.png"))


def test_frames_of_a_video_are_decoded_in_any_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(frame_cache, "CACHE_SIZE", frame_cache.CacheSize(frames=3, before=1))
    monkeypatch.setattr(frame_cache, "FOOTAGE_LIMITS", replace(frame_cache.FOOTAGE_LIMITS, seek_frames=2))
    write_video(tmp_path / "bridge.mp4", frames(10), 10)
    seen = collection(predicted(tmp_path / "out", records(10), "../bridge.mp4"))
    images = seen.splits[0].file.images
    for i in (0, 1, 2, 7, 3, 9, 0, 9, 5, 4):
        assert brightness(seen, images[i]) == pytest.approx(20 + 20 * i, abs=4), i
    with pytest.raises(UserError, match=r"bridge\.mp4: frame 99 cannot be decoded"):
        seen.picture(replace(images[0], frame_index=99))
    assert brightness(seen, images[6]) == pytest.approx(140, abs=4)


@pytest.mark.parametrize(
    ("found_at", "said"),
    [
        (None, "frames.json: info.found_at: expected the path of the images, found none; predict again"),
        ("../gone", "out/../gone: no such file or folder, but "),
    ],
)
def test_footage_that_is_not_there_is_said_at_each_picture(tmp_path: Path, found_at: str | None, said: str) -> None:
    seen = collection(predicted(tmp_path / "out", records(2), found_at))
    assert len(Documents(seen)) == 2
    with pytest.raises(UserError, match=said.replace("..", r"\.\.")):
        seen.picture(seen.splits[0].file.images[0])


def test_predictions_that_are_missing_are_named(skope: Any, tmp_path: Path) -> None:
    predicted(tmp_path / "out", records(1), None)
    (tmp_path / "out/predictions.json").unlink()
    assert skope("eval", "view", "out")[::2] == (2, "skope: out/predictions.json: no such file\n")


def test_who_was_found_on_foot_in_footage_is_shown(tmp_path: Path) -> None:
    folder = predicted(tmp_path, records(2), None)
    assert not Documents(collection(folder)).index()["others"]
    box = np.array([4.0, 5, 10, 30])
    people = [
        RoadUserResult(image_id=2, score=0.9, bbox=box, category_id=4, track_id=12),
        RoadUserResult(image_id=2, score=0.7, bbox=box + [20, 0, 0, 0], category_id=2),
    ]
    vehicle = Result(image_id=2, score=0.8, bbox=box, keypoints=np.ones((33, 3)))
    coco.write_results(folder / "predictions.json", [vehicle, *people])
    documents = Documents(collection(folder))
    assert documents.index()["others"]
    details = documents.details(1)
    assert [(one["category"], one["box"]) for one in details["others"]] == [
        ("pedestrian", [4, 5, 10, 30]),
        ("bicycle", [24, 5, 10, 30]),
    ]
    assert details["others"][0]["words"] == "pedestrian 12"
    assert [one["score"] for one in details["detections"]] == [0.8]
    assert documents.details(0)["others"] == []
