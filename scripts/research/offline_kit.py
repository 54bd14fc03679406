"""Pack what `skope gen` needs beside torch and OpenCV for a Linux machine without network, as small as it can be.

    pip download --no-deps --only-binary=:all: --python-version 3.12 --platform manylinux_2_28_x86_64 -d wheels \
        libsumo sumolib traci shapely orjson pycocotools moderngl glcontext fast-simplification isal tabulate
    pip wheel --no-deps -w wheels pybullet        # by a Python of that version, where there is no ready wheel
    python scripts/research/offline_kit.py wheels --out site.tar.xz

There: unpack it into a folder and name that in PYTHONPATH. libsumo's wheel brings 120 libraries, 230 MB, of which
simulating calls three; the others are replaced by an empty library each and one that has all their names, so that it
loads. Of pybullet only the module is kept, without debugging symbols. Together 14 MB instead of 200.

Needs gcc, nm, readelf and strip of this machine's processor.
"""

import argparse
import re
import shutil
import subprocess
import tarfile
import tempfile
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path

CALLED = ("libxerces-c", "libFOX", "libjupedsim")
"""Libraries of libsumo's wheel that simulating calls."""
SYSTEM = ("libstdc++.so.6", "libm.so.6", "libc.so.6", "libgcc_s.so.1", "libz.so.1")
"""Libraries that every machine has, whose names need no stand-in."""
EVERYWHERE = re.compile(r"lib(pthread|dl|rt|m|c|gcc_s|stdc\+\+|z)\.so|ld-linux")
LEAST_BYTES = 64
"""Size of a stand-in for data of unknown size."""


def names(library: Path, which: str) -> Iterator[tuple[str, str, int]]:
    """Name, kind and size of the dynamic symbols of a library; `which` is an option of nm."""
    listed = subprocess.run(["nm", "-D", "-S", which, str(library)], capture_output=True, text=True, check=False)
    for line in listed.stdout.splitlines():
        *before, kind, name = line.split()
        yield name.partition("@")[0], kind, int(before[1], 16) if len(before) > 1 else 0


def needed(library: Path) -> set[str]:
    """Names of the libraries that a library loads."""
    listed = subprocess.run(["readelf", "-d", str(library)], capture_output=True, text=True, check=True)
    return set(re.findall(r"NEEDED.*\[(.*)\]", listed.stdout))


def system_libraries() -> list[Path]:
    """Where this machine has the libraries of `SYSTEM`."""
    found = subprocess.run(["ldconfig", "-p"], capture_output=True, text=True, check=True).stdout
    places = dict(re.findall(r"(\S+) \(libc6,x86-64\) => (\S+)", found))
    return [Path(places[name]) for name in SYSTEM if name in places]


def slim_libsumo(site: Path) -> None:
    """Replace all libraries of libsumo's wheel, unpacked in `site`, that simulating does not call."""
    folder = site / "libsumo.libs"
    kept = [path for path in folder.iterdir() if path.name.startswith(CALLED)]
    others = [path for path in folder.iterdir() if path not in kept]
    loading = [site / "libsumo" / "_libsumo.so", *kept]
    defined = {name for one in (*loading, *system_libraries()) for name, _, _ in names(one, "--defined-only")}
    wanted = {
        name
        for one in loading
        for name, kind, _ in names(one, "--undefined-only")
        if kind != "w" and name not in defined and not name.startswith(("Py", "_Py"))
    }
    kinds = {
        name: (kind, size) for one in others for name, kind, size in names(one, "--defined-only") if name in wanted
    }
    stubs = sorted(
        {name for one in loading for name in needed(one) if not EVERYWHERE.match(name)} - {k.name for k in kept}
    )
    for path in others:
        path.unlink()
    write_stubs(folder, sorted(stubs), wanted, kinds)
    for path in loading:
        subprocess.run(["strip", str(path)], check=True)


def write_stubs(folder: Path, stubs: list[str], wanted: Iterable[str], kinds: dict[str, tuple[str, int]]) -> None:
    """Libraries of those names, of which the first has a symbol of each wanted name: functions return 0, data is 0."""
    functions = sorted(name for name in wanted if kinds.get(name, ("T", 0))[0] in "TWi")
    data = sorted(set(wanted) - set(functions))
    lines = [".text", *(f'.globl "{name}"\n.type "{name}",@function\n"{name}":' for name in functions)]
    lines += [" xor %eax,%eax", " ret", ".data", ".balign 16"]
    for name in data:
        size = max(kinds[name][1], LEAST_BYTES)
        lines.append(f'.globl "{name}"\n.type "{name}",@object\n.size "{name}",{size}\n"{name}":\n .zero {size}')
    lines.append('.section .note.GNU-stack,"",@progbits')
    with tempfile.TemporaryDirectory() as scratch:
        whole, empty = Path(scratch) / "all.s", Path(scratch) / "empty.s"
        whole.write_text("\n".join(lines) + "\n")
        empty.write_text('.section .note.GNU-stack,"",@progbits\n')
        for name in stubs:
            source = whole if name == stubs[0] else empty
            command = ["gcc", "-shared", "-nostdlib", "-o", str(folder / name), str(source), f"-Wl,-soname,{name}"]
            subprocess.run(command, check=True)


def unpack(wheels: Path, site: Path) -> None:
    """Unpack the wheels of a folder, of pybullet its module alone."""
    for wheel in sorted(wheels.glob("*.whl")):
        with zipfile.ZipFile(wheel) as archive:
            members = archive.namelist()
            if wheel.name.startswith("pybullet"):
                members = [name for name in members if re.fullmatch(r"pybullet\.[^/]*\.so", name)]
            archive.extractall(site, members)
        if wheel.name.startswith("pybullet"):
            for name in members:
                subprocess.run(["strip", str(site / name)], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wheels", type=Path, help="folder of wheels for the other machine's Python")
    parser.add_argument("--out", type=Path, default=Path("site.tar.xz"))
    options = parser.parse_args()
    for package in ("libsumo", "pybullet"):
        if not list(options.wheels.glob(f"{package}-*.whl")):
            parser.error(f"{options.wheels}: no wheel of {package}")
    with tempfile.TemporaryDirectory() as scratch:
        site = Path(scratch)
        unpack(options.wheels, site)
        slim_libsumo(site)
        for cache in site.rglob("__pycache__"):
            shutil.rmtree(cache)
        with tarfile.open(options.out, "w:xz") as archive:
            archive.add(site, ".")
    print(f"wrote {options.out} ({options.out.stat().st_size / 1e6:.1f} MB)")


if __name__ == "__main__":
    main()
