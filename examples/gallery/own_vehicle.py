"""Add a vehicle model of your own, generate images with it, and draw its 33 keypoints.

    python examples/gallery/own_vehicle.py MODEL OUT

MODEL is a file with 33 markers (docs/vehicles.md); the default is examples/own_vehicle/courier.glb. OUT is a new
folder (default: `own`) for the model, the dataset and the picture `own_vehicle.jpg`.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import skope


def main(model: Path, out: Path) -> None:
    os.environ["SKOPE_VEHICLES"] = str((out / "models").absolute())  # without this: the models of the user
    subprocess.run([sys.executable, "-m", "skope", "gen", "vehicles", "add", model, "--type", "van"], check=True)
    dataset = skope.generate(
        out / "data", site="t01_mill_corner", frames=8, interval=3.0, size=(1280, 720), vehicles=model.stem, share=0.4
    )
    found = [
        (label, image)
        for image in dataset
        for label in image.annotations
        if label.model == model.stem and not label.ignored and not label.truncation
    ]
    print(f"{len(found)} vehicles of model {model.stem} in {len(list(dataset))} images")
    found.sort(key=lambda one: one[0].area)
    largest = {label.track_id: (label, image) for label, image in found}  # one view of each vehicle
    views = []
    for label, image in sorted(largest.values(), key=lambda one: -one[0].area)[:4]:
        x, y, w, h = label.bbox
        side = 1.2 * max(w, 1.5 * h)  # a part of the image with 3:2 around the vehicle, enlarged to 480x320
        left, top, scale = x + w / 2 - side / 2, y + h / 2 - side / 3, 480 / side
        box = (left, top, left + side, top + side / 1.5)
        part = Image.fromarray(image.pixels()).transform(
            (480, 320), Image.Transform.EXTENT, box, Image.Resampling.BICUBIC
        )
        points = (label.keypoints - [left, top, 0]) * [scale, scale, 1]
        enlarged = replace(label, bbox=(label.bbox - [left, top, 0, 0]) * scale, keypoints=points)
        views.append(skope.draw.numbered(np.asarray(part), [enlarged]))
    sheet = skope.draw.contact_sheet(views, columns=2)
    Image.fromarray(sheet).save(out / "own_vehicle.jpg", quality=75)


if __name__ == "__main__":
    default = Path(__file__).parents[1] / "own_vehicle" / "courier.glb"
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else default, Path(sys.argv[2] if len(sys.argv) > 2 else "own"))
