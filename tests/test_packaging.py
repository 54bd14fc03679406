import subprocess
import sys
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
