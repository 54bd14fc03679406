"""`skope doctor`: each part is broken once, and its line is read."""

import json
import os
import re
import shutil
import sys
import tomllib
from collections.abc import Callable, Sequence
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import Any

import pytest

from skope import doctor
from skope.detector import weights
from skope.doctor import PartFinding

ROOT = Path(__file__).parent.parent
Line = Callable[[str], str]


@pytest.fixture
def alone(skope: Any, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[int, list[str]]]:
    """Runs the command with the processes of these engines only; returns exit code and lines."""

    def run(*engines: str) -> tuple[int, list[str]]:
        monkeypatch.setattr(doctor, "PROCESSES", {"alone": engines} if engines else {})
        code, out, error = skope("doctor")
        assert error == ""
        return code, out.splitlines()

    return run


def line_of(part: str, lines: Sequence[str]) -> str:
    (line,) = (line for line in lines if line[4:].startswith(f"{part} "))
    return line


def test_a_whole_installation_works(skope: Any) -> None:
    code, out, error = skope("doctor")
    *lines, last = out.splitlines()
    assert (code, error) == (0, "")
    assert last == "all commands work; --pictures DIR also draws test images"
    parts = ["Python", "skope", *doctor.ENGINES, "road33", "road33-lite"]
    parts += [*(f"extra {name}" for name in doctor.EXTRAS), "disk", "memory"]
    assert [line[4:22].rstrip() for line in lines] == parts
    assert {line[:4] for line in lines} <= {"ok  ", "--  "}
    assert re.search(r"^ok  torch +2\.\d+\S*, torchvision 0\.\d+", out, re.MULTILINE)
    assert re.search(r"^ok  OpenGL +.*\d\.\d", out, re.MULTILINE)
    assert re.search(r"^ok  SUMO +libsumo 1\.\d+", out, re.MULTILINE)
    assert re.search(r"^ok  video +PyAV \d+.*decodes h264", out, re.MULTILINE)


def test_the_document_has_what_the_lines_have(skope: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    findings = [
        PartFinding("a", "ok", "1.0"),
        PartFinding("b", "absent", "install it"),
        PartFinding("c", "broken", "no", ("skope gen",)),
    ]
    monkeypatch.setattr(doctor, "examine", lambda _: iter(findings))
    code, out, _ = skope("doctor")
    assert (code, [line.split()[:2] for line in out.splitlines()[:-1]]) == (2, [["ok", "a"], ["--", "b"], ["NOT", "c"]])
    assert out.splitlines()[-1] == "not working: c; these commands fail: skope gen"
    code, out, _ = skope("doctor", "--json")
    told = json.loads(out)
    assert (code, told["works"]) == (2, False)
    assert told["parts"][2] == {"part": "c", "status": "broken", "text": "no", "fails": ["skope gen"]}
    del findings[2]
    assert skope("doctor", "--json")[0] == 0


def test_without_egl_generating_is_named(alone: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", os.devnull)
    code, lines = alone("OpenGL")
    assert code == 2
    assert re.match(r"NOT OpenGL +.*no OpenGL context through EGL .*install libegl1", line_of("OpenGL", lines))
    assert lines[-1] == "not working: OpenGL; these commands fail: skope gen --renderer gl"


def test_the_package_of_a_missing_library_is_named() -> None:
    assert doctor.missing_packages({"libc.so.6": "libc6", "libnothing.so.9": "libnothing9"}) == ["libnothing9"]
    error = doctor._blamed(OSError("cannot open it"), {"libnothing.so.9": "libnothing9"})
    assert str(error) == "apt-get install libnothing9: cannot open it"


def test_the_packages_are_those_of_set_up() -> None:
    setup = (ROOT / "scripts" / "setup.sh").read_text(encoding="utf-8")
    assert dict(re.findall(r"^(lib\S+\.so\.\d+) (\S+)$", setup, re.MULTILINE)) == {
        **doctor.SUMO_PACKAGES,
        **doctor.EGL_PACKAGES,
    }


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda folder: flip(folder / "road33.safetensors"), "road33.safetensors: damaged (not the SHA-256"),
        (lambda folder: (folder / "road33.md").write_text("nothing"), "road33.md: no SHA-256"),
        (lambda folder: (folder / "road33.md").unlink(), "No such file"),
        (lambda folder: shutil.rmtree(folder), "No such file"),
    ],
)
def test_damaged_weights_are_found(
    alone: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: Callable[[Path], object], told: str
) -> None:
    shutil.copytree(weights.WEIGHTS_FOLDER, tmp_path / "weights")
    monkeypatch.setattr(weights, "WEIGHTS_FOLDER", tmp_path / "weights")
    assert alone()[0] == 0
    damage(tmp_path / "weights")
    code, lines = alone()
    assert code == 2
    assert line_of("road33", lines).startswith("NOT road33 ")
    assert told in line_of("road33", lines)
    assert "skope eval predict" in lines[-1]


