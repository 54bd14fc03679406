"""`skope train`: flags, defaults, and what it says."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from skope.errors import UserError
from skope.files.json_files import write_json
from skope.train import cli, configure, loop
from skope.train.recipe import SHIPPED_RECIPES
from skope.train.run_config import RunConfig
from tests import samples

NO_FLAGS: dict[str, Any] = {
    **dict.fromkeys(("recipe", "epochs", "init", "batch_size", "max_images", "min_size", "seed")),
    **dict.fromkeys(("supervise", "val_fraction", "mix", "backbone")),
    "set": (),
    "exclude_types": (),
    "categories": (),
}
TINY = replace(SHIPPED_RECIPES["scratch"], min_size=64, max_size=96, regions=8, keypoint_regions=1, val_fraction=0.0)


def new(**flags: Any) -> RunConfig:
    return configure.new((Path("data/skope"),), {**NO_FLAGS, **flags}, gpu=False, bfloat16=False)


def test_a_flag_of_zero_is_a_value() -> None:
    assert new().recipe.val_fraction > 0
    assert new(val_fraction=0.0).recipe.val_fraction == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--epochs", "0"], "--epochs: expected at least 1, got 0"),
        (["--batch-size", "-1"], "--batch-size: expected at least 1"),
        (["--max-images", "0"], "--max-images: expected at least 1"),
        (["--seed", "-1"], "--seed: expected a number from 0"),
        (["--recipe", "best"], "--recipe: 'best' is not one of auto, paper, laptop, scratch"),
        (["--init", "none"], "--init: 'none' is neither a file nor one of auto, coco, imagenet, random"),
        (["--device", "tpu"], "device: 'tpu' is not one of auto, cpu, cuda, cuda:N"),
        (["--categories", "car"], "--categories: 'car' is not one of vehicle, bicycle, motorcycle, pedestrian"),
        (["--categories", "pedestrian"], "--categories: expected vehicle among pedestrian"),
        (["--backbone", "vgg16"], "--backbone: 'vgg16' is not one of resnet50, resnet18, mobilenet_v3_large"),
        (["--set", "network.box_width=8"], "--set network.box_width: expected a whole number from 16 to 4096, got 8"),
        (["--set", "teacher.checkpoint=none_there"], "none_there: no such checkpoint or run folder"),
        (["--set", "teacher.sharpen=0"], "--set teacher.sharpen: expected 0.1 to 100, got 0"),
        (["--set", "teacher.boxes=-1"], "--set teacher.boxes: expected 0 to 1000, got -1"),
        (["--resume"], "no such run folder"),
        ([], "data/skope: no such dataset folder; `skope gen"),
    ],
)
def test_mistakes_are_one_line(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(cli.app, arguments)
    assert isinstance(result.exception, UserError)
    assert words in str(result.exception)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("small_network")
def test_trains_and_says_what_is_next(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config = replace(new(seed=4), recipe=replace(TINY, epochs=2))
    monkeypatch.setattr(configure, "new", lambda *_, **__: config)
    samples.make_dataset(Path("data/skope"), images=2, splits=("train", "hard"))
    result = CliRunner().invoke(cli.app, ["--device", "cpu"])
    assert result.exit_code == 0, result.output
    last = result.stdout.strip().splitlines()[-1]
    assert last == "wrote runs/skope/epoch_002.safetensors; next: skope eval --split hard"
    assert "2 images with 4 vehicles to learn from, none to validate on" in result.stdout
    assert "s a step: about" in result.stdout
    assert json.loads(Path("runs/skope/recipe.json").read_text())["seed"] == 4

    again = CliRunner().invoke(cli.app, ["--device", "cpu", "--quiet"])
    assert again.stdout.splitlines() == [last]
    for other, words in (
        (replace(config, seed=5), "seed = 4, now 5"),
        (replace(config, recipe=replace(TINY, epochs=3)), "epochs = 2, now 3"),
        (replace(config, data=("a", "b")), "datasets = 1, now 2"),
    ):
        monkeypatch.setattr(configure, "new", lambda *_, other=other, **__: other)
        refused = str(CliRunner().invoke(cli.app, ["--device", "cpu", "--quiet"]).exception)
        assert refused.startswith(f"runs/skope: holds another run: {words}. --resume continues it")
    done = CliRunner().invoke(cli.app, ["--device", "cpu", "--quiet", "--resume"])
    assert done.stdout.splitlines() == [last]
    other = CliRunner().invoke(cli.app, ["--device", "cpu", "--resume", "--batch-size", "2"])
    assert "--batch-size 2: the run in runs/skope has 1" in str(other.exception)


def test_an_interruption_says_how_to_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(loop, "train", interrupted)
    result = CliRunner().invoke(cli.app, ["--device", "cpu"])
    assert result.exit_code == 130
    assert "skope: stopped; nothing was saved yet" in result.stderr
    Path("runs/skope").mkdir(parents=True)
    Path("runs/skope/resume.pt").touch()
    config = new()
    monkeypatch.setattr(configure, "new", lambda *_, **__: config)
    write_json(Path("runs/skope/recipe.json"), replace(config, categories=("vehicle",)).to_dict())
    result = CliRunner().invoke(cli.app, ["--device", "cpu"])
    assert "skope: stopped; run the same command again to resume" in result.stderr


def test_flags_change_the_recipe() -> None:
    config = new(recipe="scratch", epochs=7, batch_size=3, min_size=180, seed=5, max_images=4)
    recipe = config.recipe
    assert (recipe.epochs, recipe.batch_size, recipe.min_size, recipe.max_size) == (7, 3, 180, 320)
    assert (config.seed, config.max_images, config.recipe.init) == (5, 4, "random")
    assert new().recipe == SHIPPED_RECIPES["laptop"]
    assert new().recipe.init == "auto"
    assert new(init="coco").recipe.init == "coco"
    narrow = new(backbone="resnet18", set=("network.pyramid_width=64",)).recipe.network
    assert narrow.asked == {"backbone": "resnet18", "pyramid_width": 64}
    taught = new(set=("teacher.checkpoint=road33", "teacher.boxes=0")).recipe.teacher
    assert (taught.checkpoint, taught.boxes, taught.keypoints) == ("road33", 0.0, 1.0)


def test_resuming_keeps_what_the_run_began_with(tmp_path: Path) -> None:
    recorded = new(recipe="scratch", epochs=7, seed=5, categories=("pedestrian", "vehicle"))
    assert recorded.categories == ("vehicle", "pedestrian")
    write_json(tmp_path / "recipe.json", recorded.to_dict())
    assert configure.again(tmp_path, (), NO_FLAGS) == recorded
    assert configure.again(tmp_path, (), {**NO_FLAGS, "recipe": "scratch", "seed": 5}) == recorded
    longer = configure.again(tmp_path, (Path("elsewhere"),), {**NO_FLAGS, "epochs": 9})
    assert longer == replace(recorded, data=("elsewhere",), recipe=replace(recorded.recipe, epochs=9))
    for flags in (
        *({"seed": 0}, {"recipe": "paper"}, {"min_size": 99}, {"init": "coco"}, {"max_images": 1}),
        *({"categories": ("vehicle",)}, {"backbone": "resnet18"}, {"set": ("network.box_width=64",)}),
    ):
        with pytest.raises(UserError, match=f"--{next(iter(flags)).replace('_', '-')} "):
            configure.again(tmp_path, (), {**NO_FLAGS, **flags})
    write_json(tmp_path / "recipe.json", replace(recorded, categories=("vehicle",)).to_dict())
    assert configure.again(tmp_path, (), {**NO_FLAGS, "categories": ("vehicle",)}).categories == ("vehicle",)
    write_json(tmp_path / "recipe.json", {**recorded.to_dict(), "recipe": {}})
    with pytest.raises(UserError, match=r"recipe.json: recipe.name: missing"):
        configure.again(tmp_path, (), NO_FLAGS)


def test_the_next_command_carries_what_differs_from_the_defaults() -> None:
    every = ("train", "easy", "medium", "hard", "extra")
    said = configure.next_command(Path("runs/b"), Path("d"), every, cli.RUN_FOLDER, cli.DATA_FOLDER)
    assert said == "skope eval --split hard --data d --checkpoint runs/b"


@pytest.mark.parametrize(
    ("splits", "option"),
    [(("easy", "medium", "train"), " --split medium"), (("train", "val", "own"), " --split own"), (("train",), "")],
)
def test_the_next_command_names_a_split_that_is_there(splits: tuple[str, ...], option: str) -> None:
    assert (
        configure.next_command(cli.RUN_FOLDER, cli.DATA_FOLDER, splits, cli.RUN_FOLDER, cli.DATA_FOLDER)
        == f"skope eval{option}"
    )


def test_importing_the_command_line_does_not_import_torch() -> None:
    code = "import sys, skope.train.cli; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
