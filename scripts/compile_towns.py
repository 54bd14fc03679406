"""Compile the towns' SUMO networks from their plain XML sources.

    python scripts/compile_towns.py [town01 ...]

Runs SUMO's netconvert (pip install skope[maps]) on the sources in skope/gen/towns/*/source and writes town.net.xml
beside them, without the date and paths of netconvert's header; the sources' digest is there instead, by which a test
knows that both belong together.
"""

import sys
from pathlib import Path

from skope.gen.towns import folder, source_digest, towns
from skope.gen.towns.netconvert import COMMON, netconvert

SOURCES = {"nod": "node-files", "edg": "edge-files", "con": "connection-files", "typ": "type-files"}


def compile_town(town: str) -> Path:
    source, out = folder(town) / "source", folder(town) / "town.net.xml"
    found = {option: source / f"town.{kind}.xml" for kind, option in SOURCES.items()}
    options = {**{option: str(path) for option, path in found.items() if path.is_file()}, **COMMON}
    header = f"compiled by scripts/compile_towns.py from sources {source_digest(town)}"
    out.write_text(netconvert(options, header), encoding="utf-8")
    return out


if __name__ == "__main__":
    for name in sys.argv[1:] or towns():
        print(compile_town(name))
