"""Files and folders that appear whole or not at all."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import skope
from skope.errors import UserError
from skope.files.atomic import link, read_text, replacing, replacing_folder, writing
from skope.files.json_files import json_bytes, parse_json
from skope.files.output_folders import claim_output


def test_a_folder_appears_when_it_is_whole(tmp_path: Path) -> None:
    for out in (tmp_path / "new" / "deep", tmp_path / "empty"):
        if out.name == "empty":
            out.mkdir()
        with replacing_folder(out) as folder:
            (folder / "a").write_text("x")
            assert not out.exists() or not any(out.iterdir())
        assert [path.name for path in out.iterdir()] == ["a"]
        assert [path.name for path in out.parent.iterdir() if path.name.startswith(".")] == []


def test_what_a_killed_process_was_writing_goes_when_its_folder_is_claimed_again(tmp_path: Path) -> None:
    """Files that somebody else is writing stay, and so do those of users."""
    out = tmp_path / "out"
    claim_output(out, "skope eval", [], {})
    write = (
        "import os, sys; sys.path.insert(0, '.'); from pathlib import Path; from skope.files.atomic import replacing"
    )
    kill = f"{write}\nwith replacing(Path(sys.argv[1])) as path:\n    path.write_text('half'); os.kill(os.getpid(), 9)"
    root = Path(skope.__file__).parents[1]
    assert subprocess.run([sys.executable, "-c", kill, out / "a.csv"], cwd=root).returncode == -9
    (left,) = (path.name for path in out.glob(".*"))
    with replacing(out / "b.csv") as writing_now:
        writing_now.write_text("x")
        for name in (".c.part.csv", "d.1.part.csv"):
            (out / name).write_text("mine")
        with pytest.raises(UserError, match="another run"):
            claim_output(out, "skope eval", [], {"other": 1})
        assert (out / left).is_file()
        claim_output(out, "skope eval", [], {})
        assert writing_now.is_file()
    assert {path.name for path in out.iterdir()} == {"b.csv", ".c.part.csv", "d.1.part.csv", "work.json"}


def test_options_with_long_values_are_named_without_their_values(tmp_path: Path) -> None:
    points = [[k, k] for k in range(33)]
    claim_output(tmp_path / "out", "skope eval", [], {"points": points, "size": 3})
    (tmp_path / "out" / "a.csv").write_text("x")
    with pytest.raises(UserError, match=r"another run \(points differs; size = 3, now 4\);"):
        claim_output(tmp_path / "out", "skope eval", [], {"points": points[1:], "size": 4})


@pytest.mark.parametrize("kind", [ValueError, KeyboardInterrupt])
def test_nothing_stays_of_one_that_fails(tmp_path: Path, kind: type[BaseException]) -> None:
    def begin() -> None:
        with replacing_folder(tmp_path / "out") as folder:
            (folder / "a").write_text("x")
            raise kind

    with pytest.raises(kind):
        begin()
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_kept(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "a").write_text("x")
    for name, said in (("file", "file: is a file; choose"), ("full", "full: holds other files than these; choose")):
        with pytest.raises(UserError, match=said), replacing_folder(tmp_path / name) as folder:
            (folder / "a").write_text("y")
    with pytest.raises(UserError, match="cannot be written"), replacing_folder(tmp_path / "file" / "below"):
        pass
    assert (tmp_path / "full" / "a").read_text() == (tmp_path / "file").read_text() == "x"


@pytest.mark.parametrize("change", ["more", "fewer", "kind", "deep", None])
def test_what_is_there_is_the_same_only_where_all_of_it_is(tmp_path: Path, change: str | None) -> None:
    def fill(folder: Path) -> None:
        (folder / "b").mkdir(parents=True)
        (folder / "a").write_text("x")
        (folder / "b" / "c").write_text("y")

    def again() -> None:
        with replacing_folder(out) as folder:
            fill(folder)

    out = tmp_path / "out"
    fill(out)
    match change:
        case "more":
            (out / "d").mkdir()
        case "fewer":
            (out / "a").unlink()
        case "kind":
            (out / "a").unlink()
            (out / "a").mkdir()
        case "deep":
            (out / "b" / "c").write_text("z")
    before = [(path, path.stat().st_mtime_ns) for path in sorted(out.rglob("*"))]
    if change:
        with pytest.raises(
            UserError, match="out: holds other files than these; choose another folder, or move its content away"
        ):
            again()
    else:
        again()
    assert [(path, path.stat().st_mtime_ns) for path in sorted(out.rglob("*"))] == before
    assert list(tmp_path.iterdir()) == [out]


def test_links_become_copies_where_they_must(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_text("x")
    link(tmp_path / "a", tmp_path / "b" / "c")
    assert (tmp_path / "b" / "c").samefile(tmp_path / "a")

    def refused(*_: object) -> None:
        raise OSError("another device")

    monkeypatch.setattr(Path, "hardlink_to", refused)
    link(tmp_path / "a", tmp_path / "d")
    assert (tmp_path / "d").read_text() == "x"
    assert not (tmp_path / "d").samefile(tmp_path / "a")


def test_compact_json_is_strict() -> None:
    assert json_bytes({"b": [0.1, None, "null"], "a": 2**70}) == b'{"b":[0.1,null,"null"],"a":1180591620717411303424}'
    assert json.loads(json_bytes({"name": "x\udcff.jpg"})) == {"name": "x\udcff.jpg"}
    for value in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match="not JSON compliant"):
            json_bytes({"a": value})


def test_what_cannot_be_written_has_the_users_name(tmp_path: Path) -> None:
    (tmp_path / "keep.txt").touch()
    for path in ("keep.txt/x", "keep.txt/x/y"):
        for write in (replacing, replacing_folder):
            with (
                pytest.raises(UserError, match=r"cannot be written: .*keep\.txt is a file"),
                write(tmp_path / path),
            ):
                pass

    out = tmp_path / "out"
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(UserError) as caught, replacing_folder(out) as folder, replacing(folder / "a.json"):
        raise full
    assert str(caught.value) == f"{out / 'a.json'}: cannot be written: No space left on device"


def test_what_fails_elsewhere_is_no_fault_of_what_is_written(tmp_path: Path) -> None:
    """Other files keep their names; a closed pipe is for the command line, which ends without a word."""
    out = tmp_path / "out"
    with pytest.raises(UserError, match=r"gone.txt: No such file or directory\Z") as caught, replacing_folder(out):
        (tmp_path / "gone.txt").read_bytes()
    assert "cannot be written" not in str(caught.value)
    with pytest.raises(UserError, match=r"elsewhere/b: No such file"), replacing(tmp_path / "a"):
        (tmp_path / "elsewhere" / "b").write_bytes(b"x")
    for context in (replacing_folder(out), replacing(tmp_path / "a"), writing(out)):
        with pytest.raises(BrokenPipeError), context:
            raise BrokenPipeError(errno.EPIPE, "Broken pipe")
    with pytest.raises(UserError, match=r"a: cannot be written: No space left"), replacing(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(UserError, match=r"out: cannot be written: No such file"), replacing_folder(out) as folder:
        (folder / "b" / "c").write_bytes(b"x")
    assert list(tmp_path.iterdir()) == []


def test_a_link_becomes_the_file_that_it_leads_to(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "file").write_bytes(b"x")
    (tmp_path / "link").symlink_to("deep/file")
    (tmp_path / "twice").symlink_to("link")
    for k, name in enumerate(("deep/file", "link", "twice")):
        target = tmp_path / "far" / "below" / str(k)
        link(tmp_path / name, target)
        assert not target.is_symlink()
        assert target.samefile(tmp_path / "deep" / "file")
        link(tmp_path / name, target)  # the same again
    (tmp_path / "other").write_bytes(b"y")
    with pytest.raises(UserError, match="two different files would have this name"):
        link(tmp_path / "other", target)
    assert target.read_bytes() == b"x"
    (tmp_path / "nowhere").symlink_to("gone")
    (tmp_path / "round").symlink_to("round")
    for name in ("nowhere", "round"):
        with pytest.raises(UserError, match=f"{name}: "):
            link(tmp_path / name, tmp_path / "new")
    assert not os.path.lexists(tmp_path / "new")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-32"])
def test_json_may_begin_with_a_byte_order_mark(encoding: str) -> None:
    assert parse_json('{"ü": [1, NaN]}'.encode(encoding))["ü"][0] == 1
    assert parse_json('{"ü": [1]}'.encode(encoding)) == {"ü": [1]}


def test_users_texts_may_begin_with_one_too(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes("ä = 1\r\n".encode("utf-8-sig"))
    assert read_text(path) == "ä = 1\r\n"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match=r"a.toml: not UTF-8 text"):
        read_text(path)
