"""Versions of what decides the content of recordings and datasets."""

from contextlib import suppress
from importlib import metadata

from skope.version import __version__


def versions() -> dict[str, str]:
    """Versions of what decides a recording's and a dataset's content."""
    packages = {
        "sumo": "libsumo",
        "pybullet": "pybullet",
        "numpy": "numpy",
        "opencv": "opencv-python-headless",
        "orjson": "orjson",  # how numbers are written
    }
    found = {}
    for name, package in packages.items():
        with suppress(metadata.PackageNotFoundError):  # what renders needs no traffic
            found[name] = metadata.version(package)
    return {"skope": __version__, **found}
