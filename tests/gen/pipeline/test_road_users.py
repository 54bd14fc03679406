"""Datasets that label people on foot and on two wheels, from simulation to card, and those that do not."""

import json
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skope import schema
from skope.dataset.folder import open_dataset
from skope.errors import UserError
from skope.gen.inspect.check import check
from skope.gen.inspect.diff import differences
from skope.gen.labels.ignore_rules import Rules
from skope.gen.output import card_text
from skope.gen.pipeline.config import from_preset, presets
from skope.gen.scene import recording as recordings
from skope.gen.simulation.simulate import simulate
from skope.gen.towns.town import Town
from skope.gen.traffic.demand import USUAL_RIDERS, Riding, trips
from skope.gen.vehicles.fleet import fleet
from skope.schema import AnnotationFile
from tests.gen.small import content

SITES = "t01_mill_corner,t03_circle_mast"


def command(out: Path, *more: str) -> list[str]:
    flags = ["--sites", SITES, "--frames", "4", "--size", "480x270", "--fov", "70", "--seed", "3", "--road-users"]
    return [sys.executable, "-m", "skope", "gen", "--out", str(out), "--quiet", *flags, *more]


def skope(*words: str) -> str:
    """What a command of `skope gen` prints."""
    done = subprocess.run([sys.executable, "-m", "skope", "gen", *words], check=True, capture_output=True, text=True)
    return done.stdout


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("road_users") / "made"
    subprocess.run(command(out, "--workers", "1"), check=True, capture_output=True)
    return out


def train(root: Path) -> AnnotationFile:
    return open_dataset(root).read("train")


def test_a_dataset_with_people_is_whole(made: Path) -> None:
    dataset = open_dataset(made)
    file = dataset.read("train")
    assert dataset.categories == file.categories == schema.CATEGORY_NAMES
    assert list(check(dataset)) == []
    assert len(file.road_users) > 5
    counted = Counter((user.category, "ignored" if user.ignored else "ground_truth") for user in file.road_users)
    told = dataset.card["counts"]
    assert {(name, kind): n for name, row in told["by_category"].items() for kind, n in row.items() if n} == counted
    assert told["ground_truth"] == sum(not vehicle.ignored for vehicle in file.annotations)
    assert any("categories of their own" in rule for rule in dataset.card["label_rules"])
    assert "--road-users" in dataset.card["command"]
    assert "category_id" in (made / "croissant.json").read_text()
    assert "pedestrians" in card_text.card_summary(dataset.card)
    assert "| pedestrian | " in (made / "README.md").read_text()
    assert "have no labels; of a truck" not in (made / "README.md").read_text()
    (site, *_), rows = ({image.site for image in file.images}, [*file.annotations, *file.road_users])
    assert site
    assert len({row.id for row in rows}) == len(rows)
    places = {image.id: image.site for image in file.images}
    vehicles = {(places[a.image_id], a.track_id) for a in file.annotations}
    assert not vehicles & {(places[user.image_id], user.track_id) for user in file.road_users}
    # The images of a dataset have both.
    assert sum(len(image.road_users) for image in dataset) == len(file.road_users)


def test_tracks_keep_their_category_and_move(made: Path) -> None:
    file = train(made)
    places = {image.id: (image.site, image.time_s) for image in file.images}
    kinds: dict[object, set[str]] = {}
    for user in file.road_users:
        kinds.setdefault((places[user.image_id][0], user.track_id), set()).add(user.category)
    assert all(len(names) == 1 for names in kinds.values())
    assert len(kinds) > 4


@pytest.mark.slow
def test_workers_and_shards_make_the_same(made: Path, tmp_path: Path) -> None:
    subprocess.run(command(tmp_path / "two", "--workers", "2"), check=True, capture_output=True)
    assert content(tmp_path / "two") == content(made)
    skope("convert", str(made), str(tmp_path / "shards"), "--to", "shards", "--quiet")
    skope("convert", str(tmp_path / "shards"), str(tmp_path / "back"), "--to", "folder", "--quiet")
    assert content(tmp_path / "back") == content(made)
    sharded = open_dataset(tmp_path / "shards")
    assert [user.bbox.tolist() for user in sharded.read("train").road_users] == [
        user.bbox.tolist() for user in train(made).road_users
    ]
    assert list(check(sharded)) == []
    only = [line for line in differences(open_dataset(made), sharded) if not line.startswith(("formats", "parameters"))]
    assert only == []


