"""Count the vehicles that cross the gates of a site in a video: by direction, class and interval, with 90% intervals.

    python examples/count_vehicles.py VIDEO CAMERA SITE

CAMERA is a camera file, SITE a site file with gates (`skope eval site VIDEO` draws both in the browser).
"""

import sys

import skope


def main(source: str, camera: str, site: str) -> None:
    video = skope.load_detector().video(source, camera=camera)
    print("begin     gate      direction  class    count  90% interval")
    for row in skope.count(video.tracks(), site):
        if row.count is not None and row.confidence_interval is not None and row.lane == "all":
            between = f"{row.confidence_interval.low} to {row.confidence_interval.high}"
            name = f"{row.gate:<8}  {row.direction:<9}  {row.class_name:<8}"
            print(f"{row.interval.begin_s:6.0f} s  {name} {row.count:5}  {between}")


if __name__ == "__main__":
    main(*sys.argv[1:])
