import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).parent.parent


def test_the_wheel_carries_everything_that_skope_reads(tmp_path: Path) -> None:
    """Every file under skope/ that git would hold is in the wheel."""
    source = tmp_path / "source"
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(source)], check=True)
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path)]
    subprocess.run([*build, str(source)], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    packed = set(zipfile.ZipFile(wheel).namelist())
    tracked = subprocess.run(["git", "ls-files", "skope"], cwd=source, check=True, capture_output=True, text=True)
    sources = {name for name in tracked.stdout.split() if "/source/" not in name}
    assert sources <= packed
    assert any(name.endswith("town.net.xml") for name in sources)


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
