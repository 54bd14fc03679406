"""Draw the speed of vehicles over the distance that they travel, for one movement of a junction.

    python examples/gallery/speed_profile.py TRACKS SITE OUT FROM TO

Defaults: the tracks and site file of make_clip.py, `speed_profile.jpg`, and the gates `west` and `east`.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import skope


def main(tracks: str, site: str, out: str, origin: str, destination: str) -> None:
    report = skope.measure_traffic(tracks, site)
    grid, profiles = np.arange(-60.0, 60.0), []
    _, axes = plt.subplots(figsize=(9, 4.5), layout="constrained")
    for movement in report.movements:
        if movement.sides != ((origin, "in"), (destination, "out")):
            continue
        assert movement.origin
        assert movement.destination
        track = movement.trajectory.during(movement.trajectory.times_s < movement.destination.time_s)
        distance = np.append(0, np.cumsum(np.hypot(*np.diff(track.xy, axis=0).T)))
        distance -= track.at(distance, movement.origin.time_s)  # 0 m is the first gate
        profiles.append(np.interp(grid, distance, 3.6 * track.speed, left=np.nan, right=np.nan))
        axes.plot(distance, 3.6 * track.speed, color="0.75", linewidth=0.8)
    enough = np.isfinite(profiles).sum(axis=0) >= 3
    low, median, high = np.nanpercentile(np.array(profiles)[:, enough], [15, 50, 85], axis=0)
    axes.fill_between(grid[enough], low, high, color="C0", alpha=0.25, label="15th to 85th percentile")
    axes.plot(grid[enough], median, color="C0", linewidth=2.5, label="median")
    axes.plot([], [], color="0.75", label=f"one vehicle (n = {len(profiles)})")
    axes.axvline(0, color="k", linestyle="--", linewidth=1)
    axes.set(xlabel=f"distance from gate '{origin}' along the path (m)", ylabel="speed (km/h)")
    axes.set(xlim=(-100, None), ylim=(0, None))
    axes.set_title(f"From {origin} to {destination}")
    axes.legend(loc="lower left")
    axes.grid(alpha=0.3)
    plt.savefig(out, dpi=100, pil_kwargs={"quality": 90})
    for row in zip(grid[enough][::10], median[::10], strict=True):
        print("{:6.0f} m: {:5.1f} km/h".format(*row))


if __name__ == "__main__":
    defaults = ["clip/report/tracks", "clip/traffic.toml", "speed_profile.jpg", "west", "east"]
    main(*sys.argv[1:], *defaults[len(sys.argv) - 1 :])