def flip(path: Path) -> None:
    """Change a bit in the middle of a file."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


class Blocked(MetaPathFinder):
    """Finder that rejects a module, as if it were not installed."""

    def __init__(self, name: str) -> None:
        self.name = name

    def find_spec(self, fullname: str, *_: Any) -> None:
        if fullname == self.name:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)


@pytest.mark.parametrize(
    ("module", "extra"), [("pyarrow", "parquet"), ("paho", "station"), ("ray", "ray"), ("sumo", "maps")]
)
def test_a_missing_extra_has_the_line_that_installs_it(
    alone: Any, monkeypatch: pytest.MonkeyPatch, module: str, extra: str
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Blocked(module), *sys.meta_path])
    code, lines = alone()
    assert code == 0
    assert line_of(f"extra {extra}", lines).startswith("--  ")
    assert line_of(f"extra {extra}", lines).endswith(f": pip install 'skope[{extra}]'")
    assert sum(line.startswith("--") for line in lines) == 1


def test_the_extras_are_those_of_the_package() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert {name: len(modules) for name, (modules, _) in doctor.EXTRAS.items()} == {
        name: len(packages) for name, packages in declared.items() if name != "dev"
    }


def test_a_required_package_that_is_missing_or_too_old(alone: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    version = doctor.metadata.version

    def older(name: str) -> str:
        if name == "isal":
            raise doctor.metadata.PackageNotFoundError(name)
        return "17.9" if name == "av" else version(name)

    monkeypatch.setattr(doctor.metadata, "version", older)
    code, lines = alone()
    assert code == 2
    assert line_of("skope", lines).endswith('missing or too old: pip install "av>=18" "isal>=1.7"')


@pytest.mark.parametrize(("version", "numbers"), [("2.15.0+cpu", [2, 15, 0]), ("18", [18]), ("dev", [])])
def test_numbers_of_a_version(version: str, numbers: list[int]) -> None:
    assert doctor._numbers(version) == numbers


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("import os; os.abort()", "ended with code -6"),
        ("raise ImportError('libLinearMath.so: cannot open')", "libLinearMath.so: cannot open"),
        ("import time; time.sleep(60)", "no answer within 3 s"),
    ],
)
def test_a_library_that_crashes_is_a_line(
    alone: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, told: str
) -> None:
    (tmp_path / "path").mkdir()
    (tmp_path / "path" / "pybullet.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path / "path")
    monkeypatch.setattr(doctor, "PROCESS_LIMIT_S", 3)
    exit_code, lines = alone("pybullet", "SUMO")
    assert exit_code == 2
    assert told in line_of("pybullet", lines)
    assert line_of("SUMO", lines).endswith("not tried, because it needs pybullet")
    assert lines[-1] == "not working: pybullet; these commands fail: skope gen"


def test_a_torchvision_of_another_torch_is_found(alone: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Here one without any operators."""
    (tmp_path / "path" / "torchvision").mkdir(parents=True)
    (tmp_path / "path" / "torchvision" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path / "path")
    code, lines = alone("torch", "GPU")
    assert code == 2
    assert line_of("torch", lines).startswith("NOT torch ")
    assert line_of("torch", lines).endswith("reinstall torch and torchvision together; they must match")
    assert "skope train, skope eval" in lines[-1]


def test_a_file_of_the_folder_is_no_library(alone: Any) -> None:
    Path("pybullet.py").write_text("raise ImportError")
    assert alone("pybullet")[0] == 0


def test_openvino_is_optional_but_not_if_it_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(doctor.AbsentError, match=r"pip install 'skope\[openvino\]'"):
        doctor._openvino()
    monkeypatch.setattr("skope.detector.backends.runtimes.OpenVino.oldest", (9999, 0))
    monkeypatch.delitem(sys.modules, "openvino")
    with pytest.raises(ValueError, match="too old"):
        doctor._openvino()


def test_the_number_format_is_the_one_that_predicting_has(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skope.detector.device.has_bfloat16", lambda _: False)
    assert doctor._openvino().endswith("the shipped detectors run in int8, other checkpoints in float32")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(doctor.AbsentError, match="CPU, in float32 with torch"):
        doctor._gpu()