def test_a_broken_frame_is_made_again(made: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(made, tmp_path / "copy"))
    image = train(root).images[1]
    (root / image.file_name).unlink()
    skope("check", str(root), "--repair", "--workers", "1")
    assert content(root) == content(made)


def spoilt(root: Path, row_of: int, **changes: object) -> None:
    path = root / "annotations" / "train.json"
    document = json.loads(path.read_text())
    rows = [row for row in document["annotations"] if row["category_id"] == row_of]
    rows[0].update(changes)
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"bbox": [470, 10, 40, 40]}, "bbox: extends outside the image"),
        ({"area": 1}, "segmentation: "),
        ({"num_keypoints": 3}, "num_keypoints: is 3, 0 are labelled"),
        ({"distance": 3.0}, "distance: 3.00 m, but the box's centre is "),
        ({"iscrowd": 1, "ignore_reason": None}, "ignore_reason: missing on an ignored pedestrian"),
        ({"category_id": 2}, "counts.by_category."),
        ({"id": 1}, "id 1 stands twice"),
    ],
)
def test_what_is_wrong_with_a_label_is_found(made: Path, tmp_path: Path, changes: dict[str, object], said: str) -> None:
    root = Path(shutil.copytree(made, tmp_path / "copy"))
    spoilt(root, 4, **changes)
    assert any(said in str(finding) for finding in check(open_dataset(root)))


def test_a_mask_at_another_depth_is_found(made: Path, tmp_path: Path) -> None:
    """As when a label has somebody else's mask."""
    root = Path(shutil.copytree(made, tmp_path / "copy"))
    user = next(user for user in train(root).road_users if user.category == "pedestrian")
    assert user.box_3d is not None
    away = [float(value) for value in user.box_3d.center + 30 * user.box_3d.R[:, 0]]
    box = {"center": away, "size_lwh": [0.5, 0.5, 1.7], "yaw": user.box_3d.yaw, "R": user.box_3d.R.tolist()}
    spoilt(root, 4, box_3d=box, distance=None, velocity=None)
    assert any("segmentation: the depth file shows" in str(finding) for finding in check(open_dataset(root)))


def test_categories_that_the_card_does_not_name_are_found(made: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(made, tmp_path / "copy"))
    card = json.loads((root / "dataset.json").read_text())
    card["categories"] = ["vehicle"]
    (root / "dataset.json").write_text(json.dumps(card))
    assert any("categories: are vehicle, bicycle" in str(finding) for finding in check(open_dataset(root)))
    card["categories"] = ["vehicle", "tram"]
    (root / "dataset.json").write_text(json.dumps(card))
    with pytest.raises(UserError, match=r"dataset\.json: categories: 'tram' is not one of vehicle"):
        open_dataset(root)


def test_others_are_counted_apart(made: Path, tmp_path: Path) -> None:
    told = json.loads(skope("stats", str(made), "--json"))["splits"]["train"]
    file = train(made)
    known = [user for user in file.road_users if not user.ignored and user.category == "pedestrian"]
    assert told["road_users"]["pedestrian"]["ground_truth"] == len(known)
    assert told["road_users"]["pedestrian"]["ignored"] == sum(
        user.ignored and user.category == "pedestrian" for user in file.road_users
    )
    assert told["vehicles"] == sum(not vehicle.ignored for vehicle in file.annotations)
    assert "pedestrians" in skope("stats", str(made))
    skope("report", str(made), "--out", str(tmp_path / "page"), "--quiet")
    page = (tmp_path / "page" / "index.html").read_text()
    assert 'data-of="pedestrian"' in page
    skope("show", str(made), "--out", str(tmp_path / "sheets"), "--quiet")


