"""Compile the towns' SUMO networks from their plain XML sources.

    python scripts/compile_towns.py [town01 ...] [--out FOLDER]

Runs SUMO's netconvert (pip install 'skope[maps]') on the sources in skope/gen/towns/*/source and writes town.net.xml
beside them. The date and paths of netconvert's header are replaced by a digest of the sources, with which a test checks
that network and sources match.
"""

import argparse
from pathlib import Path

from skope.errors import UserError, one_of
from skope.gen.towns.netconvert import COMMON_OPTIONS, netconvert
from skope.gen.towns.town import source_digest, town_folder, towns

SOURCES = {"nod": "node-files", "edg": "edge-files", "con": "connection-files", "typ": "type-files"}


def compile_town(town: str, out: Path) -> None:
    """Write the network of a town. Raises UserError."""
    source = town_folder(town) / "source"
    found = {option: source / f"town.{kind}.xml" for kind, option in SOURCES.items()}
    options = {**{option: str(path) for option, path in found.items() if path.is_file()}, **COMMON_OPTIONS}
    header = f"compiled by scripts/compile_towns.py from sources {source_digest(town)}"
    out.write_text(netconvert(options, header), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = tuple(town.name for town in towns())
    parser.add_argument("towns", nargs="*", metavar="TOWN", help=f"one of {', '.join(names)}; default: all")
    parser.add_argument("--out", type=Path, help="folder for TOWN.net.xml; default: town.net.xml beside the sources")
    options = parser.parse_args()
    for town in options.towns or names:
        out = options.out / f"{town}.net.xml" if options.out else town_folder(town) / "town.net.xml"
        try:
            compile_town(one_of("TOWN", town, names), out)
        except UserError as error:
            parser.exit(2, f"compile_towns: {error}\n")
        print(out)


if __name__ == "__main__":
    main()
