"""Output folders: the same run resumes or is repeated; the output of another run is rejected and kept."""

import json
import os
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

from skope.dataset import coco
from skope.errors import UserError
from skope.files.output_folders import WORK_FILE, claim_output, move_new, replaceable_output, write_new
from skope.schema import AnnotationFile, Result
from tests.conftest import files_of
from tests.samples import make_annotation, make_image


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "source.txt"
    path.write_text("a")
    return path


def test_a_folder_is_taken_by_one_work(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    made = claim_output(out, "skope eval", [source], {"score": 0.9, "iou": (0.5, 0.6)})
    assert json.loads((out / WORK_FILE).read_text()) == made
    assert set(made) == {"command", "inputs", "options", "skope", "date"}
    (out / "figures").write_text("1")
    assert claim_output(out, "skope eval", [source], {"score": 0.9, "iou": (0.5, 0.6)}) == made
    moved = source.rename(tmp_path / "moved.txt")
    again = claim_output(out, "skope eval", [moved], {"score": 0.9, "iou": (0.5, 0.6)})
    assert again == {**made, "inputs": {str(moved): made["inputs"][str(source)]}}


@pytest.mark.parametrize(
    ("command", "content", "more", "options", "words"),
    [
        ("skope eval pose", "a", [], {"score": 0.9}, "`skope eval`"),
        ("skope eval", "b", [], {"score": 0.9}, "not of .*source.txt"),
        ("skope eval", "a", ["c"], {"score": 0.9}, "not of .*c"),
        ("skope eval", "a", [], {"score": 0.8}, r"score = 0.9, now 0.8"),
        ("skope eval", "a", [], {"score": 0.9, "new": 1}, "new = None, now 1"),
        ("skope eval", "a", [], {}, "score = 0.9, now None"),
    ],
)
def test_other_work_is_refused(
    command: str, content: str, more: list[str], options: dict[str, Any], words: str, source: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    claim_output(out, "skope eval", [source], {"score": 0.9})
    (out / "figures").write_text("1")
    before = files_of(out)
    source.write_text(content)
    others = [tmp_path / name for name in more]
    for path in others:
        path.write_text(path.name)
    with pytest.raises(UserError, match=words):
        claim_output(out, command, [source, *others], options)
    assert files_of(out) == before


@pytest.mark.parametrize("content", ["", "[]", '"x"', '{"command": 3}', '{"command": "skope eval", "inputs": []}'])
def test_a_folder_whose_record_says_nothing_is_refused(content: str, tmp_path: Path) -> None:
    (tmp_path / WORK_FILE).write_text(content)
    (tmp_path / "figures").write_text("1")
    before = files_of(tmp_path)
    for taken in (
        lambda: claim_output(tmp_path, "skope eval", [], {"score": 0.9}),
        lambda: seen(tmp_path, "a", {"b": "b"}),
    ):
        with pytest.raises(
            UserError, match=r"--out: .* holds the output of another run \(.*\); choose another folder, or move its"
        ):
            taken()
    assert files_of(tmp_path) == before


# ---------------------------------------------------------------------------------------------------------------- looks


def seen(folder: Path, of: str | Path, pictures: dict[str, str], **how: Any) -> None:
    """A look at something."""
    with replaceable_output(folder, "skope gen show", of, **how) as drawn:
        for name, content in pictures.items():
            (drawn / name).write_text(content)


def shown(folder: Path) -> dict[str, str]:
    return {name: data.decode() for name, data in files_of(folder).items() if name != WORK_FILE}


def test_a_look_replaces_an_earlier_look_at_the_same_thing_and_no_other(tmp_path: Path) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    seen(out, data, {"a": "1", "b": "1"})
    seen(out, data, {"b": "2", "c": "2"})
    assert shown(out) == {"b": "2", "c": "2"}
    for command, of in (
        ("skope gen show", tmp_path / "other"),
        ("skope gen report", data),
        ("skope gen show", "fleet"),
    ):
        with (
            pytest.raises(UserError, match=r"holds the output of another run \(`skope gen show` of \.\./data\)"),
            replaceable_output(out, command, of),
        ):
            pytest.fail("nothing is drawn")
    assert shown(out) == {"b": "2", "c": "2"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


def test_pictures_stay_beside_new_ones_of_the_same_state(source: Path, tmp_path: Path) -> None:
    out, how = tmp_path / "out", {"inputs": [source], "options": {"layers": ["mask"]}}
    seen(out, source, {"a": "1"}, **how)
    seen(out, source, {"b": "1"}, **how)
    assert shown(out) == {"a": "1", "b": "1"}
    seen(out, source, {"c": "2"}, **{**how, "options": {"layers": ["depth"]}})
    assert shown(out) == {"c": "2"}
    source.write_text("changed")
    seen(out, source, {"d": "3"}, **{**how, "options": {"layers": ["depth"]}})
    assert shown(out) == {"d": "3"}
    work = json.loads((out / WORK_FILE).read_text())
    (out / WORK_FILE).write_text(json.dumps({**work, "skope": "0.0.1"}))
    seen(out, source, {"e": "3"}, **{**how, "options": {"layers": ["depth"]}})
    assert shown(out) == {"e": "3"}


def test_a_users_file_among_the_pictures_is_neither_removed_nor_written_over(tmp_path: Path) -> None:
    out = tmp_path / "out"
    seen(out, "fleet", {"a": "1"})
    (out / "notes").write_text("mine")
    seen(out, "fleet", {"b": "2"})
    assert shown(out) == {"b": "2", "notes": "mine"}
    before = files_of(out)
    with pytest.raises(
        UserError, match="out/notes exists and was not written by an earlier call; choose another folder"
    ):
        seen(out, "fleet", {"c": "3", "notes": "3"})
    assert files_of(out) == before


def test_a_look_that_fails_leaves_the_earlier_one_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    seen(out, "fleet", {"a": "1"})
    before = files_of(out)

    def broken() -> None:
        with replaceable_output(out, "skope gen show", "fleet") as drawn:
            (drawn / "a").write_text("2")
            raise UserError("a broken image")

    with pytest.raises(UserError, match="a broken image"):
        broken()
    assert files_of(out) == before
    assert list(tmp_path.iterdir()) == [out]


def test_a_look_that_was_killed_while_it_moved_its_pictures_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, move = tmp_path / "out", Path.replace
    seen(out, "fleet", {"a": "1", "b": "1"})

    def killed(path: Path, target: Path) -> Path:
        if path.name == "d":
            raise KeyboardInterrupt
        return move(path, target)

    monkeypatch.setattr(Path, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        seen(out, "fleet", {"c": "2", "d": "2"})
    monkeypatch.setattr(Path, "replace", move)
    seen(out, "fleet", {"e": "3"})
    assert shown(out) == {"e": "3"}


def test_a_look_goes_on_where_all_has_moved_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here" / "data").mkdir(parents=True)
    seen(tmp_path / "here/out", tmp_path / "here/data", {"a": "1"})
    (tmp_path / "here").rename(tmp_path / "there")
    monkeypatch.chdir(tmp_path / "there" / "data")
    seen(Path("../out"), Path(), {"a": "2"})
    assert shown(tmp_path / "there/out") == {"a": "2"}


@pytest.mark.parametrize("name", ["../victim", "/victim", "..", "", "deep/a", 3, None])
def test_a_strangers_record_removes_nothing_elsewhere(name: Any, tmp_path: Path) -> None:
    out, victim = tmp_path / "out", tmp_path / "victim"
    seen(out, "fleet", {"a": "1"})
    (out / "deep").mkdir()
    for path in (victim, out / "deep" / "a"):
        path.write_text("dear")
    name = str(victim) if name == "/victim" else name
    work = json.loads((out / WORK_FILE).read_text())
    for files in ([name], name):
        (out / "a").unlink(missing_ok=True)
        (out / WORK_FILE).write_text(json.dumps({**work, "files": files}))
        seen(out, "fleet", {"a": "2"})
        assert (victim.read_text(), shown(out)) == ("dear", {"a": "2", "deep/a": "dear"})


# ---------------------------------------------------------------------------------------------------- folders and files


def test_folders_of_other_files_and_files_are_refused_and_begun_ones_without_results_taken(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.txt").write_text("mine")
    with pytest.raises(UserError, match="holds other files"):
        claim_output(tmp_path / "thesis", "skope eval", [], {})
    with pytest.raises(UserError, match="is a file"):
        claim_output(tmp_path / "thesis" / "thesis.txt", "skope eval", [], {})
    claim_output(tmp_path / "begun", "skope eval", [], {"score": 0.9})
    claim_output(tmp_path / "begun", "skope eval pose", [], {})
    assert json.loads((tmp_path / "begun" / WORK_FILE).read_text())["command"] == "skope eval pose"


def test_a_file_is_written_where_none_is(tmp_path: Path) -> None:
    path = tmp_path / "a" / "camera.json"
    write_new(path, b"1")
    before = path.stat().st_mtime_ns
    write_new(path, b"1")
    assert path.stat().st_mtime_ns == before
    for content in (b"1", b"2"):
        (tmp_path / "made").write_bytes(content)
        fails = pytest.raises(UserError, match=r"camera.json: exists with other content")
        refused = fails if content == b"2" else nullcontext()
        with refused:
            write_new(path, content)
        with refused:
            move_new(tmp_path / "made", path)
        assert path.read_bytes() == b"1"
    with pytest.raises(UserError, match="a: is a folder; choose another file"):
        write_new(path.parent, b"1")
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "nowhere").symlink_to(tmp_path / "gone")
    for name in ("pipe", "nowhere"):
        with pytest.raises(UserError, match=f"{name}: exists and is not a regular file"):
            write_new(tmp_path / name, b"1")
    with pytest.raises(UserError, match=r"camera\.json/x: cannot be written: .*camera\.json is a file"):
        write_new(path / "x", b"1")
    move_new(tmp_path / "made", path.parent / "moved")
    assert (path.parent / "moved").read_bytes() == b"2"


def scene(folder: Path, name: str, x: float) -> tuple[Path, Path]:
    """Ground truth of one vehicle, and results that find it."""
    vehicle = make_annotation(1, 1, (x, 10, 60, 40))
    truth, results = folder / f"{name}.json", folder / f"{name}_results.json"
    coco.write(truth, AnnotationFile(images=(make_image(1),), annotations=(vehicle,)))
    coco.write_results(results, [Result(image_id=1, score=0.95, bbox=vehicle.bbox, keypoints=vehicle.keypoints)])
    return truth, results


POINTS = "column,row,x,y,z\n100,400,-4,10,0\n500,420,2,9,0\n320,300,0,20,0\n200,310,-5,18,0\n450,290,6,22,0\n"


def test_each_command_makes_its_own_again_and_refuses_the_others(skope: Any, tmp_path: Path) -> None:
    """Empty folder, finished output, output of another run: by the command line."""
    (truth, found), (other_truth, other_found) = scene(tmp_path, "one", 10), scene(tmp_path, "two", 20)
    Path("points.csv").write_text(POINTS)
    Path("others.csv").write_text(POINTS.replace("100,400", "101,400"))
    for own, other in [
        (
            ("eval", "--annotations", truth, "--predictions", found, "--out", "scores"),
            ("eval", "--annotations", other_truth, "--predictions", other_found, "--out", "scores"),
        ),
        (
            ("eval", "camera", "--points", "points.csv", "--size", "640x480", "--out", "cameras/c.json"),
            ("eval", "camera", "--points", "others.csv", "--size", "640x480", "--out", "cameras/c.json"),
        ),
    ]:
        out = Path(str(own[-1]).split("/")[0])
        assert skope(*own)[0] == 0
        before = files_of(out)
        assert skope(*own)[0] == 0
        assert files_of(out) == before
        code, _, err = skope(*other)
        assert (code, err.count("\n")) == (2, 1)
        assert str(own[-1]) in err
        assert files_of(out) == before


def test_metrics_and_report_say_what_they_are_of(skope: Any, tmp_path: Path) -> None:
    truth, found = scene(tmp_path, "one", 10)
    assert skope("eval", "--annotations", truth, "--predictions", found, "--out", "scores")[0] == 0
    of, work = (json.loads(Path("scores", name).read_text()) for name in ("metrics.json", WORK_FILE))
    assert of["of"] == {name: work[name] for name in ("inputs", "skope", "date")}
    assert list(of["of"]["inputs"]) == [str(truth), str(found)]
    report = Path("scores/report.html").read_text()
    for text in (str(truth), str(found), work["date"], *(digest[:12] for digest in work["inputs"].values())):
        assert text in report
