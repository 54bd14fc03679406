"""An evaluator in plain Python loops, written from the definitions; it shares no code with skope.eval."""

import math
from typing import Any

Vehicle = dict[str, Any]
"""id, image, ignored, box (x, y, w, h), points [(x, y, v)]."""
Detection = dict[str, Any]
"""image, score, box (x, y, w, h), points [(x, y, p)]."""


def overlap(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    width = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    height = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    return width * height if width > 0 and height > 0 else 0.0


def iou(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    shared = overlap(a, b)
    union = a[2] * a[3] + b[2] * b[3] - shared
    return shared / union if union > 0 else 0.0


def assign(truth: list[Vehicle], detections: list[Detection], t: float) -> list[Vehicle | None]:
    """Which vehicle each of one image's detections (in order of choice) takes."""
    free = list(truth)
    out: list[Vehicle | None] = []
    for detection in detections:
        best = None
        for vehicle in sorted(free, key=lambda v: v["id"]):
            if best is None or iou(detection["box"], vehicle["box"]) > iou(detection["box"], best["box"]):
                best = vehicle
        if best is not None and iou(detection["box"], best["box"]) >= t:
            free = [vehicle for vehicle in free if vehicle is not best]
            out.append(best)
        else:
            out.append(None)
    return out


def is_labelled(v: float, labelled: str) -> bool:
    return v == 2 or (v == 1 and labelled == "all")


def is_predicted(score: float, least: float) -> bool:
    return least == 0 or score > least


def count_labelled(vehicle: Vehicle, labelled: str, points: list[int]) -> int:
    return sum(1 for k in points if is_labelled(vehicle["points"][k][2], labelled))


def count_predicted(detection: Detection, least: float, points: list[int]) -> int:
    return sum(1 for k in points if is_predicted(detection["points"][k][2], least))


def reach(vehicle: Vehicle, alpha: float) -> float:
    return alpha * max(vehicle["box"][2], vehicle["box"][3])


def apart(a: tuple[float, ...], b: tuple[float, ...]) -> float:
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2)


def correct_points(
    vehicle: Vehicle, detection: Detection, labelled: str, alpha: float, least: float, points: list[int]
) -> list[int]:
    out = []
    for k in points:
        truth, found = vehicle["points"][k], detection["points"][k]
        near = apart(truth, found) <= reach(vehicle, alpha)
        if is_labelled(truth[2], labelled) and is_predicted(found[2], least) and near:
            out.append(k)
    return out


def on_ignored(detection: Detection, ignored: list[Vehicle]) -> bool:
    own = detection["box"][2] * detection["box"][3]
    return any(own > 0 and overlap(detection["box"], v["box"]) / own >= 0.5 for v in ignored)


def divide(a: float, b: float) -> float | None:
    return a / b if b else None


def evaluate(
    images: list[int],
    vehicles: list[Vehicle],
    detections: list[Detection],
    t: float,
    labelled: str,
    score: float,
    alpha: float,
    least: float = 0.0,
    points: list[int] | None = None,
) -> dict[str, Any]:
    """One entry of `iou` in metrics.json, and the split's own counts."""
    points = list(range(33)) if points is None else points
    names = ("truth", "ignored", "detections", "matched", "labelled", "labelled_all", "correct", "on_ignored")
    sums = dict.fromkeys((*names, "predicted"), 0)
    own: dict[str, list[float]] = {"bp": [], "br": [], "kp": [], "kr": []}
    for image in images:
        truth = [v for v in vehicles if v["image"] == image and not v["ignored"]]
        ignored = [v for v in vehicles if v["image"] == image and v["ignored"]]
        here = [d for d in detections if d["image"] == image and d["score"] > score]
        here.sort(key=lambda d: -d["score"])
        taken = assign(truth, here, t)
        matched = sum(1 for vehicle in taken if vehicle is not None)
        correct = own_predicted = own_labelled = own_shown = 0
        for detection, vehicle in zip(here, taken, strict=True):
            if vehicle is not None:
                correct += len(correct_points(vehicle, detection, labelled, alpha, least, points))
                known = [k for k in points if is_labelled(vehicle["points"][k][2], labelled)]
                own_labelled += len(known)
                own_shown += count_predicted(detection, least, known)
                own_predicted += count_predicted(detection, least, points)
                sums["predicted"] += count_predicted(detection, least, points)
            elif on_ignored(detection, ignored):
                sums["on_ignored"] += 1
            else:
                sums["predicted"] += count_predicted(detection, least, points)
        sums["labelled"] += own_labelled
        sums["truth"] += len(truth)
        sums["ignored"] += len(ignored)
        sums["detections"] += len(here)
        sums["matched"] += matched
        sums["correct"] += correct
        sums["labelled_all"] += sum(count_labelled(v, labelled, points) for v in truth)
        if truth:
            own["bp"].append(matched / len(here) if here else 0.0)
            own["br"].append(matched / len(truth))
            own["kp"].append(correct / own_predicted if own_predicted else 0.0)
            own["kr"].append((own_shown / own_labelled if own_labelled else 1.0) if matched else 0.0)
    judged = sums["detections"] - sums["on_ignored"]
    mean = {name: divide(sum(values), len(values)) for name, values in own.items()}
    return {
        "counts": sums,
        "pck": divide(sums["correct"], sums["labelled"]),
        "box_precision": {"paper": mean["bp"], "pooled": divide(sums["matched"], judged)},
        "box_recall": {"paper": mean["br"], "pooled": divide(sums["matched"], sums["truth"])},
        "keypoint_precision": {"paper": mean["kp"], "pooled": divide(sums["correct"], sums["predicted"])},
        "keypoint_recall": {"paper": mean["kr"], "pooled": divide(sums["correct"], sums["labelled_all"])},
    }
