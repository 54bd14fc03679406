"""Train the detector on generated images of your own road, and compare it with the detector before.

    python examples/gallery/train_on_own_road.py SITE OUT

SITE is a site file with road network and camera; the default is examples/own_road/site.toml. OUT is a new folder
(default: `road`) for the dataset, the run and the picture `train_on_own_road.jpg`.
"""

import json
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import skope


def main(site: Path, out: Path) -> None:
    data = skope.generate(out / "data", site=site, frames=30, recordings=3, interval=3.0, size=(640, 360))
    fast = {"keypoint_regions": 16, "val_fraction": 0}  # a step takes a second on two cores
    checkpoint = skope.train_detector(data.root, out / "run", init="road33-lite", epochs=5, settings=fast)
    losses = [json.loads(line)["loss"] for line in (out / "run" / "metrics.jsonl").read_text().splitlines()]
    _, (curve, before, after) = plt.subplots(1, 3, figsize=(10, 3), width_ratios=(1, 1.6, 1.6), layout="constrained")
    curve.plot(range(1, len(losses) + 1), losses, marker="o")
    curve.set(xlabel="epoch", ylabel="training loss", xticks=range(1, len(losses) + 1))
    test = list(data.images("test"))
    for axes, name, weights in ((before, "before", "road33-lite"), (after, "after", checkpoint)):
        detector = skope.load_detector(weights)
        found = [detector(image.pixels()) for image in test]
        results = [row for image, one in zip(test, found, strict=True) for row in one.to_results(image.record.id)]
        score = skope.score(results, data.read("test"), min_score=0.5, iou=[0.5])["iou"]["0.5"]
        text = f"{name}: PCK {score['pck'] or 0:.3f}, precision {score['box_precision']['pooled'] or 0:.2f}"
        most = np.argmax([len(image.annotations) for image in test])
        axes.imshow(found[most].above(0.5).draw(test[most].pixels(), scale=2))
        axes.set(xticks=[], yticks=[], title=text)
        print(f"{text}, {score['matched']} vehicles found")
    plt.savefig(out / "train_on_own_road.jpg", dpi=100, pil_kwargs={"quality": 85})


if __name__ == "__main__":
    default = Path(__file__).parents[1] / "own_road" / "site.toml"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else default, Path(sys.argv[2] if len(sys.argv) > 2 else "road"))
