"""Import of a large COCO file, against the import of another checkout of skope in the same run; and AP by pycocotools.

    python scripts/bench_import.py                          # 10,000 images with 60,000 vehicles of 33 points
    python scripts/bench_import.py --beside OTHER_CHECKOUT  # seconds and memory of both, in turns

Images are small JPEG files. The AP of results for these annotations, by `skope eval`, is held against pycocotools' own.
"""

import argparse
import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from skope import keypoints

WIDTH, HEIGHT = 320, 180
VEHICLES = 6
"""Vehicles an image."""


def write_source(root: Path, images: int) -> None:
    """A folder as another program would write it."""
    rng = np.random.default_rng(0)
    (root / "images").mkdir(parents=True)
    (root / "annotations").mkdir()
    rows: dict[str, list[Any]] = {"images": [], "annotations": []}
    for i in range(1, images + 1):
        name = f"cam{i % 7}_{i:06d}.jpg"
        pixels = cv2.resize(rng.integers(50, 200, (4, 6, 3), dtype=np.uint8), (WIDTH, HEIGHT))
        cv2.imwrite(str(root / "images" / name), pixels)
        rows["images"].append({"id": i, "file_name": name, "width": WIDTH, "height": HEIGHT})
        for _ in range(VEHICLES):
            size = rng.uniform([20, 15], [80, 60])
            corner = rng.uniform([0, 0], [WIDTH, HEIGHT] - size)
            points = np.concatenate(
                [corner + rng.random((keypoints.K, 2)) * size, rng.integers(0, 3, (keypoints.K, 1))], axis=1
            )
            points[points[:, 2] == 0] = 0
            rows["annotations"].append(
                {
                    "id": len(rows["annotations"]) + 1, "image_id": i, "category_id": 1, "iscrowd": 0,
                    "bbox": [*corner.round(2), *size.round(2)], "area": round(float(size.prod()), 2),
                    "keypoints": points.round(2).ravel().tolist(), "num_keypoints": int((points[:, 2] > 0).sum()),
                }
            )  # fmt: skip
    category = {"id": 1, "name": "vehicle", "keypoints": list(keypoints.NAMES), "skeleton": []}
    (root / "annotations" / "easy.json").write_text(json.dumps({**rows, "categories": [category]}))


def imported(checkout: Path, source: Path, out: Path) -> tuple[float, float]:
    """Seconds and MB of an import by a checkout, in a process of its own."""
    code = f"import sys; sys.argv = ['skope', 'gen', 'convert', {str(source)!r}, {str(out)!r}, '--from', 'coco', '-q']"
    code += (
        "; from skope.cli import main; main(); import resource; "
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr)"
    )
    code = code.replace("main(); import", "\ntry: main()\nexcept SystemExit: pass\nimport")
    since = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": str(checkout)},
        capture_output=True,
        text=True,
        check=True,
        cwd=checkout,
    )
    return time.perf_counter() - since, int(done.stderr.split()[-1]) / 1024


def ap_differs(source: Path, folder: Path) -> float:
    """Largest difference of four APs between `skope eval` and pycocotools, for results beside the truth."""
    truth_path = source / "annotations" / "easy.json"
    truth = json.loads(truth_path.read_text())
    rng = np.random.default_rng(1)
    results = []
    for row in truth["annotations"]:
        points = np.array(row["keypoints"], dtype=float).reshape(-1, 3)
        points[:, :2] += rng.normal(0, 2, (len(points), 2))
        points[:, 2] = 0.9
        results.append(
            {
                "image_id": row["image_id"], "category_id": 1, "score": round(float(rng.uniform(0.91, 1)), 6),
                "bbox": (np.array(row["bbox"]) + rng.normal(0, 1, 4) * [1, 1, 0, 0]).round(2).tolist(),
                "keypoints": points.round(2).ravel().tolist(),
            }
        )  # fmt: skip
    path = folder / "results.json"
    path.write_text(json.dumps(results))
    command = ["gen", "convert", str(source), str(folder / "data"), "--from", "coco", "-q"]
    subprocess.run([sys.executable, "-m", "skope", *command], check=True, capture_output=True)
    ours = folder / "data" / "annotations" / "easy.json"
    command = ["eval", "--annotations", str(ours), "--predictions", str(path), "--out", str(folder / "scored"), "-q"]
    subprocess.run([sys.executable, "-m", "skope", *command], check=True, capture_output=True)
    found = json.loads((folder / "scored" / "metrics.json").read_text())["splits"]["easy"]["coco"]
    differences = []
    with contextlib.redirect_stdout(io.StringIO()):
        known = COCO(str(ours))
        for annotation in known.anns.values():  # by the rule that `skope eval` says it has
            annotation["num_keypoints"] = sum(v == 2 for v in annotation["keypoints"][2::3])
            annotation["keypoints"] = [
                x if annotation["keypoints"][3 * (i // 3) + 2] == 2 else 0
                for i, x in enumerate(annotation["keypoints"])
            ]
        detected = known.loadRes(str(path))
        for kind, names in (("bbox", ("box_ap", "box_ap50")), ("keypoints", ("keypoint_ap", "keypoint_ap50"))):
            scorer = COCOeval(known, detected, kind)
            scorer.params.maxDets = [300]
            scorer.params.areaRng, scorer.params.areaRngLbl = [[0, 1e10]], ["all"]
            scorer.params.kpt_oks_sigmas = np.full(keypoints.K, 0.05)
            scorer.evaluate()
            scorer.accumulate()
            precision = scorer.eval["precision"]
            for name, part in zip(names, (precision, precision[:1]), strict=True):
                differences.append(abs(float(part[part > -1].mean()) - found[name]))
    return max(differences)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=10_000)
    parser.add_argument("--beside", type=Path, help="another checkout of skope")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    here = Path(__file__).resolve().parents[1]
    checkouts = {"this": here, **({"other": options.beside.resolve()} if options.beside else {})}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        write_source(root / "source", options.images)
        taken: dict[str, list[tuple[float, float]]] = {name: [] for name in checkouts}
        for number in range(options.rounds):
            for name, checkout in checkouts.items():
                taken[name].append(imported(checkout, root / "source", root / f"{name}{number}"))
        for name, figures in taken.items():
            seconds, memory = (sorted(values) for values in zip(*figures, strict=True))
            print(
                f"{name}: {options.images} images with {options.images * VEHICLES} vehicles in {seconds[0]:.1f} s "
                f"(median {seconds[len(seconds) // 2]:.1f}), {memory[-1]:.0f} MB"
            )
        print(f"AP: differs from pycocotools' by {ap_differs(root / 'source', root):.1e}")


if __name__ == "__main__":
    main()