def test_a_label_that_differs_is_told(made: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(made, tmp_path / "copy"))
    assert list(differences(open_dataset(made), open_dataset(root))) == []
    spoilt(root, 4, bbox=[1.0, 1.0, 20.0, 30.0], ignore_reason="unseen", iscrowd=1)
    told = list(differences(open_dataset(made), open_dataset(root)))
    assert any("road users are ignored in one" in line for line in told)
    assert any("boxes differ by up to" in line for line in told)
    spoilt(root, 4, track_id=99999)
    assert any(
        "frames have different pedestrians" in line for line in differences(open_dataset(made), open_dataset(root))
    )


# ------------------------------------------------------------------------------------------------------------- presets


def test_only_three_presets_label_people() -> None:
    for name in presets():
        request = from_preset(name, seed=0, renderer="gl", driver="", rules=Rules(), frames=2)
        on = name in ("world", "nights", "conditions")
        assert request.parameters.variation.road_users == on
        assert request.parameters.categories == (schema.CATEGORY_NAMES if on else ("vehicle",))
        assert all(plan.variation.road_users == on for plan in request.plans())
        assert request.parameters.to_dict()["road_users"] == on
    off = from_preset("world", seed=0, renderer="gl", driver="", rules=Rules(), frames=2, road_users=False)
    assert not off.parameters.variation.road_users


def test_recordings_say_whether_people_are_labelled(tmp_path: Path, made: Path) -> None:
    request = from_preset(
        "demo", seed=3, renderer="gl", driver="", rules=Rules(), frames=2, sites=("t01_mill_corner",), road_users=True
    )
    (plan,) = request.plans()
    unlabelled = replace(plan, variation=replace(plan.variation, road_users=False))
    labelled, plain = simulate(plan), simulate(unlabelled)
    recordings.save(tmp_path / "a.npz", labelled)
    recordings.save(tmp_path / "b.npz", plain)
    assert recordings.load(tmp_path / "a.npz").road_users
    assert recordings.packed_recording(recordings.load(tmp_path / "a.npz")) == recordings.packed_recording(labelled)
    assert not recordings.load(tmp_path / "b.npz").road_users
    with np.load(tmp_path / "b.npz") as file:
        assert "road_users" not in str(file["header"])
    assert not labelled.starts_like(replace(labelled, road_users=False))
    jointed = [one for one in labelled.vehicles if not one.labelled]
    assert jointed
    assert all(one.shape["jointed"] == 1 for one in jointed)
    assert not any(one.shape.get("jointed") for one in plain.vehicles)


def test_labelled_riders_are_more_and_some_ride_together() -> None:
    models = {name: entry for name, entry in fleet().items() if name in ("sedan", "van")}

    def drawn(riding: Riding, seed: int = 1) -> list[object]:
        rng = np.random.default_rng(seed)
        return list(trips(Town("town01").network, models, vehicles_per_hour=900, duration=4000, rng=rng, riders=riding))

    usual = [trip for trip in drawn(USUAL_RIDERS) if trip.model.endswith("cyclist")]
    many = [
        trip for trip in drawn(Riding({"cyclist": 0.2, "motorcyclist": 0.2}, narrow=True)) if "cyclist" in trip.model
    ]
    assert len(many) > 3 * len(usual)
    company = [trip for trip in many if "." in trip.name]
    leaders = {trip.name: trip for trip in many}
    assert 0.08 * len(many) < len(company) < 0.5 * len(many)
    for trip in company:
        leader = leaders[trip.name.split(".")[0]]
        assert (trip.model, trip.edges) == (leader.model, leader.edges)
        assert 0 < trip.depart - leader.depart < 4
    assert not any("." in trip.name for trip in drawn(USUAL_RIDERS))
    shares = [Riding.drawn(np.random.default_rng(k)).shares for k in range(40)]
    assert all(0.03 <= share <= 0.25 for one in shares for share in one.values())
    assert len({one["cyclist"] for one in shares}) == 40
