"""Joined datasets: nothing lost, nothing mixed up, and licences that go together."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from skope.dataset import coco
from skope.dataset.folder import open_dataset, read_manifest
from skope.errors import UserError
from skope.files.json_files import read_json, write_json
from skope.gen.inspect.check import check
from skope.gen.output.licences import licence_terms, united
from skope.gen.output.writers import checksum
from skope.keypoints import PUBLISHED
from tests.samples import make_dataset

CC0, BY, SA, NC, NC_SA, ND = (
    *("CC0 1.0: drawn by a program", "CC BY 4.0", "CC BY-SA 4.0", "CC BY-NC 4.0"),
    *("CC BY-NC-SA 4.0 (as its users state it)", "CC BY-ND 4.0"),
)
PHOTO = "What is drawn is CC0 1.0; the background is the user's photograph, whose rights are as they were."


def dataset(name: str, licence: str, sites: dict[str, str], seed: int = 0, **options: Any) -> Path:
    """A dataset whose split -> site is `sites`."""
    root = make_dataset(Path(name), splits=tuple(sites), seed=seed, **options)
    for split, site in sites.items():
        path = root / "annotations" / f"{split}.json"
        file = coco.read(path)
        coco.write(path, replace(file, images=tuple(replace(i, site=site) for i in file.images)))
    write_json(root / "dataset.json", {**read_json(root / "dataset.json"), "licence": licence, "label_rules": [name]})
    return root


def test_everything_is_there_once(skope: Any) -> None:
    a = dataset("a", CC0, {"train": "bridge", "easy": "mast"}, images=2)
    b = dataset("b", NC_SA, {"train": "bridge", "hard": "pole"}, seed=1, images=3)
    code, out, err = skope("gen", "merge", "a", "b", "out", "-q")
    assert (code, out, err) == (0, "wrote out; next: skope gen check out\n", "")
    both = open_dataset(Path("out"))
    assert both.splits == ("easy", "hard", "train")
    assert both.licence == NC_SA
    assert [(s["name"], s["licence"], s["sites"]) for s in both.card["sources"]] == [
        ("a", CC0, {"mast": "mast", "bridge": "bridge"}),
        ("b", NC_SA, {"pole": "pole", "bridge": "bridge_2"}),
    ]
    assert both.card["label_rules"] == ["a", "b"]
    assert list(check(both)) == []
    expected = {"easy": [(a, "mast", 2)], "hard": [(b, "pole", 3)], "train": [(a, "bridge", 2), (b, "bridge_2", 3)]}
    for split, parts in expected.items():
        now = both.read(split)
        images, vehicles = iter(now.images), now.by_image()
        for root, site, count in parts:
            then = open_dataset(root)
            file = then.read(split)
            assert len(file.images) == count
            for old in file.images:
                new = next(images)
                assert (new.site, new.split, new.frame_index) == (site, split, old.frame_index)
                assert (Path("out") / new.file_name).read_bytes() == (root / old.file_name).read_bytes()
                plain = [
                    [{**coco.annotation_to_dict(v), "id": 0, "image_id": 0} for v in own]
                    for own in (file.by_image()[old.id], vehicles[new.id])
                ]
                assert plain[0] == plain[1]
        assert next(images, None) is None
    counts = both.card["counts"]
    assert (counts["images"], counts["ground_truth"]) == (10, 20)
    # What is joined can be joined again, and converted.
    dataset("c", CC0, {"train": "bridge_2"}, seed=2)
    assert skope("gen", "merge", "out", "c", "more", "-q")[0] == 0
    assert {i.site for i in open_dataset(Path("more")).read("train").images} == {"bridge", "bridge_2", "bridge_2_2"}
    assert skope("gen", "convert", "more", "yolo", "--to", "coco", "-q")[0] == 0


def test_damage_to_a_joined_dataset_is_found(skope: Any) -> None:
    """The manifest holds the checksum of every image and annotation file; known ones come from the parts' manifests."""
    a, b = dataset("a", CC0, {"train": "bridge"}), dataset("b", CC0, {"train": "mast"}, seed=1)
    images = {str(path.relative_to(a)): checksum(path.read_bytes()) for path in a.glob("images/**/*.*")}
    files = {"annotations/train.json": checksum((a / "annotations/train.json").read_bytes())}
    write_json(a / "manifest.json", {"sha256": {**images, **files}, "tallies": {}})
    assert skope("gen", "merge", str(a), str(b), "out", "-q")[0] == 0
    out = Path("out")
    sums = read_manifest(out)["sha256"]
    made = [path for path in out.rglob("*") if path.is_file() and path.parent != out]
    assert sums == {str(path.relative_to(out)): checksum(path.read_bytes()) for path in made}
    assert list(check(open_dataset(out))) == []
    image = next(path for path in made if path.parts[1] == "images")
    content = bytearray(image.read_bytes())
    content[len(content) // 2] ^= 1
    image.unlink()  # a hard link to the part's
    image.write_bytes(content)
    found = {finding.where for finding in check(open_dataset(out)) if finding.text.startswith("sha256: ")}
    assert found == {str(image.relative_to(out))}


def test_names_given_in_a_merge_are_not_given_twice(skope: Any) -> None:
    """The second dataset has `mast` and, from a merge of its own, `mast_2`."""
    dataset("a", BY, {"train": "mast"}, images=1)
    dataset("b", BY, {"train": "mast"}, seed=1, images=1)
    assert skope("gen", "merge", "a", "b", "both", "-q")[0] == 0
    assert skope("gen", "merge", "a", "both", "out", "-q")[0] == 0
    images = open_dataset(Path("out")).read("train").images
    assert [image.site for image in images] == ["mast", "mast_2", "mast_2_2"]
    assert [image.file_name.split("/")[1] for image in images] == ["mast", "mast_2", "mast_2_2"]


def test_what_is_there_twice_is_told(skope: Any) -> None:
    dataset("a", BY, {"train": "mast", "easy": "pole"})
    dataset("b", BY, {"train": "bridge"}, seed=1)
    assert skope("gen", "merge", "a", "b", "both", "-q")[0] == 0
    code, out, _ = skope("gen", "merge", "b", "both", "out")
    assert code == 0
    assert "both: 1 recordings are duplicates of recordings of b" in out
    assert " of a: " not in out
    code, out, _ = skope("gen", "merge", "a", "b", "other")
    assert (code, "twice" in out) == (0, False)


def test_the_folder_one_stands_in_can_be_joined(skope: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Images without a site and of equal names go below the dataset's own name, however it was given."""
    for number, name in enumerate(("a", "b c")):
        root = make_dataset(Path(name), splits=("train",), images=1, seed=number)
        path = root / "annotations" / "train.json"
        file = coco.read(path)
        coco.write(path, replace(file, images=tuple(replace(i, site=None) for i in file.images)))
    monkeypatch.chdir("b c")
    code, out, err = skope("gen", "merge", "../a", ".", "../o ut", "-q")
    assert (code, out, err) == (0, "wrote ../o ut; next: skope gen check '../o ut'\n", "")
    both = open_dataset(Path("../o ut"))
    first, second = (image.file_name for image in both.read("train").images)
    assert second == f"images/b c/{first.removeprefix('images/')}"
    assert [of["name"] for of in both.card["sources"]] == ["a", "b c"]
    assert both.card["command"] == "skope gen merge a 'b c'"  # and nothing of this machine's folders
    assert "b c (not stated)\n" in (both.root / "README.md").read_text()  # of which no command is known


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: dataset("b", CC0, {"easy": "bridge"}), "site bridge is in split easy, and in train of a"),
        (lambda: dataset("b", CC0, {"easy": "x"}), "is in split easy, the same image in train of a: test images"),
        (lambda: dataset("b", CC0, {"train": "x"}, scheme=PUBLISHED), "b: has keypoint scheme skope3d, a has skope33"),
        (lambda: dataset("b", ND, {"train": "x"}), f"licence: '{ND}' cannot be combined with '{BY}'"),
        (lambda: Path("b").mkdir(), "b: no dataset.json in it"),
        (lambda: (dataset("b", BY, {"train": "x"}) / "annotations" / "train.json").unlink(), "b: has no annotations"),
        (lambda: Path("b").symlink_to("a"), "a dataset is listed twice"),
    ],
)
def test_what_does_not_go_together_is_refused(skope: Any, make: Callable[[], object], said: str) -> None:
    dataset("a", BY, {"train": "bridge"})
    make()
    code, out, err = skope("gen", "merge", "a", "b", "out", "-q")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert said in err
    assert {path.name for path in Path().iterdir()} == {"a", "b"}


