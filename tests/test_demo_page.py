"""The page of `make demo`: pictures inside, links to files that are there, and an honest verdict."""

import base64
import importlib
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skope.dataset import coco
from skope.pictures import draw
from skope.schema import Result
from skope.video.write import write_video
from tests.samples import make_dataset

SCRIPTS = Path(__file__).parents[1] / "scripts"


@pytest.fixture
def demo_page(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return importlib.import_module("demo_page")


def metrics(pck: float, precision: float, recall: float, count: int) -> dict[str, Any]:
    """What `skope eval` writes, as far as the page reads it; `count` of everything."""
    row = {"pck": pck, "labelled": count, "box_precision": {"pooled": precision}, "box_recall": {"pooled": recall}}
    return {"splits": {"extra": {"detections": count, "ground_truth": count, "images": 6, "iou": {"0.6": row}}}}


def test_small_changes_are_nothing_and_large_ones_are_named(demo_page: Any) -> None:
    before = metrics(0.95, 0.9, 0.7, 80)
    assert "changed nothing" in demo_page.verdict(before, metrics(0.96, 0.88, 0.74, 80))
    said = demo_page.verdict(before, metrics(0.95, 0.5, 0.95, 80))
    assert "box precision fell from 90.0 % to 50.0 %" in said
    assert "box recall rose from 70.0 % to 95.0 %" in said
    assert "PCK" not in said
    # The same change of many more things is one.
    assert "box recall rose" in demo_page.verdict(metrics(0.95, 0.9, 0.7, 8000), metrics(0.95, 0.9, 0.74, 8000))
    assert "changed nothing" in demo_page.verdict(metrics(0.9, 0.9, 0.0, 0), metrics(0.9, 0.9, 0.0, 0))


def test_the_page_holds_its_pictures_and_links_to_what_there_is(
    demo_page: Any, skope: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data, run = make_dataset(tmp_path / "data", images=3), tmp_path / "run"
    (data / "README.md").write_text("card")
    shutil.copy(data / "annotations" / "easy.json", data / "annotations" / "extra.json")
    labels = coco.read(data / "annotations" / "extra.json").annotations
    found = [Result(image_id=a.image_id, score=0.95, bbox=a.bbox, keypoints=a.keypoints) for a in labels]
    coco.write_results(tmp_path / "found.json", found)
    for name in ("road33", "tuned_score"):
        words = ("--data", data, "--split", "extra", "--predictions", tmp_path / "found.json", "--out", run / name)
        assert skope("eval", *words, "--quiet")[0] == 0
    for name in ("seen", "tracks"):
        (run / name).mkdir()
    write_video(run / "seen" / "overlay.mp4", [np.full((64, 96, 3), 20 * i, dtype=np.uint8) for i in range(5)], 5)
    draw.write(run / "tracks" / "birdseye.png", np.zeros((80, 120, 3), dtype=np.uint8))
    (run / "tracks" / "tracks.csv").write_text(
        "track,category,speed\n1,vehicle,10\n1,vehicle,5\n2,vehicle,0\n3,bicycle,12\n"
    )
    for name in ("fcd.xml", "mot.txt"):
        (run / "tracks" / name).touch()

    monkeypatch.setattr("sys.argv", ["demo_page.py", str(run), "--data", str(data)])
    demo_page.main()
    assert "Fine-tuning changed nothing" in capsys.readouterr().out
    page = (run / "index.html").read_text(encoding="utf-8")
    pictures = re.findall(r'<img[^>]* src="([^"]+)"', page)
    assert len(pictures) == 2 + len(list((data / "annotations").iterdir()))
    for picture in pictures:
        kind, data_url = picture.split(",", 1)
        assert kind == "data:image/jpeg;base64"
        assert cv2.imdecode(np.frombuffer(base64.b64decode(data_url), dtype=np.uint8), cv2.IMREAD_COLOR) is not None
    links = re.findall(r'<a [^>]*href="([^"]+)"', page)
    assert len(links) == 7
    assert all((run / link).is_file() for link in links)
    assert "2 vehicles were tracked; the fastest drove 36 km/h." in page
    assert "http" not in re.sub(r"data:image[^\"]+", "", page).replace("http-equiv", "").replace(
        "http://www.w3.org", ""
    )
