import os
import re
import shutil
import signal
import site
import subprocess
import sys
import tomllib
import urllib.request
import venv
import zipfile
from pathlib import Path

import pytest

import skope
from tests.waiting import HANG_S

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the files that git holds or would hold: what a release is built from."""
    folder = tmp_path_factory.mktemp("release") / "source"
    listing = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listing, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0")
    for name in filter(None, names):
        if (name.startswith("skope/") or "/" not in name) and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    return folder


@pytest.fixture(scope="module")
def wheel(source: Path) -> Path:
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(source.parent)]
    subprocess.run([*build, str(source)], check=True, capture_output=True)
    (built,) = source.parent.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path) -> Path:
    """The `bin` of an environment with the wheel; its dependencies are those of the environment of the tests."""
    folder = wheel.parent / "environment"
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*pip, str(wheel)], check=True, capture_output=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    (packages / "dependencies.pth").write_text("".join(f"{path}\n" for path in site.getsitepackages()))
    return folder / "bin"


def run(installed: Path, folder: Path, *words: object) -> str:
    """Run a program of the environment in a folder; return what it printed."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    program, *arguments = map(str, words)
    done = subprocess.run(
        [str(installed / program), *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_wheel_carries_everything_that_skope_reads(source: Path, wheel: Path) -> None:
    """Every file under skope/ that git would hold is in the wheel."""
    packed = set(zipfile.ZipFile(wheel).namelist())
    files = (path.relative_to(source).as_posix() for path in (source / "skope").rglob("*") if path.is_file())
    sources = {name for name in files if "/source/" not in name and ".egg-info" not in name}
    assert sources <= packed
    assert any(name.endswith("town.net.xml") for name in sources)


def test_the_wheel_says_what_it_is(wheel: Path) -> None:
    archive = zipfile.ZipFile(wheel)
    (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    text = archive.read(name).decode()
    assert f"\nVersion: {skope.__version__}\n" in text
    assert "\nClassifier: Programming Language :: Python :: 3.11\n" in text
    assert "\nLicense-Expression: MIT\n" in text
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert set(re.findall(r"^Provides-Extra: (\S+)$", text, re.MULTILINE)) == declared.keys()


def test_the_version_is_that_of_changelog_and_citation() -> None:
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    version, date = re.findall(r"^## (\d+\.\d+\.\d+) - (\d{4}-\d\d-\d\d)$", changes, re.MULTILINE)[0]
    assert version == skope.__version__
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {version}\ndate-released: {date}\n" in citation


def test_an_installed_skope_works_outside_the_clone(installed: Path, tmp_path: Path) -> None:
    place = run(installed, tmp_path, "python", "-c", "import skope; print(skope.__file__)").strip()
    assert Path(place).is_relative_to(installed.parent)
    lines = run(installed, tmp_path, "skope", "doctor").splitlines()
    assert lines[1].startswith(f"ok  skope             {skope.__version__}, with its")
    assert not any(line.startswith("NOT") for line in lines)
    words = "--sites t01_main_west --frames 1 --size 96x54 --renderer pybullet --workers 1 --out made"
    run(installed, tmp_path, "skope", "gen", *words.split())
    assert len(list((tmp_path / "made" / "images").rglob("*.jpg"))) == 1


def test_the_page_of_an_installed_skope_answers(installed: Path, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [str(installed / "skope"), "eval", "site", str(ROOT / "docs" / "noon.jpg"), "--port", "0"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        text=True,
        # A program in the background of a shell ignores Ctrl-C, and so do those that it starts.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        assert process.stdout is not None
        (address,) = re.findall(r"http://[\d.]+:\d+/", process.stdout.readline())
        with urllib.request.urlopen(address) as answer:
            page = answer.read().decode()
        assert "<title>skope site</title>" in page
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=HANG_S) in (0, 130)
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_an_installed_skope_detects_vehicles(installed: Path, tmp_path: Path) -> None:
    shutil.copy(ROOT / "docs" / "noon.jpg", tmp_path)
    run(installed, tmp_path, "skope", "eval", "predict", "noon.jpg", "--out", "seen")
    assert (tmp_path / "seen" / "predictions.json").stat().st_size > 1000


def test_the_container_has_the_system_libraries_that_set_up_installs() -> None:
    setup = (ROOT / "scripts" / "setup.sh").read_text(encoding="utf-8")
    of_setup = set(re.findall(r"^lib\S+\.so\.\d+ (\S+)$", setup, re.MULTILINE)) | {"libgl1-mesa-dri"}
    (installed,) = re.findall(
        r"apt-get install [^&]*", (ROOT / "Containerfile").read_text(encoding="utf-8").replace("\\\n", " ")
    )
    assert {word for word in installed.split() if word.startswith("lib")} == of_setup


def test_the_container_s_extras_and_files_exist() -> None:
    container = (ROOT / "Containerfile").read_text(encoding="utf-8")
    (extras,) = re.findall(r'^ARG EXTRAS="(.*)"$', container, re.MULTILINE)
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert set(extras.split(",")) <= declared.keys()
    for line in re.findall(r"^COPY (.*) \S+$", container, re.MULTILINE):
        assert all((ROOT / name).exists() for name in line.split())
