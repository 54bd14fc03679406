"""Make the input of the gallery's traffic programs: a generated video of a junction, and the tracks in it.

    python examples/gallery/make_clip.py CLIP SECONDS

CLIP is a new folder (default: `clip`), SECONDS the length of the video (default: 180). The folder then contains:

- `site.mp4` and `site.json`: the video, and its labels with the camera of each frame;
- `traffic.toml`: the site file with camera, gates, zone and lanes;
- `report/tracks`: the tracks that skope found in the video; `report/report.html` is its traffic report.

The road is that of examples/own_road, with more traffic.
"""

import shutil
import subprocess
import sys
from pathlib import Path

ROAD = Path(__file__).parents[1] / "own_road"


def main(clip: Path, seconds: str) -> None:
    shutil.copytree(ROAD, clip)
    site, traffic = clip / "site.toml", clip / "traffic.toml"
    site.write_text(site.read_text().replace("vehicles_per_hour = 900", "vehicles_per_hour = 1100"))
    skope("gen", "video", site, "--seconds", seconds, "--fps", "5", "--out", clip)
    skope("eval", "traffic", clip / "site.mp4", "--site", traffic, "--out", clip / "report")


def skope(*arguments: str | Path) -> None:
    subprocess.run([sys.executable, "-m", "skope", *arguments], check=True)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "clip"), sys.argv[2] if len(sys.argv) > 2 else "180")