def test_one_dataset_is_not_enough(skope: Any) -> None:
    dataset("a", BY, {"train": "bridge"})
    code, _, err = skope("gen", "merge", "a", "out", "-q")
    assert (code, "expected two or more datasets and a new folder, got 1 before out" in err) == (2, True)
    dataset("b", BY, {"train": "pole"})
    code, _, err = skope("gen", "merge", "a", "b", "a", "-q")
    assert (code, "a: holds other files than these; choose another folder" in err) == (2, True)


def test_licences() -> None:
    assert licence_terms(NC_SA) == {"BY", "NC", "SA"}
    assert licence_terms("CC-BY-4.0") == {"BY"}
    assert licence_terms(CC0) == set()
    assert (
        licence_terms(PHOTO)
        is licence_terms("not stated")
        is licence_terms("CC BY-XY 4.0")
        is licence_terms("CC BYE")
        is None
    )
    # Creative Commons' chart of what may be built from what: row and column, or their common licence.
    chart = {
        (CC0, CC0): CC0, (CC0, BY): BY, (CC0, SA): SA, (CC0, NC): NC, (CC0, NC_SA): NC_SA, (CC0, ND): None,
        (BY, BY): BY, (BY, SA): SA, (BY, NC): NC, (BY, NC_SA): NC_SA, (BY, ND): None,
        (SA, SA): SA, (SA, NC): None, (SA, NC_SA): None, (SA, ND): None,
        (NC, NC): NC, (NC, NC_SA): NC_SA, (NC, ND): None,
        (NC_SA, NC_SA): NC_SA, (NC_SA, ND): None, (ND, ND): ND,
        (PHOTO, CC0): f"{PHOTO} | {CC0}", (PHOTO, SA): None, (PHOTO, ND): None,
        ("not stated", BY): f"not stated | {BY}",
    }  # fmt: skip
    for (a, b), expected in chart.items():
        if expected is None:
            for pair in ((a, b), (b, a)):
                with pytest.raises(UserError, match="cannot be combined with"):
                    united(pair)
        else:
            assert united((a, b)) == expected
    assert united((CC0, BY, NC)) == NC
    assert united(("CC BY-NC-SA 3.0", BY)) == "CC BY-NC-SA 3.0"


