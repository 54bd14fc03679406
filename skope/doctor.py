"""Check of an installation: working and missing parts, and the commands that fail without them.

Libraries with compiled code are tried in processes of their own, which run at the same time. A crash of a library is
then one line of the result. OpenGL is never loaded beside torch: torch crashes if Mesa's compiler was loaded before it.
"""

import contextlib
import ctypes
import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Final, Literal

from skope.cpu_count import usable_processors
from skope.detector import weights
from skope.errors import first_line
from skope.files.atomic import sha256_of
from skope.terminal.console import counted, disk_size
from skope.version import __version__

Status = Literal["ok", "absent", "broken"]
STATUS_WORDS: Final[dict[Status, str]] = {"ok": "ok", "absent": "--", "broken": "NOT"}
"""First word of a printed line."""

OLDEST_PYTHON: Final = (3, 11)
PROCESS_LIMIT_S: Final = 60
"""Maximum duration of a process that tries libraries, seconds."""


@dataclass(frozen=True)
class PartFinding:
    """Result of checking one part."""

    part: str
    """Name of the part."""
    status: Status
    """`ok`; `absent`: an optional part that is not installed; `broken`: a command fails because of it."""
    text: str
    """Version or property of a working part, otherwise the reason and a remedy."""
    fails: tuple[str, ...] = ()
    """Commands that fail because of a broken part."""


class AbsentError(Exception):
    """An optional part is not there; the message is the text of its line."""


@dataclass(frozen=True)
class Engine:
    """Library with compiled code, which is tried in a process of its own."""

    test: Callable[[], str]
    """Returns version or properties; raises AbsentError, or any other exception if the part is broken."""
    remedy: str
    fails: tuple[str, ...]
    """Commands that fail without it."""


DETECTING: Final = ("skope train", "skope eval", "skope eval predict")

EXTRAS: Final = {
    "maps": (("sumo",), "maps of your own roads"),
    "mesh": (("trimesh",), "your own vehicle models"),
    "openvino": (("onnx", "openvino"), "faster detection on a CPU"),
    "onnx": (("onnx", "onnxruntime"), "export to ONNX"),
    "logging": (("tensorboard",), "TensorBoard"),
    "parquet": (("pyarrow",), "traffic tables with data types"),
    "ray": (("ray",), "generating on a cluster"),
    "station": (
        ("fastapi", "paho.mqtt", "prometheus_client", "psycopg", "sqlalchemy", "uvicorn"),
        "a counting station",
    ),
}
"""Modules and purpose of each extra of pyproject.toml."""

EGL_PACKAGES: Final = {"libEGL.so.1": "libegl1", "libEGL_mesa.so.0": "libegl-mesa0"}
"""Libraries that rendering loads, with Debian's packages."""
SUMO_PACKAGES: Final = {
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libXext.so.6": "libxext6",
    "libXrender.so.1": "libxrender1",
    "libatomic.so.1": "libatomic1",
}
"""Libraries that libsumo links against, with Debian's packages."""
DECODERS: Final = ("h264", "hevc", "av1", "mjpeg", "mpeg4", "vp9")
"""Codecs of common cameras and files."""


def examine(pictures: Path | None = None) -> Iterator[PartFinding]:
    """Try every part of the installation, and yield a finding for each, in the order of the printed lines.

    With `pictures`, also simulate a frame, and draw it with each renderer to that folder.
    """
    with contextlib.ExitStack() as stack:
        started = {name: (stack.enter_context(_started(parts)), parts) for name, parts in PROCESSES.items()}
        yield _python()
        yield _packages()
        for process, parts in started.values():
            yield from _collected(process, parts)
    yield from map(_weights, weights.names() or (weights.DEFAULT_WEIGHTS,))
    yield from map(_extra, EXTRAS)
    yield PartFinding("disk", "ok", f"{disk_size(shutil.disk_usage('.').free)} free in this folder")
    yield PartFinding("memory", "ok", _memory())
    if pictures is not None:
        yield from _test_images(pictures)


