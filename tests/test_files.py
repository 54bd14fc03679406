"""Folders that appear whole or not at all."""

from pathlib import Path

import pytest

from skope.errors import UserError
from skope.files import link, replacing_folder


def test_a_folder_appears_when_it_is_whole(tmp_path: Path) -> None:
    for out in (tmp_path / "new" / "deep", tmp_path / "empty"):
        if out.name == "empty":
            out.mkdir()
        with replacing_folder(out) as folder:
            (folder / "a").write_text("x")
            assert not out.exists() or not any(out.iterdir())
        assert [path.name for path in out.iterdir()] == ["a"]
        assert [path.name for path in out.parent.iterdir() if path.name.startswith(".")] == []


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
    for name, said in (("file", "file: is a file; choose"), ("full", "full: is not empty; choose")):
        with pytest.raises(UserError, match=said), replacing_folder(tmp_path / name):
            pass
    with pytest.raises(UserError, match="cannot be written"), replacing_folder(tmp_path / "file" / "below"):
        pass
    assert (tmp_path / "full" / "a").read_text() == (tmp_path / "file").read_text() == "x"


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
