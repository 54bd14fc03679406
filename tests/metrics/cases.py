"""Random splits and what a detector found in them, for tests that compare with plain loops."""

import numpy as np

from skope import keypoints
from skope.schema import Annotation, AnnotationFile, Image, Result
from tests.metrics import brute


def random_case(rng: np.random.Generator) -> tuple[list[int], list[brute.Vehicle], list[brute.Detection]]:
    """Few scores and boxes on a coarse grid, so that ties in score and IoU are common; some images are empty."""
    images = (rng.permutation(9)[: rng.integers(1, 5)] + 1).tolist()
    ids = iter(rng.permutation(99).tolist())
    vehicles: list[brute.Vehicle] = []
    detections: list[brute.Detection] = []

    def box() -> tuple[float, ...]:
        x, y = rng.integers(0, 6, 2) * 10.0
        w, h = rng.choice([0.0, 20.0, 40.0, 50.0, 100.0], 2, p=[0.06, 0.24, 0.25, 0.25, 0.2])
        return float(x), float(y), float(w), float(h)

    for i in images:
        vehicles += [
            {"id": next(ids), "image": i, "ignored": rng.random() < 0.25, "box": box(), "points": random_points(rng)}
            for _ in range(rng.integers(0, 6))
        ]
        here = [v for v in vehicles if v["image"] == i]
        for _ in range(rng.integers(0, 8)):
            base = here[rng.integers(len(here))]["box"] if here and rng.random() < 0.8 else box()
            shift = rng.choice([0.0, 0.0, 2.0, 5.0, 10.0], 4) * [1, 1, 1, 0]
            found = tuple(float(a + b) for a, b in zip(base, shift, strict=True))
            detection = {"image": i, "score": float(rng.choice([0.5, 0.9, 0.92, 0.95, 1.0])), "box": found}
            detections.append({**detection, "points": random_scores(rng)})
            if rng.random() < 0.2:
                detections.append(dict(detections[-1]))
    order = rng.permutation(len(detections))
    return images, [vehicles[i] for i in rng.permutation(len(vehicles))], [detections[i] for i in order]


def random_points(rng: np.random.Generator) -> list[tuple[float, float, float]]:
    labels = rng.choice([0, 1, 2], keypoints.K, p=[0.2, 0.3, 0.5]) if rng.random() < 0.85 else np.zeros(keypoints.K)
    xy = rng.integers(0, 9, (keypoints.K, 2)) * (labels[:, None] > 0)
    return [(float(x), float(y), float(v)) for (x, y), v in zip(xy, labels, strict=True)]


def random_scores(rng: np.random.Generator) -> list[tuple[float, float, float]]:
    """Predicted points: on the same coarse grid, with few scores."""
    xy, p = rng.integers(0, 9, (keypoints.K, 2)), rng.choice([0.0, 0.2, 0.5, 0.8, 1.0], keypoints.K)
    return [(float(x), float(y), float(s)) for (x, y), s in zip(xy, p, strict=True)]


def as_records(
    images: list[int], vehicles: list[brute.Vehicle], detections: list[brute.Detection]
) -> tuple[AnnotationFile, list[Result]]:
    annotations = tuple(
        Annotation(
            id=v["id"],
            image_id=v["image"],
            bbox=np.array(v["box"]),
            area=v["box"][2] * v["box"][3],
            keypoints=np.array(v["points"]),
            iscrowd=int(v["ignored"]),
        )
        for v in vehicles
    )
    results = [
        Result(image_id=d["image"], score=d["score"], bbox=np.array(d["box"]), keypoints=np.array(d["points"]))
        for d in detections
    ]
    records = tuple(Image(id=i, file_name=f"{i}.png", width=400, height=300) for i in images)
    return AnnotationFile(images=records, annotations=annotations), results
