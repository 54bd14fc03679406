"""Readers of others find every picture and label of an export, whatever its folders and files are called.

Those with other requirements or licences run as commands of an environment of their own, which is made here.
"""

import json
import os
import re
import subprocess
import sysconfig
import venv
from pathlib import Path
from typing import Any

import pytest
from pycocotools.coco import COCO
from torchvision.datasets import CocoDetection

from tests.gen.formats.foreign_files import write
from tests.samples import make_dataset

FOLDERS = (
    "cam1/images/a_{}", "images/images/b_{}", ".hidden/c_{}", "labels/d_{}", "e f/%20#{}", "[x]/*g?_{}", "Straße/ü'{}",
    "-n/--h {}", "train/val/k{}", "annotations/l{}.txt", "n/$HOME;{}", "~/o&{}",
)  # fmt: skip
NAMES = [f"{name.format(i)}.jpg" for name in FOLDERS for i in range(1, 13)]

_DATUMARO = """
import json, sys
import datumaro
found = datumaro.Dataset.import_from(sys.argv[1], "coco_person_keypoints")
labelled = [any(a.type.name == "points" for a in item.annotations) for item in found]
shown = [item.media is not None and item.media.data is not None for item in found]
print(json.dumps([len(labelled), sum(labelled), sum(shown)]))
"""


_KINDS = """
import collections, json, sys
import datumaro
found = datumaro.Dataset.import_from(sys.argv[1], "coco_person_keypoints")
names = [label.name for label in found.categories()[datumaro.AnnotationType.label]]
marks = [a for item in found for a in item.annotations]
count = lambda kind: dict(collections.Counter(names[a.label] for a in marks if a.type.name == kind))
points = [a for a in marks if a.type.name == "points" and sum(v.value for v in a.visibility)]
print(json.dumps([count("bbox"), dict(collections.Counter(names[a.label] for a in points))]))
"""


@pytest.fixture
def exported(skope: Any) -> None:
    """Folders `coco`, `cvat` and `yolo` of the same images, one vehicle in each."""
    write(Path("in"), NAMES)
    assert skope("gen", "convert", "in", "data", "--from", "coco", "-q")[0] == 0
    for form in ("coco", "cvat", "yolo"):
        assert skope("gen", "convert", "data", form, "--to", form, "-q")[0] == 0


@pytest.mark.usefixtures("exported")
def test_torchvision_and_pycocotools(capsys: pytest.CaptureFixture[str]) -> None:
    read = CocoDetection("coco", "coco/annotations/train.json")
    assert len(read) == len(NAMES)
    for pixels, vehicles in (read[i] for i in range(len(read))):
        assert pixels.size == (160, 90)
        assert len(vehicles) == 1
    known = COCO("cvat/annotations/person_keypoints_train.json")
    assert len(known.getAnnIds()) == len(known.getImgIds()) == len(NAMES)
    assert all((Path("cvat/images/train") / row["file_name"]).is_file() for row in known.loadImgs(known.getImgIds()))
    capsys.readouterr()


@pytest.fixture(scope="module")
def others(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of commands of an environment with Ultralytics and Datumaro; what skope's own has is not copied."""
    home = tmp_path_factory.mktemp("others")
    venv.create(home, with_pip=True)
    own = Path(sysconfig.get_path("purelib", vars={"base": str(home), "platbase": str(home)}))
    (own / "shared.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    done = subprocess.run(
        [home / "bin" / "pip", "install", "--quiet", "ultralytics", "datumaro"], capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip(f"Ultralytics and Datumaro cannot be installed here: {done.stderr.strip().splitlines()[-1][:200]}")
    return home / "bin"


@pytest.mark.slow
@pytest.mark.usefixtures("exported")
def test_datumaro(others: Path) -> None:
    """It looks for pictures in images/<subset>/ alone, as CVAT has them; of COCO files it finds the labels."""
    for path, pictures in (("coco/annotations/train.json", 0), ("cvat", len(NAMES))):
        done = subprocess.run([others / "python", "-c", _DATUMARO, path], capture_output=True, text=True, check=True)
        assert json.loads(done.stdout.splitlines()[-1]) == [len(NAMES), len(NAMES), pictures], path


def trained_on_yolo(others: Path, flags: str) -> tuple[subprocess.CompletedProcess[str], str]:
    """Let Ultralytics train on the folder `yolo`; what it ended with, and what it said."""
    done = subprocess.run(
        [others / "yolo", "train", "task=pose", f"data={Path('yolo/data.yaml').resolve()}", *flags.split()],
        env={**os.environ, "YOLO_CONFIG_DIR": str(Path("settings").resolve()), "PYTHONPATH": ""},
        capture_output=True,
        text=True,
    )
    said = done.stdout + done.stderr
    return done, said


@pytest.mark.slow
@pytest.mark.usefixtures("exported")
def test_ultralytics(others: Path) -> None:
    flags = "epochs=1 imgsz=32 batch=32 workers=0 plots=False val=False device=cpu model=yolo11n-pose.yaml"
    _, said = trained_on_yolo(others, flags)
    counts = {
        part: numbers for part, *numbers in re.findall(r"(train|val): .*? (\d+) images, (\d+) backgrounds, (\d+)", said)
    }
    files = {part: sum(path.is_file() for path in Path("yolo/images", part).rglob("*")) for part in ("train", "val")}
    assert files["train"] + files["val"] > 0.9 * len(NAMES)
    assert counts == {part: [str(files[part]), "0", "0"] for part in files}, said[-2000:]


@pytest.mark.slow
def test_datumaro_finds_people_as_boxes(others: Path, skope: Any) -> None:
    """As the library of CVAT's formats reads them: vehicles with points, the others as boxes without any."""
    make_dataset(Path("data"), images=3, splits=("train",), road_users=True)
    assert skope("gen", "convert", "data", "cvat", "--to", "cvat", "-q")[0] == 0
    done = subprocess.run([others / "python", "-c", _KINDS, "cvat"], capture_output=True, text=True, check=True)
    boxes, points = json.loads(done.stdout.splitlines()[-1])
    assert {name: number for name, number in boxes.items() if name != "vehicle"} == dict.fromkeys(
        ("bicycle", "motorcycle", "pedestrian"), 3
    )
    assert points == {"vehicle": 6}


@pytest.mark.slow
def test_ultralytics_learns_from_people_without_points(others: Path, skope: Any) -> None:
    make_dataset(Path("data"), images=14, splits=("train",), road_users=True)
    assert skope("gen", "convert", "data", "yolo", "--to", "yolo", "-q")[0] == 0
    flags = "epochs=1 imgsz=64 batch=4 workers=0 plots=False device=cpu model=yolo11n-pose.yaml"
    done, said = trained_on_yolo(others, flags)
    assert done.returncode == 0, said[-2000:]
    assert re.search(r"train: .*? 12 images, 0 backgrounds, 0 corrupt", said), said[-2000:]
    # 1 image to validate on: two vehicles, a bicycle and a pedestrian; the ignored motorcycle is background.
    assert re.search(r"all +1 +4 ", said), said[-2000:]
