"""Output folders belong to the work that began them: the same work goes on in them, other work is refused.

`work.json` in such a folder says which command made it, of what, with which version of skope and when.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from skope.errors import UserError
from skope.files.atomic import (
    file_in_place_of,
    remove_leftovers,
    replacing_folder,
    same_content,
    sha256_of,
    write_bytes,
)
from skope.files.json_files import json_bytes, parse_json, read_json, write_json
from skope.version import __version__

WORK_FILE: Final = "work.json"
FOLDER_ADVICE: Final = "choose another folder, or move what is there away"
_OTHER_FILE: Final = "is there already, with other content; choose another file, or move it away"


def claim_output(folder: Path, command: str, inputs: Iterable[Path], options: Mapping[str, Any]) -> dict[str, Any]:
    """Make `folder` the output folder of this work by writing its `work.json`, or refuse to.

    A folder can be claimed that is missing or empty, or whose `work.json` names the same work: what it holds is then
    gone on with, or made again. What an earlier run was writing when it was killed is removed.

    Args:
        folder: The output folder.
        command: The command that writes, as in "skope eval".
        inputs: Files whose contents are part of what the work is.
        options: JSON values that are part of what the work is.

    Returns:
        What `work.json` holds.

    Raises:
        UserError: `folder` is a file, or holds other work or other files; nothing is written then.
    """
    work = work_of(command, inputs, options)
    found = _recorded_work(folder, "--out")
    if found is not None and (different := work_differences(found, work)):
        raise UserError(f"--out: {folder} holds other work ({different}); {FOLDER_ADVICE}")
    remove_leftovers(folder)
    return _write_record(folder, work)


@contextmanager
def replaceable_output(
    folder: Path,
    command: str,
    of: str | Path,
    *,
    inputs: Iterable[Path] = (),
    options: Mapping[str, Any] | None = None,
    flag: str = "--out",
) -> Iterator[Path]:
    """Write pictures and pages that may replace those of an earlier call: all together, when all are drawn.

    They take the place of what the same command drew of the same thing before, and of nothing else.

    Args:
        folder: Where the files shall lie.
        command: The command that draws, as `work.json` names it.
        of: What is drawn: the path of a file or folder, or what it is called.
        inputs: Files whose contents decide what is drawn.
        options: JSON values. Where they are given, the earlier files stay beside the new ones if they were drawn with
            the same `options`, contents of `inputs` and version of skope; else they go.
        flag: The flag that `folder` was given by, for messages.

    Yields:
        An empty folder to draw into, whose files move to `folder` at the end.

    Raises:
        UserError: `folder` is a file, or holds other work or other files; nothing is changed then, nor where drawing
            fails.
    """
    work = work_of(command, inputs, options or {})
    # A relative path stays true where both are moved together, and tells nothing of this machine's folders.
    work["of"] = os.path.relpath(of.resolve(), folder.resolve()) if isinstance(of, Path) else of
    found = _recorded_work(folder, flag)
    if found is not None and [found.get(name) for name in ("command", "of")] != [command, work["of"]]:
        raise UserError(f"{flag}: {folder} holds other work ({_described(found)}); {FOLDER_ADVICE}")
    earlier = {name for name in _files(found or {}) if (folder / name).is_file()}
    same = options is not None and found is not None and found.get("skope") == __version__
    stale = set() if same and not work_differences(found, work) else earlier
    with replacing_folder(folder, keep=False) as drawn:
        yield drawn
        new = {path.name for path in drawn.iterdir()}
        for name in sorted(new - earlier):
            if (folder / name).exists():
                raise UserError(f"{flag}: {folder / name} is there already, and is no earlier look's; {FOLDER_ADVICE}")
        # Whenever this is interrupted, the files that lie there are among those that the record names.
        _write_record(folder, {**work, "files": sorted(earlier | new)})
        for name in stale - new:
            (folder / name).unlink(missing_ok=True)
        for name in new:
            (drawn / name).replace(folder / name)
        _write_record(folder, {**work, "files": sorted((earlier - stale) | new)})


def work_of(command: str, inputs: Iterable[Path], options: Mapping[str, Any]) -> dict[str, Any]:
    """Identify a work, as `work.json` does.

    Args:
        command: The command, as in "skope eval track".
        inputs: Files, by whose contents the work is identified.
        options: JSON values by name.
    """
    parts = {"command": command, "inputs": {str(path): sha256_of(path) for path in inputs}, "options": dict(options)}
    work: dict[str, Any] = parse_json(json_bytes(parts))
    return work


def work_differences(held: Any, wanted: Mapping[str, Any]) -> str:
    """Differences of the work `held` from `wanted` (as `work_of` gives it), in words; empty for the same work."""
    if not isinstance(held, dict) or held.get("command") != wanted["command"]:
        return _described(held)
    inputs, options = (held[name] if isinstance(held.get(name), dict) else {} for name in ("inputs", "options"))
    # Files may have moved since: their contents decide, not their paths.
    words = [f"not of {path}" for path, digest in wanted["inputs"].items() if digest not in inputs.values()]
    if not words and len(inputs) != len(wanted["inputs"]):
        words.append("of more files")
    return "; ".join([*words, *changed_options(options, wanted["options"])])


def changed_options(held: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """The options that differ, in words, by name; one that is missing on a side is None there."""
    pairs = [(name, held.get(name), wanted.get(name)) for name in sorted({*held, *wanted})]
    return [f"{name} = {was}, now {now}" for name, was, now in pairs if was != now]


def write_new(path: Path, data: bytes) -> None:
    """Write a file where there is none; one of the same content is left as it is, and another one a UserError."""
    if not os.path.lexists(path):
        write_bytes(path, data)
        return
    check_file(path)
    if path.read_bytes() != data:
        raise UserError(f"{path}: {_OTHER_FILE}")


def check_file(path: Path, begins: Callable[[bytes], bool] = lambda _: True) -> None:
    """Raise a UserError where `write_new` will find something else than a file that may be the same one.

    `begins` says whether the first bytes of a file, at most 16, may be those of what will be written.
    """
    if file_there := file_in_place_of(path.parent):
        raise UserError(f"{path}: cannot be written: {file_there} is a file")
    if not os.path.lexists(path):
        return
    if path.is_dir():
        raise UserError(f"{path}: is a folder; choose another file")
    if not path.is_file():
        raise UserError(f"{path}: is there already, and no regular file; choose another file")
    with path.open("rb") as file:
        if not begins(file.read(16)):
            raise UserError(f"{path}: {_OTHER_FILE}")


def move_new(source: Path, target: Path) -> None:
    """Move a file to where none is; one of the same content is left as it is, and another one a UserError."""
    if not target.exists():
        source.replace(target)
    elif not same_content(source, target):
        raise UserError(f"{target}: {_OTHER_FILE}")


def _recorded_work(folder: Path, flag: str) -> Any:
    """Content of a folder's `work.json`; None where the folder is missing or holds nothing else.

    Raises UserError for a file, and for a folder with files of which no `work.json` says what they are.
    """
    if file := file_in_place_of(folder):
        raise UserError(f"{flag}: {file} is a file, expected a folder")
    if not folder.is_dir() or all(path.name == WORK_FILE for path in folder.iterdir()):
        return None
    if not (folder / WORK_FILE).is_file():
        raise UserError(f"{flag}: {folder} holds other files; {FOLDER_ADVICE}")
    try:
        found = read_json(folder / WORK_FILE)
    except UserError as error:
        raise UserError(f"{flag}: {folder} holds other work ({error}); {FOLDER_ADVICE}") from None
    return found if isinstance(found, dict) else {}


def _write_record(folder: Path, work: Mapping[str, Any]) -> dict[str, Any]:
    """Write `work.json`; returns what it holds."""
    signed = {**work, "skope": __version__, "date": datetime.now(UTC).date().isoformat()}
    write_json(folder / WORK_FILE, signed)
    return signed


def _described(held: Any) -> str:
    """The work that `work.json` names, in words: of which command, of what."""
    command, of = (held.get(name) if isinstance(held, dict) else None for name in ("command", "of"))
    return (f"of `{command}`" if command else "of another command") + (f", a look at {of}" if of else "")


def _files(held: Mapping[str, Any]) -> set[str]:
    """Names of the files that an earlier call of `replaceable_output` wrote; a path that leads elsewhere is none."""
    names = held.get("files")
    return (
        {name for name in names if isinstance(name, str) and name == Path(name).name}
        if isinstance(names, list)
        else set()
    )