def test_a_model_is_held_out_where_all_say_so(skope: Any) -> None:
    for name, held_out, substituted in (("a", ["van", "suv"], {"bus": ["front_logo"]}), ("b", ["suv"], {})):
        root = dataset(name, BY, {"train": name})
        fleet = {"held_out": held_out, "substituted": substituted}
        write_json(root / "dataset.json", {**read_json(root / "dataset.json"), "fleet": fleet})
    dataset("c", BY, {"train": "c"})
    assert skope("gen", "merge", "a", "b", "ab", "-q")[0] == 0
    assert open_dataset(Path("ab")).card["fleet"] == {"held_out": ["suv"], "substituted": {"bus": ["front_logo"]}}
    assert skope("gen", "merge", "a", "c", "ac", "-q")[0] == 0
    assert "fleet" not in open_dataset(Path("ac")).card


@pytest.mark.parametrize("command", ["convert a a/sub --to coco", "merge a b b/sub"])
def test_nothing_is_written_into_a_source(skope: Any, command: str) -> None:
    for seed, name in enumerate("ab"):
        make_dataset(Path(name), seed=seed, splits=("train",))
    before = sorted(Path().rglob("*"))
    code, _, err = skope("gen", *command.split())
    assert (code, err.count("\n")) == (2, 1)
    assert re.search(r"(.)/sub: is inside \1, which must not change; choose another folder", err)
    assert sorted(Path().rglob("*")) == before
