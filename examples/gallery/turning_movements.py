"""Draw the turning movements of a junction: the mean path of each movement, as wide as its number of vehicles.

    python examples/gallery/turning_movements.py TRACKS SITE OUT

Defaults: the tracks and site file of make_clip.py, and `turning_movements.jpg`. The site file needs a gate across each
arm of the junction, with the directions `in` and `out`.
"""

import sys
from collections import defaultdict

import matplotlib.pyplot as plt
import numpy as np

import skope


def main(tracks: str, site: str, out: str) -> None:
    report = skope.measure_traffic(tracks, site)
    paths = defaultdict(list)
    for movement in report.movements:
        (origin, inwards), (destination, outwards) = movement.sides
        if movement.origin and movement.destination and (inwards, outwards) == ("in", "out"):
            times_s = np.linspace(movement.origin.time_s, movement.destination.time_s, 60)
            paths[origin, destination].append(movement.trajectory.at(movement.trajectory.xy, times_s))
    _, axes = plt.subplots(figsize=(9, 6.5), layout="constrained")
    for track in report.trajectories:
        axes.plot(*track.xy.T, color="0.9", linewidth=0.6, zorder=0)
    for gate in report.gates:
        axes.plot(*np.array(gate.line).T, color="k", linewidth=1.5)
        top = max(gate.line, key=lambda end: end[1])
        axes.annotate(gate.name, top, (0, 6), textcoords="offset points", ha="center", weight="bold")
    widest = max(map(len, paths.values()))
    for number, ((origin, destination), followed) in enumerate(sorted(paths.items(), key=lambda one: -len(one[1]))):
        path, color = np.mean(followed, axis=0), f"C{number}"
        label = f"{origin} to {destination}: {len(followed)}"
        axes.plot(*path.T, color=color, alpha=0.75, linewidth=14 * len(followed) / widest, label=label)
        ahead = (path[-1] - path[-2]) / np.linalg.norm(path[-1] - path[-2])
        head = {"head_width": 1.5, "head_length": 1.8, "linewidth": 0}
        axes.arrow(*path[-1], *(0.01 * ahead), color=color, zorder=3, **head)
        print(label)
    ends = np.concatenate([gate.line for gate in report.gates])
    (left, low), (right, high) = ends.min(axis=0) - 5, ends.max(axis=0) + 5
    axes.set(xlabel="x, east (m)", ylabel="y, north (m)", aspect="equal", xlim=(left, right), ylim=(low, high))
    for line in axes.legend(title="road users by movement", loc="upper left", fontsize=11).get_lines():
        line.set_linewidth(5)
    plt.savefig(out, dpi=100, pil_kwargs={"quality": 90})


if __name__ == "__main__":
    defaults = ["clip/report/tracks", "clip/traffic.toml", "turning_movements.jpg"]
    main(*sys.argv[1:], *defaults[len(sys.argv) - 1 :])
