"""Small annotated images that tests train on and score, drawn here without any renderer."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.camera.model import Camera
from skope.camera.uncertain_camera import UncertainCamera
from skope.dataset import coco
from skope.files.json_files import write_json
from skope.schema import CATEGORY_NAMES, Annotation, AnnotationFile, Image, RoadUser

# A vehicle seen from its front left, in units of its box: x, y and v of each keypoint, all distinct.
_RNG = np.random.default_rng(33)
OUTLINE = np.stack([_RNG.uniform(0.08, 0.92, keypoints.K), _RNG.uniform(0.1, 0.9, keypoints.K)], axis=1)


def make_image(image_id: int = 1, width: int = 160, height: int = 120, split: str = "train") -> Image:
    return Image(
        id=image_id,
        file_name=f"images/site/00_{image_id:06d}.png",
        width=width,
        height=height,
        site="site",
        recording="00",
        frame_index=image_id,
        split=split,
        weather="clear",
        camera=Camera.looking([0, 0, 6], yaw=0, pitch_down=0.3, size=(width, height)),
    )


def make_annotation(
    annotation_id: int,
    image_id: int,
    bbox: tuple[float, float, float, float],
    *,
    iscrowd: int = 0,
    hidden: int = 0,
    vehicle_type: str = "sedan",
) -> Annotation:
    """A vehicle whose keypoints are `OUTLINE` scaled to its box; the last `hidden` of them have v = 1."""
    x, y, w, h = bbox
    v = np.full(keypoints.K, 2.0)
    if hidden:
        v[-hidden:] = 1
    points = np.concatenate([OUTLINE * [w, h] + [x, y], v[:, None]], axis=1)
    return Annotation(
        id=annotation_id,
        image_id=image_id,
        bbox=np.array(bbox),
        bbox_visible=np.array(bbox),
        keypoints=points,
        area=w * h,
        area_full=w * h,
        iscrowd=iscrowd,
        ignore_reason="small" if iscrowd else None,
        track_id=annotation_id,
        vehicle_type=vehicle_type,
        distance=20.0,
        occlusion=0.0,
        truncation=0.0,
    )


def make_road_user(
    user_id: int,
    image_id: int,
    bbox: tuple[float, float, float, float],
    category: str = "pedestrian",
    *,
    iscrowd: int = 0,
) -> RoadUser:
    """Somebody on foot or on two wheels who fills the box."""
    area = bbox[2] * bbox[3]
    return RoadUser(
        id=user_id,
        image_id=image_id,
        category_id=CATEGORY_NAMES.index(category) + 1,
        bbox=np.array(bbox),
        bbox_visible=np.array(bbox),
        area=area,
        area_full=area,
        iscrowd=iscrowd,
        ignore_reason="small" if iscrowd else None,
        track_id=user_id,
        distance=20.0,
        occlusion=0.0,
        truncation=0.0,
    )


def draw(image: Image, annotations: list[Annotation], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Grey noise with a coloured box per vehicle and a coloured dot per keypoint."""
    pixels = rng.integers(90, 130, (image.height, image.width, 3), dtype=np.uint8)
    for annotation in annotations:
        x, y, w, h = (round(float(value)) for value in annotation.bbox)
        pixels[y : y + h, x : x + w] = (40, 60, 150)
        for (px, py, v), color in zip(annotation.keypoints, keypoints.COLORS, strict=True):
            if v:
                cv2.circle(pixels, (int(px), int(py)), 1, color, -1)
    return pixels


def make_dataset(
    root: Path,
    images: int = 2,
    splits: tuple[str, ...] = ("train", "easy"),
    seed: int = 0,
    scheme: keypoints.Scheme = keypoints.SKOPE33,
    *,
    road_users: bool = False,
) -> Path:
    """Write a dataset folder of PNG images, two vehicles in each; returns `root`.

    With `road_users` each has a pedestrian too, a bicycle and an ignored motorcycle, all labelled.
    """
    categories = CATEGORY_NAMES if road_users else CATEGORY_NAMES[:1]
    rng = np.random.default_rng(seed)
    image_id = annotation_id = 0
    for split in splits:
        records, annotations, others = [], [], []
        for _ in range(images):
            image_id += 1
            record = make_image(image_id, split=split)
            boxes = [
                (8 + rng.integers(10), 12 + rng.integers(8), 64, 44),
                (84 + rng.integers(8), 56 + rng.integers(10), 60, 40),
            ]
            vehicles = [make_annotation(annotation_id + i, image_id, box) for i, box in enumerate(boxes, start=1)]
            annotation_id += len(boxes)
            if road_users:
                kinds = (("pedestrian", 0), ("bicycle", 0), ("motorcycle", 1))
                others += [
                    make_road_user(annotation_id + k, image_id, (10.0 * k, 2.0, 8.0, 20.0), kind, iscrowd=ignored)
                    for k, (kind, ignored) in enumerate(kinds, start=1)
                ]
                annotation_id += len(kinds)
            path = root / record.file_name
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), cv2.cvtColor(draw(record, vehicles, rng), cv2.COLOR_RGB2BGR))
            records.append(record)
            annotations.extend(vehicles)
        file = AnnotationFile(
            images=tuple(records),
            annotations=tuple(annotations),
            name=split,
            scheme=scheme,
            road_users=tuple(others),
            categories=categories,
        )
        coco.write(root / "annotations" / f"{split}.json", file)
    told = {"categories": list(categories)} if road_users else {}
    write_json(root / "dataset.json", {"version": 1, **scheme.fields(), **told, "seed": seed})
    return root


def within(camera: Camera, share: float) -> UncertainCamera:
    """A camera under which all distances are off by one share, of that standard deviation: its height's."""
    return UncertainCamera(camera, ("z",), np.array([[(share * camera.position[2]) ** 2]]))


def load_script(name: str) -> ModuleType:
    """The module in `scripts/NAME.py`."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parents[1] / "scripts" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module
