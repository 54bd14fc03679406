"""`--json` says what the text says, and nothing else."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.samples import make_dataset


def both(skope: Any, *words: object) -> tuple[int, list[str], Any]:
    """Exit code, lines of text, and the document; both ways end alike."""
    code, text, _ = skope(*words)
    coded, document, error = skope(*words, "--json")
    assert (coded, error) == (code, "")
    return code, text.splitlines(), json.loads(document)


def test_stats(skope: Any, tmp_path: Path) -> None:
    code, lines, told = both(skope, "gen", "stats", make_dataset(tmp_path / "data", images=3))
    rows = {name: cells for name, *cells in (re.split(r" {2,}", line) for line in lines)}
    assert code == 0
    assert (told["dataset"], told["plots"]) == (str(tmp_path / "data"), None)
    assert list(told["splits"]) == rows[""]
    for name, key in (("images", "images"), ("vehicles", "vehicles"), ("ignored", "ignored"), ("sites", "sites")):
        assert [str(split[key]) for split in told["splits"].values()] == rows[name]
    for split, shown in zip(told["splits"].values(), rows["visible keypoints"], strict=True):
        assert f"{split['visible_points']:.3f}" == shown
        assert split["types"] == {"sedan": 6}
        low, middle, high = split["box_height_px"]
        assert f"{middle:.0f} ({low:.0f}-{high:.0f})" in rows["box height, px"]


def test_stats_of_what_a_file_does_not_say_are_null(skope: Any, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", splits=("train",))
    path = root / "annotations/train.json"
    document = json.loads(path.read_text())
    for row in document["annotations"]:
        row.pop("distance", None), row.pop("occlusion", None)
    path.write_text(json.dumps(document))
    _, lines, told = both(skope, "gen", "stats", root)
    assert ["distance, m", "-"] in [re.split(r" {2,}", line) for line in lines]
    assert told["splits"]["train"]["distance_m"] == [None, None, None]
    assert told["splits"]["train"]["occluded"] is None


def test_stats_name_their_plots(skope: Any, tmp_path: Path) -> None:
    _, lines, told = both(skope, "gen", "stats", make_dataset(tmp_path / "data"), "--plots", "plots")
    assert lines[-1] == "wrote plots/stats.png"
    assert told["plots"] == "plots/stats.png"


def test_check_with_and_without_findings(skope: Any, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data")
    path = root / "annotations/easy.json"
    document = json.loads(path.read_text())
    document["annotations"][0]["area"] = -1
    for spoilt in (False, True):
        if spoilt:
            path.write_text(json.dumps(document))
            (root / "images/stray.png").touch()
        code, lines, told = both(skope, "gen", "check", root)
        assert (told["dataset"], told["repaired"]) == (str(root), False)
        assert [f"{one['where']}: {one['text']}" for one in told["findings"]] == lines[:-1]
        assert code == (1 if told["findings"] else 0)
    assert told["findings"]


def test_check_against_another_dataset(skope: Any, tmp_path: Path) -> None:
    one, same, other = (make_dataset(tmp_path / name, seed=seed) for name, seed in (("a", 0), ("b", 0), ("c", 1)))
    assert both(skope, "gen", "check", one, "--against", same)[2] == {
        "dataset": str(one),
        "against": str(same),
        "differences": [],
        "repaired": False,
    }
    code, lines, told = both(skope, "gen", "check", one, "--against", other)
    assert code == 1
    assert told["differences"] == lines[:-1]
    assert len(lines) > 1


def test_check_says_that_it_repaired_and_nothing_of_the_work(
    skope: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = make_dataset(tmp_path / "data")
    (root / "annotations/easy.json").write_text("{")
    monkeypatch.setattr("skope.gen.inspect.check.repair", lambda *given: given[-1].say("working"))
    code, text, _ = skope("gen", "check", root, "--repair")
    assert "working\nrepaired" in text
    coded, document, _ = skope("gen", "check", root, "--repair", "--json")
    assert (code, coded, json.loads(document)["repaired"]) == (0, 0, True)


def test_a_mistake_leaves_standard_output_empty(skope: Any) -> None:
    for name in ("check", "stats"):
        code, out, error = skope("gen", name, "nowhere", "--json")
        assert (code, out, error.count("\n")) == (2, "", 1)


def test_sites(skope: Any) -> None:
    code, lines, told = both(skope, "gen", "sites")
    head, *rows, last = lines
    assert (code, head.split()[0]) == (0, "site")
    assert last.startswith(f"{len(told['sites'])} sites;")
    for row, one in zip(rows, told["sites"], strict=True):
        name, town, height, _, pitch, split, sees = re.split(r"\s+", row, maxsplit=6)
        assert (name, town, split, sees) == (one["name"], one["town"], one["split"], one["sees"])
        assert (height, pitch) == (f"{one['height_m']:.1f}", f"{one['pitch_deg']:.0f}°")


def test_plans_of_towns(skope: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import numpy as np

    monkeypatch.setattr("skope.gen.inspect.town_maps.town_map", lambda _: np.zeros((4, 4, 3), np.uint8))
    code, lines, told = both(skope, "gen", "sites", "--maps", "--out", "plans")
    assert (code, lines[:-1]) == (0, [f"drew {path}" for path in told["maps"]])
    assert lines[-1] == f"wrote {len(told['maps'])} plans to plans"
    assert all(Path(path).is_file() for path in told["maps"])


def test_a_site_file(skope: Any) -> None:
    example = Path(__file__).parents[3] / "examples/own_road/site.toml"
    code, lines, told = both(skope, "gen", "sites", "--site", example, "--out", "out")
    assert (code, told["notes"]) == (0, lines[:-1])
    width, height = told["size"]
    assert lines[-1].startswith(
        f"{told['site']}: {width}x{height}, {told['height_m']:.1f} m over the road, "
        f"{told['pitch_deg']:.0f} degrees down, traffic on the {told['traffic']}; wrote {told['picture']}; "
    )
    assert Path(told["picture"]).is_file()
