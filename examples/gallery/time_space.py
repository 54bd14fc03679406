"""Draw the time-space diagram of one approach of a junction. Colours show the speed.

    python examples/gallery/time_space.py TRACKS SITE OUT GATE

Defaults: the tracks and site file of make_clip.py, `time_space.jpg`, and vehicles that enter at the gate `west`.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize

import skope


def main(tracks: str, site: str, out: str, gate: str) -> None:
    report = skope.measure_traffic(tracks, site)
    figure, axes = plt.subplots(figsize=(9, 5), layout="constrained")
    for movement in report.movements:
        if movement.origin is None or movement.sides[0] != (gate, "in"):
            continue
        end_s = movement.destination.time_s if movement.destination else np.inf
        track = movement.trajectory.during(movement.trajectory.times_s < end_s)
        distance = np.append(0, np.cumsum(np.hypot(*np.diff(track.xy, axis=0).T)))
        distance -= track.at(distance, movement.origin.time_s)  # 0 m is the gate
        points = np.column_stack([track.times_s, distance])
        lines = LineCollection(list(np.stack([points[:-1], points[1:]], axis=1)), cmap="RdYlGn", norm=Normalize(0, 50))
        lines.set(array=3.6 * track.speed[:-1], linewidth=2)
        axes.add_collection(lines)
        print(
            f"track {track.number}: gate at {movement.origin.time_s:.1f} s, slowest {3.6 * track.speed.min():.0f} km/h"
        )
    axes.autoscale()
    axes.axhline(0, color="k", linestyle="--", linewidth=1)
    axes.annotate(f"gate '{gate}'", (0.99, 0), (0, 4), ("axes fraction", "data"), "offset points", ha="right")
    axes.set(xlabel="time (s)", ylabel="distance from the gate (m)", facecolor="0.93")
    figure.colorbar(lines, label="speed (km/h)")
    plt.savefig(out, dpi=100, pil_kwargs={"quality": 90})


if __name__ == "__main__":
    defaults = ["clip/report/tracks", "clip/traffic.toml", "time_space.jpg", "west"]
    main(*sys.argv[1:], *defaults[len(sys.argv) - 1 :])
