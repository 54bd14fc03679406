"""Versions of the packages that determine the content of recordings and datasets."""

from contextlib import suppress
from importlib import metadata

from skope.version import __version__


def versions() -> dict[str, str]:
    """Return the versions of the packages that determine the content of recordings and datasets."""
    packages = {
        "sumo": "libsumo",
        "pybullet": "pybullet",
        "numpy": "numpy",
        "opencv": "opencv-python-headless",
        "orjson": "orjson",  # determines how numbers are written
    }
    found = {}
    for name, package in packages.items():
        with suppress(metadata.PackageNotFoundError):  # rendering does not need the traffic packages
            found[name] = metadata.version(package)
    return {"skope": __version__, **found}
