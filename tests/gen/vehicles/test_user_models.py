"""From a model file with markers to a vehicle that drives in generated scenes."""

import re
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from skope.cli import app
from skope.dataset.folder import open_dataset
from skope.errors import UserError
from skope.files.json_files import read_json, write_json
from skope.gen.inspect.check import check
from skope.gen.vehicles import user_models
from skope.gen.vehicles.fleet import build_vehicle, fleet
from skope.gen.vehicles.marked_models import read_marked
from skope.gen.vehicles.paints import color_name
from skope.gen.vehicles.user_models import model_names
from tests.gen.vehicles.test_marked_models import nodes, renamed, swapped, without, written

ROOT = Path(__file__).parents[3]


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SKOPE_VEHICLES", str(tmp_path / "vehicles"))
    user_models.load_model.cache_clear()
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
    assert model_names() == ["my_car"]
    assert sorted(path.name for path in (own_folder / "my_car").iterdir()) == ["mesh.npz", "vehicle.json"]
    vehicle = build_vehicle("my_car", {})
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
    assert dataset.card["parameters"]["vehicles"] == {"my_car": user_models.load_model("my_car").digest}
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
        (["--name=-x"], "--name -x: expected letters"),
        (["--name", "x" * 300], "--name: expected a name of up to 100 bytes"),
        (["--type", "spaceship"], "--type: 'spaceship' is not one of"),
        (["--scale", "0"], "--scale: expected a positive number"),
        (["--scale", "inf"], "--scale: expected a positive number"),
        (["--mass", "1e300"], "--mass: expected kilograms from 1 to 1e+06, got 1e+300"),
        (["--mass", "nan"], "--mass: expected kilograms from 1 to 1e+06, got nan"),
        (["--wheels", "front_right"], "--wheels: expected CORNER=OBJECT"),
    ],
)
def test_bad_flags_are_refused(tmp_path: Path, flags: list[str], said: str) -> None:
    code, text = run("vehicles", "add", str(written(tmp_path / "car.glb", nodes())), *flags)
    assert code != 0
    assert said in text


def test_unknown_and_damaged_models_are_refused(own_folder: Path) -> None:
    with pytest.raises(UserError, match="--vehicles: there is no model 'nothing'; `skope gen vehicles list` names all"):
        user_models.load_model("nothing")
    (own_folder / "broken").mkdir(parents=True)
    (own_folder / "broken" / "vehicle.json").write_text('{"version": 1}')
    with pytest.raises(UserError, match="broken: not a readable vehicle"):
        user_models.load_model("broken")


def test_a_removed_model_is_gone_and_the_others_stay(car: Path, own_folder: Path, tmp_path: Path) -> None:
    code, text = run("vehicles", "add", str(written(tmp_path / "other.glb", nodes())))
    assert code == 0, text
    assert user_models.load_model("car").model == "car"
    assert run("vehicles", "remove", "car") == (0, f"removed {own_folder / 'car'}\n")
    assert model_names() == ["other"]
    assert not car.parent.exists()
    with pytest.raises(UserError, match="there is no model 'car'"):
        user_models.load_model("car")
    # The name is free, for another model too.
    code, text = run("vehicles", "add", str(written(tmp_path / "car.glb", nodes())), "--mass", "900")
    assert code == 0, text
    assert user_models.load_model("car").mass == 900


def test_a_damaged_model_can_be_removed_and_other_files_are_left(car: Path) -> None:
    car.write_text("{")
    (car.parent / "thesis.txt").write_text("mine")
    code, text = run("vehicles", "remove", "car")
    assert code == 0, text
    assert [path.name for path in car.parent.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("sedan", "sedan: is a model of the fleet, which stays"),
        ("lorry", "lorry: no such model was added; there are: car"),
        ("../vehicles/car", "../vehicles/car: no such model was added"),
        ("", ": no such model was added"),
    ],
)
def test_what_is_no_added_model_is_not_removed(car: Path, name: str, said: str) -> None:
    before = {path: path.read_bytes() for path in car.parent.iterdir()}
    code, text = run("vehicles", "remove", name)
    assert code != 0
    assert text.startswith(said)
    assert {path: path.read_bytes() for path in car.parent.iterdir()} == before


