"""Label a folder of images, and write COCO labels to correct by hand.

    python examples/gallery/label_images_coco.py IMAGES OUT

IMAGES is a folder of .jpg files. Without it, the program generates four images. OUT is a new folder (default:
`labels`) for `labels.json` and a picture of the labels, `label_images_coco.jpg`.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import skope
from skope.schema import Annotation, AnnotationFile
from skope.schema import Image as ImageRecord


def main(images: Path, out: Path) -> None:
    detector = skope.load_detector()
    records, pictures, labels = [], [], list[Annotation]()
    for number, path in enumerate(sorted(images.glob("*.jpg")), start=1):
        pixels = skope.read_image(path)
        found = detector(pixels).above(0.5)
        records.append(ImageRecord(id=number, file_name=path.name, width=pixels.shape[1], height=pixels.shape[0]))
        for result in found.to_results(number):
            x, y, probability = result.keypoints.T
            inside = (x >= 0) & (x < pixels.shape[1]) & (y >= 0) & (y < pixels.shape[0])
            v = np.where(probability >= 0.5, 2, 1) * inside  # COCO: 2 visible, 1 hidden, 0 not labelled
            points = np.column_stack([x, y, v]) * inside[:, None]
            area = float(result.bbox[2] * result.bbox[3])
            labels.append(
                Annotation(id=len(labels) + 1, image_id=number, bbox=result.bbox, area=area, keypoints=points)
            )
        pictures.append(skope.draw.annotations(pixels, [label for label in labels if label.image_id == number]))
    skope.coco.write(out / "labels.json", AnnotationFile(images=tuple(records), annotations=tuple(labels)))
    sheet = Image.fromarray(skope.draw.contact_sheet(pictures[:4], columns=2))
    sheet.resize((1000, round(1000 * sheet.height / sheet.width))).save(out / "label_images_coco.jpg", quality=75)
    print(f"{len(labels)} vehicles in {len(records)} images: {out / 'labels.json'}")


if __name__ == "__main__":
    target = Path(sys.argv[2] if len(sys.argv) > 2 else "labels")
    if len(sys.argv) < 2:
        made = target / "generated"
        skope.generate(made, site="t01_mill_corner", frames=4, interval=5.0, size=(1280, 720), weather="rain")
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else made / "images" / "t01_mill_corner", target)
