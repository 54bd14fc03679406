"""From a model file with markers to a vehicle that drives in generated scenes."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from skope.cli import app
from skope.dataset import open_dataset
from skope.errors import UserError
from skope.gen.check import check
from skope.gen.vehicles import added, build
from skope.gen.vehicles.added import names
from tests.gen.test_markers import nodes, renamed, swapped, without, written


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SKOPE_VEHICLES", str(tmp_path / "vehicles"))
    added.load.cache_clear()
    return tmp_path / "vehicles"


def run(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["gen", *arguments])
    error = "" if isinstance(result.exception, SystemExit | None) else f"{result.exception}"
    return result.exit_code, result.output + error


def test_an_added_model_drives(tmp_path: Path, own_folder: Path) -> None:
    path = written(tmp_path / "my_car.glb", nodes())
    code, text = run("vehicles", "add", str(path), "--mass", "1500")
    assert code == 0, text
    assert "note: parts: no brake lamps" in text
    assert names() == ["my_car"]
    assert sorted(path.name for path in (own_folder / "my_car").iterdir()) == ["mesh.npz", "vehicle.json"]
    vehicle = build("my_car", {})
    assert vehicle.vehicle_type == "other"
    assert vehicle.mass == 1500

    out = tmp_path / "data"
    flags = ["--sites", "t01_main_west", "--frames", "4", "--size", "320x180", "--workers", "1", "--seed", "2"]
    code, text = run("--out", str(out), "--vehicles", "my_car", *flags)
    assert code == 0, text
    dataset = open_dataset(out)
    assert list(check(dataset)) == []
    models = [annotation.model for annotation in dataset.read("medium").annotations]
    assert "my_car" in models
    assert dataset.card["parameters"]["vehicles"] == {"my_car": added.load("my_car").digest}
    assert "--vehicles my_car" in dataset.card["command"]


def test_another_model_of_the_same_name_is_refused(tmp_path: Path, own_folder: Path) -> None:
    path = written(tmp_path / "car.glb", nodes())
    for _ in range(2):  # the same one is added again
        code, text = run("vehicles", "add", str(path), "--mass", "1500")
        assert code == 0, text
    before = {file.name: file.read_bytes() for file in (own_folder / "car").iterdir()}
    code, text = run("vehicles", "add", str(path), "--mass", "1600")
    assert code != 0
    assert f"{own_folder / 'car'}: another model of that name was added already" in text
    assert {file.name: file.read_bytes() for file in (own_folder / "car").iterdir()} == before


def test_what_is_wrong_is_said_and_nothing_is_added(tmp_path: Path, own_folder: Path) -> None:
    for change, said in (
        (without("kp_24"), "no marker for hood_front_right"),
        (swapped, "left and right are swapped"),
        (renamed("kp_24", "kp_77"), "marker kp_77"),
    ):
        code, text = run("vehicles", "add", str(written(tmp_path / "car.glb", change(nodes()))))
        assert code != 0
        assert said in text
    parts = nodes()
    parts["kp_24"].vertices[:] += np.array([0.0, 0.0, 0.1])
    code, text = run("vehicles", "add", str(written(tmp_path / "car.glb", parts)))
    assert code != 0
    assert "hood_front_right is" in text
    assert "cm off the surface" in text
    pair = nodes()
    pair["kp_28"], pair["kp_29"] = pair["kp_29"], pair["kp_28"]
    code, text = run("vehicles", "add", str(written(tmp_path / "car.glb", pair)))
    assert code != 0
    assert "mirror_right is on the left" in text
    assert not own_folder.exists()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--name", "sedan"], "--name sedan: expected letters"),
        (["--name", "../x"], "--name ../x: expected letters"),
        (["--type", "spaceship"], "--type: 'spaceship' is not one of"),
        (["--scale", "0"], "expected positive numbers"),
        (["--wheels", "front_right"], "--wheels: expected CORNER=OBJECT"),
    ],
)
def test_bad_flags_are_refused(tmp_path: Path, flags: list[str], said: str) -> None:
    code, text = run("vehicles", "add", str(written(tmp_path / "car.glb", nodes())), *flags)
    assert code != 0
    assert said in text


def test_unknown_and_damaged_models_are_refused(own_folder: Path) -> None:
    with pytest.raises(UserError, match="--vehicles: no model 'nothing' was added; there are: none yet"):
        added.load("nothing")
    (own_folder / "broken").mkdir(parents=True)
    (own_folder / "broken" / "vehicle.json").write_text("{}")
    with pytest.raises(UserError, match="broken: not a readable vehicle"):
        added.load("broken")
