"""Draw near misses on a map: pairs of road users with a small post-encroachment time (PET) or time to collision (TTC).

    python examples/gallery/near_misses.py TRACKS SITE OUT

Defaults: the tracks and site file of make_clip.py, and `near_misses.jpg`. The site file needs gates, which set the
limits of the map, and a zone: near misses outside all zones are left out.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

import skope

LIMIT_S = 3.0
"""Maximum PET or TTC of a near miss, seconds."""


def main(tracks: str, site: str, out: str) -> None:
    report = skope.measure_traffic(tracks, site)
    in_zones = [one for one in report.conflicts.conflicts if one.zone]
    found = [one for one in in_zones if np.fmin(one.pet_ssam_s, one.ttc_s) <= LIMIT_S]
    figure, axes = plt.subplots(figsize=(9, 6.5), layout="constrained")
    for track in report.trajectories:
        axes.plot(*track.xy.T, color="0.85", linewidth=0.8, zorder=0)
    warm = plt.get_cmap("RdYlGn")
    for marker, name, key in (("o", "PET", "pet_ssam_s"), ("s", "TTC", "ttc_s")):
        pairs = [one for one in found if np.isfinite(getattr(one, key))]
        x, y = np.array([one.position for one in pairs]).reshape(-1, 2).T
        color = [warm(getattr(one, key) / LIMIT_S) for one in pairs]
        label = f"{name} (n = {len(pairs)})"
        axes.scatter(x, y, 150, color, marker=marker, edgecolors="k", zorder=3, label=label)
        for one in pairs:
            for track in (one.first, one.second):
                near = np.abs(track.times_s - one.time_s) < 2
                axes.plot(*track.xy[near].T, color="0.4", linewidth=1)
    figure.colorbar(ScalarMappable(Normalize(0, LIMIT_S), warm), ax=axes, label="PET or TTC (s)")
    ends = np.concatenate([gate.line for gate in report.gates])
    (left, low), (right, high) = ends.min(axis=0) - 5, ends.max(axis=0) + 5
    axes.set(xlabel="x, east (m)", ylabel="y, north (m)", aspect="equal", xlim=(left, right), ylim=(low, high))
    axes.legend(loc="upper left")
    plt.savefig(out, dpi=100, pil_kwargs={"quality": 90})
    for one in sorted(found, key=lambda one: one.time_s):
        tracks_of = f"{one.first.number} and {one.second.number}"
        print(f"{one.time_s:6.1f} s  {one.kind:<11}  PET {one.pet_ssam_s:4.1f} s  TTC {one.ttc_s:4.1f} s  {tracks_of}")


if __name__ == "__main__":
    defaults = ["clip/report/tracks", "clip/traffic.toml", "near_misses.jpg"]
    main(*sys.argv[1:], *defaults[len(sys.argv) - 1 :])