# --------------------------------------------------------------------------------------------- parts of this process


def _python() -> PartFinding:
    """Return the version of Python and the platform."""
    works = sys.version_info >= OLDEST_PYTHON
    text = f"{platform.python_version()} on {platform.platform()}"
    if works:
        return PartFinding("Python", "ok", text)
    oldest = ".".join(map(str, OLDEST_PYTHON))
    return PartFinding("Python", "broken", f"{text}; Python {oldest} is the oldest that works", ("skope",))


def _packages() -> PartFinding:
    """Return the version of skope, and the required packages that are missing or too old."""
    try:
        required = metadata.requires("skope") or []
    except metadata.PackageNotFoundError:
        return PartFinding("skope", "absent", f"{__version__}, not installed; run it with `python -m skope`")
    wanted = [line for line in required if ";" not in line]
    if wrong := [line for line in wanted if not _is_installed(line)]:
        names = " ".join(f'"{line}"' for line in wrong)
        return PartFinding("skope", "broken", f"{__version__}; missing or too old: pip install {names}", ("skope",))
    return PartFinding("skope", "ok", f"{__version__}, with its {len(wanted)} required packages")


def _is_installed(requirement: str) -> bool:
    """Return whether a package such as "av>=18" is installed in this version or a later one."""
    name, _, oldest = requirement.partition(">=")
    try:
        return _numbers(metadata.version(name)) >= _numbers(oldest)
    except metadata.PackageNotFoundError:
        return False


def _numbers(version: str) -> list[int]:
    """Return the leading numbers of a version: [2, 15, 0] of "2.15.0+cpu"."""
    found = re.match(r"\d+(?:\.\d+)*", version)
    return [int(part) for part in found[0].split(".")] if found else []


def _weights(name: str) -> PartFinding:
    """Compare the weights of a shipped detector with the SHA-256 in its card."""
    path = weights.path(name)
    remedy = "install skope again"
    try:
        card = re.search(r"^\| SHA-256 \| `([0-9a-f]{64})`", path.with_suffix(".md").read_text(encoding="utf-8"), re.M)
        if card is None:
            return PartFinding(name, "broken", f"{path.with_suffix('.md')}: no SHA-256; {remedy}", DETECTING)
        if sha256_of(path) != card[1]:
            return PartFinding(name, "broken", f"{path}: damaged (not the SHA-256 of its card); {remedy}", DETECTING)
    except (OSError, ValueError) as error:
        return PartFinding(name, "broken", f"{error}; {remedy}", DETECTING)
    return PartFinding(name, "ok", f"weights of {disk_size(path.stat().st_size)} with the SHA-256 of their card")


def _extra(name: str) -> PartFinding:
    """Look for the modules of an extra, without importing them."""
    modules, purpose = EXTRAS[name]
    missing = [module for module in modules if not _is_found(module)]
    if not missing:
        return PartFinding(f"extra {name}", "ok", "installed")
    return PartFinding(f"extra {name}", "absent", f"{purpose}: pip install 'skope[{name}]'")