@pytest.fixture
def car(tmp_path: Path, own_folder: Path) -> Path:
    """The vehicle.json of a model that was added."""
    code, text = run("vehicles", "add", str(written(tmp_path / "car.glb", nodes())))
    assert code == 0, text
    return own_folder / "car" / "vehicle.json"


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("version", 99, r"vehicle\.json: version: expected 1, got 99"),
        ("version", [1], r"vehicle\.json: version: expected 1, got \[1\]"),
        ("keypoints", [[0.0, 0.0, 0.0]] * 5, "keypoints: expected 33 x 3 numbers, got 15"),
        ("vehicle_type", "spaceship", "vehicle_type: 'spaceship' is not one of"),
        ("mass", 1e300, r"mass: expected kilograms from 1 to 1e\+06, got 1e\+300"),
        ("mass", "heavy", "mass: expected kilograms"),
        ("shape", {"length": 1}, "not a readable vehicle"),
        ("materials", {"mesh": [], "wheel": []}, "materials that are not there"),
    ],
)
def test_a_changed_model_is_named_and_the_others_are_listed(car: Path, field: str, value: object, said: str) -> None:
    write_json(car, {**read_json(car), field: value})
    with pytest.raises(UserError, match=f"{car.parent}.*{said}"):
        user_models.load_model("car")
    code, text = run("vehicles", "list")
    assert code != 0
    assert text.startswith("model ")
    assert [line.split()[0] for line in text.splitlines()[1:-1]] == list(fleet())
    assert re.search(f"{car.parent}.*{said}", text.splitlines()[-1])
    code, text = run("vehicles", "check", "car")
    assert code == 1
    assert text.endswith("1 model, 1 findings\n")


@pytest.mark.parametrize(
    ("material", "color"),
    [
        *(("#f4f4f0", "white"), ("#202124", "black"), ("#777777", "grey"), ("#b4b8bb", "silver"), ("#b01818", "red")),
        *(
            ("#2a4f9e", "blue"),
            ("#1f6b34", "green"),
            ("#5a3c28", "brown"),
            ("#e0b020", "yellow"),
            ("#e06a10", "orange"),
        ),
        *(("#6a3080", "purple"), ("#ff00ff", "other"), ("headlight", "other")),
    ],
)
def test_labels_name_the_colour_that_most_of_a_model_has(car: Path, material: str, color: str) -> None:
    vehicle = user_models.load_model(car.parent.name)
    mesh = replace(vehicle.mesh, materials=("#00ff00", material), material=np.ones_like(vehicle.mesh.material))
    mesh.material[0] = 0
    assert color_name(replace(vehicle, mesh=mesh), "white") == color


# -------------------------------------------------------------------------------------------------------- the example


@pytest.mark.slow
def test_the_example_drives_as_the_guide_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    guide = (ROOT / "docs" / "vehicles.md").read_text(encoding="utf-8")
    add, make = re.findall(r"^ {4}skope gen (.*courier[ .].*)$", guide, re.MULTILINE)
    monkeypatch.chdir(ROOT)
    code, text = run(*add.split())
    assert code == 0, text
    assert run("vehicles", "check", "courier")[1].endswith("1 model, no findings\n")
    size = ["--size", "192x108", "--workers", "1", "--quiet"]
    code, text = run(*make.split(), *size, "--out", str(tmp_path / "data"))
    assert code == 0, text
    dataset = open_dataset(tmp_path / "data")
    assert list(check(dataset)) == []
    file = dataset.read("train")
    assert {(image.weather, image.camera.width) for image in file.images} == {("rain", 192)}
    models = [annotation.model for annotation in file.annotations]
    assert 0.1 < models.count("courier") / len(models) < 0.9
    # It is teal wherever it drives; paints are for the fleet.
    assert {annotation.color for annotation in file.annotations if annotation.model == "courier"} == {"green"}
    # What is there stays as it is without the model, and can be checked.
    run("vehicles", "remove", "courier")
    assert list(check(dataset)) == []


def test_the_example_is_what_its_script_makes(tmp_path: Path) -> None:
    folder = ROOT / "examples" / "own_vehicle"
    made = tmp_path / "courier.glb"
    runpy.run_path(str(folder / "make_files.py"))["write"](made)
    assert (folder / made.name).stat().st_size < 200_000
    kept, again = read_marked(folder / made.name), read_marked(made)
    np.testing.assert_array_equal(kept.points, again.points)
    np.testing.assert_array_equal(kept.mesh.vertices, again.mesh.vertices)
    assert kept.mesh.materials == again.mesh.materials
