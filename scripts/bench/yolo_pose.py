"""Train a YOLO-pose network from random weights for a given time, and write its detections as COCO results.

    python scripts/bench/yolo_pose.py train yolo11n-pose.yaml --data runs/bench/yolo/data.yaml --minutes 4 --seed 1 \
        --out runs/bench/yolo11n_1
    python scripts/bench/yolo_pose.py predict runs/bench/yolo11n_1 --annotations data/world/annotations/extra.json \
        --images data/world --out runs/bench/yolo11n_1/world.json

It runs in an environment of its own that has the package `ultralytics` (AGPL-3.0) and nothing of skope. `--data` is
a dataset that `skope gen convert --to yolo` has written. `skope eval --predictions` and `scripts/score_photographs.py`
score the results. A detection is a vehicle with its keypoints, or a person or two-wheeler with a box alone.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any, Final

WEIGHTS: Final = "weights/last.pt"
LEAST_SCORE: Final = 0.001
"""Detections below this score are not written; average precision needs those with low scores."""
MOST_DETECTIONS: Final = 100


def network(source: str | Path) -> Any:
    """Return a network of the package `ultralytics`, by the name of its architecture or a file of weights."""
    try:
        from ultralytics import YOLO
    except ModuleNotFoundError:
        print("yolo_pose.py: this environment lacks the package ultralytics (AGPL-3.0)", file=sys.stderr)
        sys.exit(2)
    return YOLO(source)


def train(options: argparse.Namespace) -> None:
    """Train with the package's own settings; only the input size, the batch and the time differ."""
    begun = time.monotonic()
    network(options.network).train(
        data=str(options.data.resolve()),
        time=options.minutes / 60,
        imgsz=options.size,
        batch=options.batch_size,
        seed=options.seed,
        device=options.device,
        workers=options.workers,
        cache=options.cache,
        amp=options.amp,
        project=str(options.out.parent.resolve()),
        name=options.out.name,
        exist_ok=True,
        pretrained=False,
        val=False,
        plots=False,
    )
    print(f"trained for {time.monotonic() - begun:.0f} s, start-up included")


def predict(options: argparse.Namespace) -> None:
    """Write the detections of all images of a COCO file, and print the time per image."""
    labels = json.loads(options.annotations.read_text())
    ids = {row["name"]: row["id"] for row in labels["categories"]}
    points = {row["name"]: len(row.get("keypoints", ())) for row in labels["categories"]}
    images = options.images or options.annotations.parent.parent
    model = network(options.run / WEIGHTS if options.run.is_dir() else options.run)
    rows: list[dict[str, Any]] = []
    spent_ms: list[float] = []
    for image in labels["images"]:
        path = images / image["file_name"]
        (found,) = model.predict(
            path,
            imgsz=options.size,
            conf=LEAST_SCORE,
            max_det=MOST_DETECTIONS,
            device=options.device,
            verbose=False,
        )
        spent_ms.append(sum(found.speed.values()))
        rows += results(found, image["id"], ids, points)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(rows))
    spent_ms.sort()
    print(f"{options.out}: {len(rows)} detections, median {spent_ms[len(spent_ms) // 2]:.1f} ms per image")


def results(found: Any, image_id: int, ids: dict[str, int], points: dict[str, int]) -> list[dict[str, Any]]:
    """Return the detections of an image as COCO results.

    `ids` are the category numbers of the labels by name, `points` the numbers of keypoints of each category.
    """
    rows = []
    boxes = found.boxes.xyxy.cpu().tolist()
    scores, classes = found.boxes.conf.cpu().tolist(), found.boxes.cls.cpu().tolist()
    keypoints = found.keypoints.data.cpu().tolist()
    for (x0, y0, x1, y1), score, number, places in zip(boxes, scores, classes, keypoints, strict=True):
        name = found.names[int(number)]
        if name not in ids:
            continue
        row = {"image_id": image_id, "category_id": ids[name], "bbox": [x0, y0, x1 - x0, y1 - y0], "score": score}
        if points[name]:
            row["keypoints"] = [value for place in places for value in place]
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    actions = parser.add_subparsers(required=True)
    training = actions.add_parser("train")
    training.set_defaults(action=train)
    training.add_argument("network", help="an architecture of the package, such as yolo11n-pose.yaml")
    training.add_argument("--data", type=Path, required=True, help="data.yaml of the dataset")
    training.add_argument("--minutes", type=float, required=True)
    training.add_argument("--seed", type=int, default=1)
    training.add_argument("--batch-size", type=int, default=32)
    training.add_argument("--workers", type=int, default=8)
    training.add_argument("--cache", choices=("ram", "disk"), default=None, help="keep the decoded images")
    training.add_argument("--amp", action=argparse.BooleanOptionalAction, default=True, help="use 16-bit floats")
    predicting = actions.add_parser("predict")
    predicting.set_defaults(action=predict)
    predicting.add_argument("run", type=Path, help="folder of a training, or a file of weights")
    predicting.add_argument("--annotations", type=Path, required=True, help="COCO file whose images are read")
    predicting.add_argument("--images", type=Path, help="folder of the images (default: the dataset of --annotations)")
    for action in (training, predicting):
        action.add_argument("--size", type=int, default=1152, help="longer edge of the input in pixels")
        action.add_argument("--device", default="0", help="number of a GPU, or cpu")
        action.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.action(options)


if __name__ == "__main__":
    main()
