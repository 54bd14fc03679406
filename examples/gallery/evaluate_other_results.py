"""Evaluate COCO results of another detector, and draw its precision-recall curve.

    python examples/gallery/evaluate_other_results.py RESULTS ANNOTATIONS OUT

RESULTS is a COCO results file of boxes, with the category numbers of COCO: cars, buses and trucks are the vehicles.
Keypoints are not read. ANNOTATIONS is a COCO annotation file. Without arguments, the program generates twelve images
and writes the boxes of `road33-lite` for them. OUT is `evaluate_other_results.jpg` by default.
"""

import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import skope


def main(results: Path, annotations: Path, out: str) -> None:
    truth, found = skope.coco.read(annotations), skope.coco.read_results(results, "coco")
    _, axes = plt.subplots(figsize=(8, 5), layout="constrained")
    for iou in (0.5, 0.75):
        curve = []
        for threshold in sorted({result.score for result in found}):
            score = skope.score(found, truth, min_score=np.nextafter(threshold, 0), iou=[iou])["iou"][f"{iou:g}"]
            curve.append([score["box_recall"]["pooled"], score["box_precision"]["pooled"]])
        recall, precision = np.array(curve).T
        axes.step(recall, precision, where="post", linewidth=2, label=f"IoU {iou:g}")
        reached = max(recall[precision >= 0.9], default=0.0)
        print(f"IoU {iou}: recall {max(recall):.3f}, recall at precision 0.9 {reached:.3f}")
    axes.axhline(0.9, color="0.5", linestyle=":", linewidth=1)
    vehicles = sum(not label.ignored for label in truth.annotations)
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1), ylim=(0, 1.02))
    axes.set_title(f"{results.name}: boxes, {vehicles} vehicles in {len(truth.images)} images")
    axes.legend(loc="lower left")
    axes.grid(alpha=0.3)
    plt.savefig(out, dpi=100, pil_kwargs={"quality": 90})


def example(folder: Path) -> tuple[Path, Path]:
    dataset = skope.generate(folder / "data", sites=["t02_elm_corner"], frames=12, size=(960, 540))
    detector, results = skope.load_detector("road33-lite"), folder / "other_detector.json"
    boxes = [row for image in dataset for row in detector(image.pixels()).to_results(image.record.id)]
    rows = [
        {"image_id": row.image_id, "bbox": row.bbox.tolist(), "score": row.score, "category_id": 3} for row in boxes
    ]
    results.write_text(json.dumps(rows))
    return results, dataset.root / "annotations" / f"{dataset.splits[0]}.json"


if __name__ == "__main__":
    given = [Path(path) for path in sys.argv[1:3]] or example(Path("other"))
    main(given[0], given[1], sys.argv[3] if len(sys.argv) > 3 else "evaluate_other_results.jpg")
