"""Draw the 3D boxes of the vehicles in one frame: in the image, and on the road seen from above.

    python examples/gallery/boxes_3d.py VIDEO CAMERA SECOND OUT LABELS

Defaults: the clip of make_clip.py, its second 20, `boxes_3d.jpg`, and the labels of the clip. LABELS is an annotation
file whose 3D boxes are drawn for comparison, or "none".
"""

import itertools
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import skope

CORNERS = np.array(list(itertools.product((-0.5, 0.5), (-0.5, 0.5), (0, 1))))
"""(8, 3) corners of a box with sides of 1 m: x forward, y left, z up, origin on the ground."""
EDGES = [(a, b) for a, b in itertools.combinations(range(8), 2) if (CORNERS[a] != CORNERS[b]).sum() == 1]
FLOOR = [0, 2, 6, 4]


def main(video: str, camera_file: str, second: str, out: str, labels: str) -> None:
    camera = skope.read_camera(camera_file)
    frame = next(iter(skope.load_detector().video(video, start_s=float(second))))
    located = skope.estimate_poses(frame.detections.above(0.5), camera)
    _, (image, plan) = plt.subplots(2, 1, figsize=(9, 9), height_ratios=(1.2, 1), layout="constrained")
    image.imshow(frame.image, extent=(0, camera.width, camera.height, 0))
    image.set(xlim=(0, camera.width), ylim=(camera.height, 0), xticks=[], yticks=[])
    if labels != "none":
        file = skope.coco.read(Path(labels))
        of_frame = next(one for one in file.images if abs((one.time_s or 0) - (frame.time_s or 0)) < 0.01)
        for box in (label.box_3d for label in file.by_image()[of_frame.id] if label.box_3d):
            floor = (CORNERS * box.size_lwh @ box.R.T + box.center)[FLOOR]
            plan.fill(*floor[:, :2].T, facecolor="none", edgecolor="0.35", linestyle=":", zorder=3)
    for number, i in enumerate(np.flatnonzero(located.good)):
        T, color = located.poses.T_world_vehicle[i], f"C{number % 10}"
        corners = CORNERS * located.poses.size_lwh[i] @ T[:3, :3].T + T[:3, 3]
        pixels = camera.project(corners)[0]
        for edge in EDGES:
            image.plot(*pixels[list(edge)].T, color=color, linewidth=1.4)
        plan.fill(*corners[FLOOR, :2].T, color=color, alpha=0.7)
        plan.arrow(*T[:2, 3], *(4 * T[:2, 0]), color=color, head_width=0.8)
    plan.plot(*camera.position[:2], "k^", markersize=9)
    plan.annotate("camera", camera.position[:2], (-9, -4), textcoords="offset points", ha="right")
    plan.set(xlabel="x, east (m)", ylabel="y, north (m)", aspect="equal", title="Filled: estimated. Dotted: labelled")
    plt.savefig(out, dpi=100, pil_kwargs={"quality": 80})


if __name__ == "__main__":
    defaults = ["clip/site.mp4", "clip/site.json", "20", "boxes_3d.jpg", "clip/site.json"]
    main(*sys.argv[1:], *defaults[len(sys.argv) - 1 :])
