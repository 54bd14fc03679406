"""Checkpoints and exports where they cannot be written, and whom they can be read by."""

import resource
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from skope.detector.build import DetectorConfig, build
from skope.detector.checkpoint import checkpoint_name, save_weights
from skope.errors import UserError
from skope.terminal.console import Console
from skope.train.export import EXPORT_SUFFIXES, export
from tests.detector.test_detector import SMALL
from tests.train.conftest import shrink

pytestmark = pytest.mark.usefixtures("small_network")

CONFIG = DetectorConfig(norm="frozen", norm_eps=1e-5, **SMALL)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / checkpoint_name(1)
    torch.manual_seed(0)
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        save_weights(path, build(CONFIG), CONFIG, {})
    return path


def test_a_checkpoint_is_for_everybody_whom_the_umask_lets(checkpoint: Path, tmp_path: Path) -> None:
    other = tmp_path / "plain"
    other.touch()
    assert stat.S_IMODE(checkpoint.stat().st_mode) == stat.S_IMODE(other.stat().st_mode)


def little_room() -> None:
    """Let this process write no file of more than a megabyte, as on a full disk."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))


@pytest.mark.parametrize(
    ("to", "out"),
    [
        ("compact", "full/a.bin"),
        pytest.param("torchscript", "full/a.bin", marks=pytest.mark.slow),
        pytest.param("compact", "/proc/a.bin", marks=pytest.mark.slow),
    ],
)
def test_an_export_without_room_leaves_nothing(to: str, out: str, checkpoint: Path, tmp_path: Path) -> None:
    path = tmp_path / out
    command = [sys.executable, "-m", "tests.train.small_skope", "train", "export", str(checkpoint)]
    command += ["--to", to, "--out", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=little_room)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith(f"skope: {path}: cannot be written: ")
    assert done.stderr.count("\n") == 1
    assert not any((tmp_path / "full").glob("*"))


@pytest.mark.parametrize(
    "to", ["compact", *(pytest.param(to, marks=pytest.mark.slow) for to in EXPORT_SUFFIXES if to != "compact")]
)
def test_an_export_is_made_again_and_overwrites_nothing_else(to: str, checkpoint: Path, tmp_path: Path) -> None:
    console, path = Console(quiet=True), tmp_path / "a"
    export(checkpoint, to, path, console=console)
    before = path.read_bytes(), path.stat().st_mtime_ns
    export(checkpoint, to, path, console=console)
    assert (path.read_bytes(), path.stat().st_mtime_ns) == before
    path.write_bytes(b"mine")
    with pytest.raises(UserError, match="exists with other content"):
        export(checkpoint, to, path, console=console)
    assert path.read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("file", "exists with other content"),
        ("folder", "is a folder; choose another file"),
        ("below", "cannot be written: .*file is a file"),
    ],
)
@pytest.mark.parametrize("to", EXPORT_SUFFIXES)
def test_an_export_looks_at_its_target_first(
    to: str, kind: str, said: str, checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("skope.train.export.load_weights", lambda *_: pytest.fail("work was done before"))
    monkeypatch.setattr("importlib.util.find_spec", lambda _: True)
    (tmp_path / "file").write_bytes(b"some text of mine")
    (tmp_path / "folder").mkdir()
    with pytest.raises(UserError, match=said):
        export(checkpoint, to, tmp_path / {"below": "file/x"}.get(kind, kind), console=Console(quiet=True))


def test_a_state_without_room_is_one_line(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path\n"
        "from tests.train.test_run_folder import little_room, state\n"
        "from skope.errors import UserError; from skope.train import training_state\n"
        "training = state(); little_room()\n"
        "try: training_state.save_state(Path(sys.argv[1]), training)\n"
        "except UserError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.stdout.startswith(f"{tmp_path / 'resume.pt'}: cannot be written: "), done.stderr
    assert not any(tmp_path.iterdir())


def state() -> object:
    """As much of a training as a saved state has."""
    from skope.train.optimizer import make_sgd
    from skope.train.recipe import SHIPPED_RECIPES
    from skope.train.training_state import TrainingState

    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        model = build(CONFIG)
    return TrainingState(
        model, CONFIG, make_sgd(model, SHIPPED_RECIPES["paper"]), "random weights", [], 0, 0, {}, [], None
    )
