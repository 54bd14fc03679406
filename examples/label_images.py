"""Find the vehicles in a folder of images: COCO results, and each image with what was found drawn on it.

    python examples/label_images.py FOLDER OUT

The detector that comes with skope does it, in some three seconds an image on a CPU.
"""

import sys
from pathlib import Path

import skope
from skope import coco, draw
from skope.dataset import read_image


def main(folder: Path, out: Path) -> None:
    detector = skope.load_detector()
    results = []
    for number, path in enumerate(sorted(folder.glob("*.jpg")), start=1):
        image = read_image(path)
        found = detector(image).above(0.5)
        results += found.to_results(number)
        draw.write(out / path.name, draw.results(image, found.to_results(number)))
        print(f"{path.name}: {len(found)} vehicles")
    coco.write_results(out / "predictions.json", results)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