def _is_found(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ImportError:
        return False


def _memory() -> str:
    """Return the memory that is available, and the processors that skope uses."""
    processors = counted(usable_processors(), "processor")
    try:
        text = Path("/proc/meminfo").read_text(encoding="utf-8")
    except OSError:
        return f"unknown; {processors}"
    kilobytes = dict(re.findall(r"^(\w+): +(\d+)", text, re.M))
    if not {"MemTotal", "MemAvailable"} <= kilobytes.keys():
        return f"unknown; {processors}"
    total, available = (disk_size(1024 * int(kilobytes[name])) for name in ("MemTotal", "MemAvailable"))
    return f"{available} available of {total}; {processors}"


def _test_images(folder: Path) -> Iterator[PartFinding]:
    """Simulate a frame and draw it with each renderer; without a simulation, draw an empty street."""
    from skope.gen.inspect.trial_images import TESTED_RENDERERS, draw_test_image, simulated_frame

    recording = None
    try:
        recording = simulated_frame()
        yield PartFinding("simulation", "ok", f"{counted(len(recording.vehicles), 'vehicle')} near {recording.site}")
    except Exception as error:  # a broken library may raise any exception
        yield PartFinding("simulation", "broken", f"{first_line(error)}; see SUMO and pybullet above", ("skope gen",))
    for name in TESTED_RENDERERS:
        try:
            driver = draw_test_image(name, recording, folder)
            yield PartFinding(f"renderer {name}", "ok", f"{driver}; drew doctor_{name}.png")
        except Exception as error:  # likewise
            yield PartFinding(f"renderer {name}", "broken", first_line(error), (f"skope gen --renderer {name}",))


# ------------------------------------------------------------------------------------------ parts in other processes


def _torch() -> str:
    """Compute with torch and with the operators of torchvision, which fail if the versions do not match.

    Loading the operators alone saves half of the time: the Python part of torchvision imports torch's compiler.
    """
    import torch

    operators: Any = torch.ops
    package = importlib.util.find_spec("torchvision")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("No module named 'torchvision'")
    for library in Path(package.origin).parent.glob("_C*.so"):
        operators.load_library(library)
    operators.torchvision.nms(torch.tensor([[0.0, 0.0, 1.0, 1.0]]), torch.tensor([1.0]), 0.5)
    return f"{torch.__version__}, torchvision {metadata.version('torchvision')}"


def _gpu() -> str:
    import torch

    from skope.detector.device import TORCH_FORMATS

    if not torch.cuda.is_available():
        driver = " (the driver is there: this build of torch may lack CUDA)" if Path("/dev/nvidia0").exists() else ""
        raise AbsentError(
            f"none{driver}; everything runs on the CPU, in {_number_format(TORCH_FORMATS, 'cpu')} with torch"
        )
    memory = disk_size(torch.cuda.get_device_properties(0).total_memory)
    return f"{torch.cuda.get_device_name()}, {memory}; detectors run on it in {_number_format(TORCH_FORMATS, 'cuda')}"


def _openvino() -> str:
    from skope.detector.backends.runtimes import OpenVino, UnusableError

    try:
        runtime = OpenVino()
    except UnusableError as error:
        if error.missing:
            raise AbsentError("detection on a CPU takes four times as long: pip install 'skope[openvino]'") from None
        raise
    shipped, others = (_number_format(runtime.formats, "cpu", ranged=ranged) for ranged in (True, False))
    return f"{runtime.version}; on this CPU the shipped detectors run in {shipped}, other checkpoints in {others}"


def _number_format(formats: tuple[str, ...], device: str, *, ranged: bool = False) -> str:
    """Return the number format that skope selects among those of a library."""
    import torch

    from skope.detector.device import choose_number_format

    return choose_number_format("auto", "", formats, ranged=ranged, device=torch.device(device))


def _opengl() -> str:
    from skope.gen.render.choose_renderer import choose_renderer

    try:
        return choose_renderer("gl")[1]
    except Exception as error:
        raise _blamed(error, EGL_PACKAGES) from None


def _sumo() -> str:
    from skope.gen.traffic.sumo import load_libsumo

    try:
        return f"libsumo {load_libsumo().getVersion()[1].removeprefix('SUMO ')}"
    except Exception as error:
        raise _blamed(error, SUMO_PACKAGES) from None


def _blamed(error: Exception, packages: dict[str, str]) -> Exception:
    """Return an error that begins with the command that installs missing system libraries, if there are any."""
    names = missing_packages(packages)
    return RuntimeError(f"apt-get install {' '.join(names)}: {error}") if names else error


def missing_packages(packages: dict[str, str]) -> list[str]:
    """Return the packages whose library cannot be loaded; `packages` has a package for each library."""
    missing = []
    for library, package in packages.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            missing.append(package)
    return missing


def _pybullet() -> str:
    from skope.gen.simulation.pybullet_engine import engine

    return f"API {engine().getAPIVersion()}"


def _video() -> str:
    """Write three frames in H.264, read them again, and return the codecs that can be read."""
    import av
    import numpy as np
    from av.codec import Codec

    from skope.video.write import write_video

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "three.mp4"
        write_video(path, [np.full((16, 16, 3), 80 * k, dtype=np.uint8) for k in range(3)], 10.0)
        with av.open(str(path)) as file:
            frames = sum(1 for _ in file.decode(video=0))
    if frames != 3:
        raise RuntimeError(f"H.264: {frames} frames of 3 were read")
    missing = []
    for name in DECODERS:
        try:
            Codec(name, "r")
        except ValueError:
            missing.append(name)
    able = ", ".join(name for name in DECODERS if name not in missing)
    return f"PyAV {av.__version__}, decodes {able}" + (f"; not {', '.join(missing)}" if missing else "")


ENGINES: Final = {
    "torch": Engine(_torch, "reinstall torch and torchvision together; they must match", DETECTING),
    "GPU": Engine(_gpu, "--device cpu computes without it", ("skope train", "skope eval predict")),
    "OpenVINO": Engine(_openvino, "torch computes instead", ("skope eval predict --backend openvino",)),
    "OpenGL": Engine(
        _opengl,
        "without it `skope gen` draws simpler images with pybullet",
        ("skope gen --renderer gl",),
    ),
    "SUMO": Engine(_sumo, "reinstall libsumo", ("skope gen",)),
    "pybullet": Engine(_pybullet, "reinstall pybullet; Python 3.11 has wheels, later ones compile it", ("skope gen",)),
    "video": Engine(_video, "reinstall av", ("skope eval predict", "skope eval site", "skope gen video")),
}
"""Parts that are tried in processes, in the order of the printed lines."""

PROCESSES: Final = {
    "detector": ("torch", "GPU", "OpenVINO"),
    "rendering": ("OpenGL",),
    "traffic": ("SUMO",),
    "physics": ("pybullet",),
    "video": ("video",),
}
"""Parts that are tried in each process, one after the other; each needs those before it."""


def try_engines(parts: Sequence[str]) -> None:
    """Try parts in this process up to the first broken one; print a line of JSON for each: name, status and text."""
    for part in parts:
        status: Status = "ok"
        try:
            text = ENGINES[part].test()
        except AbsentError as error:
            status, text = "absent", str(error)
        except Exception as error:  # a broken library may raise any exception
            status, text = "broken", f"{first_line(error)}; {ENGINES[part].remedy}"
        print(json.dumps([part, status, text]), flush=True)
        if status == "broken":
            return


@contextlib.contextmanager
def _started(parts: Sequence[str]) -> Iterator["subprocess.Popen[str]"]:
    """Start a process that tries some parts; it is ended with the block."""
    code = f"from skope.doctor import try_engines; try_engines({list(parts)!r})"
    path = os.pathsep.join(filter(None, sys.path))
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", code],
        env={**os.environ, "PYTHONPATH": path},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def _collected(process: "subprocess.Popen[str]", parts: Sequence[str]) -> Iterator[PartFinding]:
    """Yield the findings of a process. If it ends early, the first part that it did not report is broken."""
    try:
        out, error = process.communicate(timeout=PROCESS_LIMIT_S)
        end = (error.strip().splitlines() or [f"ended with code {process.returncode}"])[-1]
    except subprocess.TimeoutExpired:
        process.kill()
        out, _ = process.communicate()
        end = f"no answer within {PROCESS_LIMIT_S} s"
    found: dict[str, tuple[Status, str]] = {}
    for line in out.splitlines():
        with contextlib.suppress(ValueError):  # libraries print lines too
            part, status, text = json.loads(line)
            found[part] = status, text
    broken = ""
    for part in parts:
        if broken:
            yield PartFinding(part, "absent", f"not tried, because it needs {broken}")
            continue
        status, text = found.get(part, ("broken", f"{end}; {ENGINES[part].remedy}"))
        broken = part if status == "broken" else ""
        yield PartFinding(part, status, text, ENGINES[part].fails if broken else ())
