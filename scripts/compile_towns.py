"""Compile the towns' SUMO networks from their plain XML sources.

    python scripts/compile_towns.py [town01 ...]

Runs SUMO's netconvert (pip install skope[maps]) with the options below on the sources in skope/gen/towns/*/source and
writes town.net.xml beside them, without the date and paths of netconvert's header; the sources' digest is there
instead, by which a test knows that both belong together.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

from skope.gen.towns import folder, source_digest, towns

OPTIONS = {
    "output.street-names": "false",
    "offset.disable-normalization": "true",
    "default.lanewidth": "3.3",
    "tls.yellow.time": "3",
    "no-turnarounds": "true",
    "junctions.corner-detail": "8",
    "junctions.internal-link-detail": "12",
}
SOURCES = {"nod": "node-files", "edg": "edge-files", "con": "connection-files", "typ": "type-files"}


def netconvert() -> str:
    """The program beside this Python, or the one in the path."""
    beside = Path(sys.executable).with_name("netconvert")
    return str(beside) if beside.is_file() else "netconvert"


def compile_town(town: str) -> Path:
    source, out = folder(town) / "source", folder(town) / "town.net.xml"
    found = {option: source / f"town.{kind}.xml" for kind, option in SOURCES.items()}
    options = {**{option: str(path) for option, path in found.items() if path.is_file()}, **OPTIONS}
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch) / "town.net.xml"
        flags = [f"--{name}={value}" for name, value in {**options, "output-file": str(made)}.items()]
        subprocess.run([netconvert(), *flags], check=True)
        text = made.read_text(encoding="utf-8")
    header = f"<!-- compiled by scripts/compile_towns.py from sources {source_digest(town)} -->"
    out.write_text(re.sub(r"<!--.*?-->", header, text, count=1, flags=re.DOTALL), encoding="utf-8")
    return out


if __name__ == "__main__":
    for name in sys.argv[1:] or towns():
        print(compile_town(name))
