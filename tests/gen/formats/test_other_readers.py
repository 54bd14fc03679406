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


@pytest.mark.slow
@pytest.mark.usefixtures("exported")
def test_ultralytics(others: Path) -> None:
    flags = "epochs=1 imgsz=32 batch=32 workers=0 plots=False val=False device=cpu model=yolo11n-pose.yaml"
    done = subprocess.run(
        [others / "yolo", "train", "task=pose", f"data={Path('yolo/data.yaml').resolve()}", *flags.split()],
        env={**os.environ, "YOLO_CONFIG_DIR": str(Path("settings").resolve()), "PYTHONPATH": ""},
        capture_output=True,
        text=True,
    )
    said = done.stdout + done.stderr
    counts = {
        part: numbers for part, *numbers in re.findall(r"(train|val): .*? (\d+) images, (\d+) backgrounds, (\d+)", said)
    }
    files = {part: sum(path.is_file() for path in Path("yolo/images", part).rglob("*")) for part in ("train", "val")}
    assert files["train"] + files["val"] > 0.9 * len(NAMES)
    assert counts == {part: [str(files[part]), "0", "0"] for part in files}, said[-2000:]
