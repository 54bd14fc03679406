"""Write a generated dataset for FiftyOne, Hugging Face and CVAT, and draw the labels of one image from each.

    python examples/gallery/export_dataset.py OUT

OUT is a new folder (default: `export`) for:

- `dataset`: the dataset of skope, with `croissant.json`, its description for catalogues (MLCommons Croissant);
- `fiftyone`: COCO; read it as `fiftyone.types.COCODetectionDataset`;
- `webdataset`: tar files; `datasets.load_dataset("webdataset", data_files="export/webdataset/shards/*.tar")`;
- `cvat.zip`: an archive for CVAT ("COCO Keypoints 1.0");
- `export_dataset.jpg`: the picture.
"""

import json
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Rectangle

import skope


def main(out: Path) -> None:
    dataset = skope.generate(out / "dataset", site="t01_mill_corner", frames=6, size=(1280, 720))
    for form, name in (("coco", "fiftyone"), ("shards", "webdataset"), ("cvat", "cvat.zip")):
        convert = ["gen", "convert", str(dataset.root), str(out / name), "--to", form, "--quiet"]
        subprocess.run([sys.executable, "-m", "skope", *convert], check=True)
    first = next(iter(dataset))
    document = json.loads((out / "fiftyone" / "annotations" / "train.json").read_text())
    labels = {"FiftyOne (COCO)": [row for row in document["annotations"] if row["image_id"] == first.record.id]}
    with tarfile.open(out / "webdataset" / "shards" / "train-000000.tar") as shard:
        name = next(name for name in shard.getnames() if name.endswith(".json"))
        member = shard.extractfile(name)
        assert member
        labels["Hugging Face (WebDataset)"] = json.load(member)["annotations"]
    with zipfile.ZipFile(out / "cvat.zip") as archive:
        document = json.loads(archive.read("annotations/person_keypoints_train.json"))
        labels["CVAT (COCO Keypoints 1.0)"] = [row for row in document["annotations"] if row["image_id"] == 1]
    x, y, w, _ = max((label.bbox.tolist() for label in first.annotations), key=lambda box: box[2])  # is enlarged
    _, panels = plt.subplots(1, 3, figsize=(10, 2.85), layout="constrained")
    for axes, (title, rows) in zip(panels, labels.items(), strict=True):
        axes.imshow(first.pixels(), extent=(0, first.record.width, first.record.height, 0))
        for row in rows:
            points = np.array(row["keypoints"]).reshape(-1, 3)
            axes.plot(*points[points[:, 2] > 1, :2].T, "o", color="yellow", markersize=4, markeredgecolor="k")
            axes.add_patch(Rectangle(row["bbox"][:2], *row["bbox"][2:], fill=False, edgecolor="yellow"))
        axes.set(xlim=(x - 0.3 * w, x + 1.3 * w), ylim=(y + 0.8 * w, y - 0.3 * w), xticks=[], yticks=[])
        axes.set_title(f"{title}\n{len(rows)} vehicles in the image", fontsize=10)
    plt.savefig(out / "export_dataset.jpg", dpi=100, pil_kwargs={"quality": 80})


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "export"))
