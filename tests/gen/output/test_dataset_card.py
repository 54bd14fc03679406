"""The card of a dataset: what README.md says in words, and croissant.json to programs."""

import hashlib
import json
import shlex
import struct
from collections import Counter
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from skope.cli import app
from skope.dataset import coco
from skope.errors import UserError
from skope.files.json_files import read_json, write_json
from skope.gen.labels.ignore_rules import Rules
from skope.gen.output import card_text, dataset_card, licences
from skope.gen.output.croissant import croissant
from skope.gen.output.frames import Encoding
from skope.gen.output.parameters import DatasetPlan, Parameters
from skope.gen.output.writers import Counts, count_kind
from skope.gen.pipeline.config import from_preset
from skope.gen.render.choose_renderer import choose_renderer
from skope.gen.vehicles.fleet import fleet
from skope.page.templates import piece
from tests.samples import make_dataset


def parameters(**changes: Any) -> Parameters:
    return from_preset("demo", seed=3, renderer="gl", driver="a driver", rules=Rules(), frames=2, **changes).parameters


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A folder with two splits, made by hand, whose manifest names every file, and its card."""
    make_dataset(tmp_path)
    (tmp_path / "dataset.json").unlink()
    for path in ("recordings/a_00.npz", "depth/site/00_000001.png"):
        (tmp_path / path).parent.mkdir(parents=True)
        (tmp_path / path).write_bytes(struct.pack(">d", 1.0))
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    sums = {str(path.relative_to(tmp_path)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
    write_json(tmp_path / "manifest.json", {"sha256": sums, "tallies": {}})
    dataset_card.write_card(tmp_path, content())
    return tmp_path


def content(**changes: Any) -> dict[str, Any]:
    counts = Counts()
    counts.images = 4
    counts.by["split"] = {"train": Counter(images=2, ground_truth=3, ignored=1), "easy": Counter(images=2)}
    counts.by["vehicle_type"] = {"sedan": Counter(ground_truth=1), "van": Counter(ground_truth=2)}
    counts.tally.update(vehicles=4, occluded_others=1, occluded_paper=2)
    counts.apart_m, counts.most_apart_m = [0.003, 0.001], 0.3
    return dataset_card.card(DatasetPlan(parameters(**changes), ()), counts)


def test_types_and_models_that_drive_when_asked_for_are_named_where_they_do() -> None:
    usual, asked = content(), content(sites=("t01_school_lane",), vehicles={"articulated_tank": ""}, vehicle_share=0.1)
    assert not [name for name in usual["fleet"]["held_out"] if fleet()[name].further]
    assert set(asked["fleet"]["held_out"]) - set(usual["fleet"]["held_out"]) == {"articulated_tank"}
    assert set(asked["fleet"]["substituted"]) - set(usual["fleet"]["substituted"]) == {"articulated_tank"}
    asked["counts"]["by_vehicle_type"]["articulated_truck"] = {"ground_truth": 1, "ignored": 0}
    assert "articulated" not in json.dumps(croissant(usual, {}))
    assert "truck, articulated_truck, other." in json.dumps(croissant(asked, {}))


def test_the_readme_says_what_a_user_must_know(root: Path) -> None:
    text = (root / "README.md").read_text(encoding="utf-8")
    titles = [line.removeprefix("## ") for line in text.splitlines() if line.startswith("## ")]
    assert titles == [
        *(
            "What it is for",
            "How to read it",
            "How it was made",
            "What the labels mean",
            "Balance",
            "Limits",
            "People",
            "Licence",
        ),
    ]
    assert "Not validated for safety or enforcement" in text
    assert "v = 1: inside the image but hidden" in text
    assert "The occlusion rule `others` applies to 1 of 4 vehicles, the rule `paper` to 2." in text
    assert "| van | 2 | 0 | 66.7% |\n| sedan | 1 | 0 | 33.3% |" in text
    assert "CC BY 4.0 (https://creativecommons.org/licenses/by/4.0/)" in text
    assert "seed 3" in text


def programs(card: dict[str, Any]) -> list[str]:
    return [block.command for block in card_text.reading(card) if isinstance(block, card_text.Command)]


def test_the_first_program_of_the_readme_reads_the_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_dataset(tmp_path / "data", images=2, splits=("train", "easy"))
    card = json.loads((tmp_path / "data" / "dataset.json").read_text())
    counts = {"by_split": {"easy": {"images": 2}, "train": {"images": 2}}}
    monkeypatch.chdir(tmp_path / "data")
    values: dict[str, Any] = {}
    exec(programs({**card, "counts": counts})[0], values)
    assert len(values["train"]) == 2
    assert values["labels"][0]["keypoints"]
    assert "easy" in programs({**card, "counts": {"by_split": {"easy": {}}}})[0]


def test_the_readme_of_shards_reads_shards() -> None:
    card = {**content(), "format": "shards"}
    card["counts"]["by_split"] = {"easy": {"images": 1, "ground_truth": 1, "ignored": 0}}
    (program,) = programs(card)
    assert 'data_files={"easy": "shards/easy-*.tar"}, split="easy"' in program


@pytest.mark.parametrize(
    ("licence", "images", "name", "size"),
    [
        ("CC BY 4.0", 999, "cc-by-4.0", "n<1K"),
        ("ODbL 1.0", 1000, "odbl", "1K<n<10K"),
        ("mine", 25_004, "other", "10K<n<100K"),
    ],
)
def test_the_readme_begins_with_what_a_hub_reads(licence: str, images: int, name: str, size: str) -> None:
    card = content()
    card["licence"], card["counts"]["images"] = licence, images
    lines = card_text.markdown(card).splitlines()
    assert lines[0] == lines[5] == "---"
    assert lines[1] == f"license: {name}"
    assert lines[4] == f"size_categories: [{size}]"


def test_the_readme_says_what_was_asked_for_of_light_and_traffic() -> None:
    said = card_text.markdown(
        content(weather=("rain", "fog"), time_of_day=("night",), vehicles={"suv": ""}, vehicle_share=0.2)
    )
    assert "The weather is always rain or fog, as requested." in said
    assert "The time of day is always night, as requested." in said
    assert "20% of the traffic is of the requested models: suv." in said
    assert "requested" not in card_text.markdown(content())


def test_the_card_of_another_tool_says_what_it_knows() -> None:
    known = {"version": 1, "keypoint_scheme": "skope33", "licence": "mine"}
    text = card_text.markdown(known)
    assert "## Licence\n\nmine" in text
    assert "Not validated for safety or enforcement" in text
    assert "## How it was made" not in text
    assert "## People" not in text
    part = {"name": "west", "licence": "CC0 1.0", "command": "skope gen --seed 4"}
    assert "- west (CC0 1.0): `skope gen --seed 4`" in card_text.markdown({**known, "sources": [part]})


def test_a_table_cell_cannot_break_out() -> None:
    broken = {**content(), "counts": {"by_site": {"a|b": {"images": 1, "ground_truth": 2, "ignored": 0}}}}
    assert "| a/b | 1 | 2 | 0 | 100.0% |" in card_text.markdown(broken)
    for section in card_text.sections({**broken, "label_rules": ["<i>"]}):
        for block in section.blocks:
            assert "<i>" not in piece("block", block)


# -------------------------------------------------------------------------------------------------------------- licence


@pytest.mark.parametrize(
    ("given", "stated"),
    [
        ("cc by-sa 4.0", "CC BY-SA 4.0"),
        ("CC-BY-NC-SA-4.0", "CC BY-NC-SA 4.0"),
        ("cc0 1.0", "CC0 1.0"),
        ("All rights reserved\n by us ", "All rights reserved by us"),
    ],
)
def test_a_licence_has_one_name(given: str, stated: str) -> None:
    assert licences.named(given) == stated
    assert content(licence=licences.named(given))["licence"] == stated


def test_a_licence_without_a_name_is_refused() -> None:
    with pytest.raises(UserError, match="--licence: expected the name of a licence"):
        licences.named("  ")
    result = CliRunner().invoke(app, ["gen", "--licence", "", "--out", "never"])
    assert "--licence" in str(result.exception)


def test_the_command_in_the_card_repeats_the_licence() -> None:
    assert "--licence" not in content()["command"]
    words = shlex.split(content(licence="our terms; see LICENCE")["command"])
    assert words[words.index("--licence") + 1] == "our terms; see LICENCE"


def test_the_card_lists_further_models_where_they_may_be_seen() -> None:
    plain, more = content()["fleet"], content(further_models=True)["fleet"]
    assert "truck_tanker" in set(more["held_out"]) - set(plain["held_out"])
    assert "truck_mixer" in more["substituted"].keys() - plain["substituted"].keys()
    assert set(plain["held_out"]) < set(more["held_out"])
    asked = content(vehicles={"truck_mixer": ""}, vehicle_share=0.2)["fleet"]
    assert asked["substituted"].keys() - plain["substituted"].keys() == {"truck_mixer"}


@pytest.mark.parametrize(
    "changes",
    [
        {"preset": "demo"},
        {"preset": "demo", "views": 2, "town_jitter": True, "shape_jitter": True, "camera_jitter": True},
        {"preset": "demo", "recordings": 4},
        {"preset": "varied", "format": "shards", "settings": {"noise": (1.0, 2.0)}},
        {"preset": "world"},
        {"preset": "nights"},
        {"preset": "world", "views": 0, "town_jitter": False, "shape_jitter": False},
        {"preset": "demo", "weather": ("rain", "fog"), "time_of_day": ("night",)},
        {"preset": "demo", "vehicles": {"suv": "", "pickup": ""}, "vehicle_share": 0.25},
        {"preset": "world", "views": 2, "encoding": Encoding(image="png", depth=False)},
    ],
    ids=str,
)
def test_the_command_in_the_card_asks_for_the_same(changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(
        "skope.gen.pipeline.generate.generate_dataset", lambda request, *_: asked.append(request.parameters)
    )
    _, driver, _ = choose_renderer("pybullet")
    made = from_preset(
        **{"seed": 3, "renderer": "pybullet", "driver": driver, "rules": Rules(), "frames": 24, **changes}
    )
    words = shlex.split(dataset_card.command(made.parameters))
    result = CliRunner().invoke(app, [*words[1:], "--quiet"], catch_exceptions=False)
    assert result.exit_code == 0
    assert asked == [made.parameters]


# ------------------------------------------------------------------------------------------------------------ croissant


def test_croissant_describes_every_file(root: Path) -> None:
    document = read_json(root / "croissant.json")
    sums = read_json(root / "manifest.json")["sha256"]
    patterns = []
    for entry in document["distribution"]:
        assert entry["@id"] == entry["name"]
        if entry["@type"] == "cr:FileObject":
            data = (root / entry["contentUrl"]).read_bytes()
            assert hashlib.sha256(data).hexdigest() == entry["sha256"]
        else:
            patterns.append(entry["includes"])
            found = [path for path in root.glob(entry["includes"]) if path.is_file()]
            assert found, entry["includes"]
    assert all(any(fnmatch(path, pattern) for pattern in patterns) for path in sums)
    sets = document["recordSet"]
    ids = [entry["@id"] for entry in (*document["distribution"], *sets, *(f for s in sets for f in s["field"]))]
    assert len(set(ids)) == len(ids)


def test_croissants_fields_are_rows_of_the_annotation_files(root: Path) -> None:
    document = read_json(root / "croissant.json")
    files = {entry["@id"]: entry for entry in document["distribution"]}
    rows = {path.stem: read_json(path) for path in (root / "annotations").glob("*.json")}
    for record_set in document["recordSet"]:
        assert record_set["key"]["@id"] in {field["@id"] for field in record_set["field"]}
        for field in record_set["field"]:
            source = field["source"]
            assert files[source["fileSet"]["@id"]]["includes"] == "annotations/*.json"
            _, list_, name = source["extract"]["jsonPath"].split(".")
            for annotations in rows.values():
                assert all(name in row for row in annotations[list_.removesuffix("[*]")])


def test_croissant_says_what_the_card_says(root: Path) -> None:
    document = read_json(root / "croissant.json")
    assert document["conformsTo"][0] == "http://mlcommons.org/croissant/1.0"
    assert document["license"] == "https://creativecommons.org/licenses/by/4.0/"
    assert document["rai:dataLimitations"] == card_text.limits(read_json(root / "dataset.json"))
    assert document["@context"]["rai"] == "http://mlcommons.org/croissant/RAI/"


def test_croissant_of_shards_names_each_archive() -> None:
    sums = {"shards/train-000000.tar": "ab", "shards/train-000000.json": "cd", "recordings/a.npz": "ef"}
    document = croissant({**content(), "format": "shards"}, sums)
    objects = [entry for entry in document["distribution"] if entry["@type"] == "cr:FileObject"]
    assert [(entry["contentUrl"], entry["sha256"]) for entry in objects] == [("shards/train-000000.tar", "ab")]
    assert "recordSet" not in document


def test_what_is_known_of_an_image_is_counted(tmp_path: Path) -> None:
    file = coco.read(make_dataset(tmp_path) / "annotations/easy.json")
    counts = Counts()
    for image in file.images:
        kinds = [count_kind(a.iscrowd, a.vehicle_type) for a in file.by_image()[image.id]]
        counts.add({"split": "easy", "site": None, "weather": image.weather}, kinds, {"ignored": {}})
    said = counts.to_dict()
    assert said["by_weather"] == {"clear": {"images": 2, "ground_truth": 4, "ignored": 0}}
    assert said["by_site"] == {}
    assert said["by_vehicle_type"] == {"sedan": {"ground_truth": 4, "ignored": 0}}
