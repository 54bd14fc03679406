"""Output folders: the same run resumes in its folder; a folder with the output of another run is rejected.

`work.json` in an output folder records the command, its inputs and options, the version of skope and the date.
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
FOLDER_ADVICE: Final = "choose another folder, or move its content away"
_LONGEST_VALUE: Final = 100
"""Maximum length of an option's value in a message, characters. A camera or a list of keypoints is longer."""
_CONTENT_DIFFERS: Final = "exists with other content; choose another file or move it away"


def claim_output(folder: Path, command: str, inputs: Iterable[Path], options: Mapping[str, Any]) -> dict[str, Any]:
    """Make `folder` the output folder of this run by writing its `work.json`.

    The folder must be missing, empty, or have a `work.json` of the same run. That run is then resumed or repeated.
    Partial files of a killed run are removed.

    Args:
        folder: The output folder.
        command: The command that writes, for example "skope eval".
        inputs: Files whose contents identify the run.
        options: JSON values that identify the run.

    Returns:
        The content of `work.json`.

    Raises:
        UserError: `folder` is a file, or holds the output of another run or other files. Nothing is written.
    """
    work = work_of(command, inputs, options)
    found = _recorded_work(folder, "--out")
    if found is not None and (different := work_differences(found, work)):
        raise UserError(f"--out: {folder} holds the output of another run ({different}); {FOLDER_ADVICE}")
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
    """Write images and pages that may replace those of an earlier call, all together when all are complete.

    They replace only files that the same command wrote for the same subject.

    Args:
        folder: The output folder.
        command: The command that writes, as in `work.json`.
        of: The subject: the path of a file or folder, or a name.
        inputs: Files whose contents decide what is written.
        options: JSON values. If given, earlier files with the same `options`, contents of `inputs` and version of skope
            are kept beside the new ones; others are removed.
        flag: The option that gave `folder`, for messages.

    Yields:
        An empty folder to write into. Its files move to `folder` at the end.

    Raises:
        UserError: `folder` is a file, or holds the output of another run or other files. Nothing is changed then, nor
            if writing fails.
    """
    work = work_of(command, inputs, options or {})
    # A relative path stays valid if both move together, and does not reveal folders of this machine.
    work["of"] = os.path.relpath(of.resolve(), folder.resolve()) if isinstance(of, Path) else of
    found = _recorded_work(folder, flag)
    if found is not None and [found.get(name) for name in ("command", "of")] != [command, work["of"]]:
        raise UserError(f"{flag}: {folder} holds the output of another run ({_described(found)}); {FOLDER_ADVICE}")
    earlier = {name for name in _files(found or {}) if (folder / name).is_file()}
    same = options is not None and found is not None and found.get("skope") == __version__
    stale = set() if same and not work_differences(found, work) else earlier
    with replacing_folder(folder, keep=False) as drawn:
        yield drawn
        new = {path.name for path in drawn.iterdir()}
        for name in sorted(new - earlier):
            if (folder / name).exists():
                raise UserError(
                    f"{flag}: {folder / name} exists and was not written by an earlier call; {FOLDER_ADVICE}"
                )
        # The record names all files at any time, so that an interrupted call leaves none unnamed.
        _write_record(folder, {**work, "files": sorted(earlier | new)})
        for name in stale - new:
            (folder / name).unlink(missing_ok=True)
        for name in new:
            (drawn / name).replace(folder / name)
        _write_record(folder, {**work, "files": sorted((earlier - stale) | new)})


def work_of(command: str, inputs: Iterable[Path], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the identity of a run, which `work.json` stores.

    Args:
        command: The command, for example "skope eval track".
        inputs: Files. Their contents identify the run.
        options: JSON values by name.
    """
    parts = {"command": command, "inputs": {str(path): sha256_of(path) for path in inputs}, "options": dict(options)}
    work: dict[str, Any] = parse_json(json_bytes(parts))
    return work


def work_differences(held: Any, wanted: Mapping[str, Any]) -> str:
    """Describe how the run `held` differs from `wanted` (see `work_of`); return an empty text for the same run."""
    if not isinstance(held, dict) or held.get("command") != wanted["command"]:
        return _described(held)
    inputs, options = (held[name] if isinstance(held.get(name), dict) else {} for name in ("inputs", "options"))
    # Contents are compared, not paths: files may have moved.
    words = [f"not of {path}" for path, digest in wanted["inputs"].items() if digest not in inputs.values()]
    if not words and len(inputs) != len(wanted["inputs"]):
        words.append("of more files")
    return "; ".join([*words, *changed_options(options, wanted["options"])])


def changed_options(held: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Describe the options that differ, by name; a missing option counts as None. Long values are not shown."""
    pairs = [(name, held.get(name), wanted.get(name)) for name in sorted({*held, *wanted})]
    return [
        f"{name} = {was}, now {now}" if max(len(str(was)), len(str(now))) <= _LONGEST_VALUE else f"{name} differs"
        for name, was, now in pairs
        if was != now
    ]


def write_new(path: Path, data: bytes) -> None:
    """Write a file. An existing file with the same content is kept; one with other content is a UserError."""
    if not os.path.lexists(path):
        write_bytes(path, data)
        return
    check_file(path)
    if path.read_bytes() != data:
        raise UserError(f"{path}: {_CONTENT_DIFFERS}")


def check_file(path: Path, begins: Callable[[bytes], bool] = lambda _: True) -> None:
    """Raise a UserError if `write_new` will find a file that cannot be the same one.

    `begins` returns whether the first bytes of an existing file (at most 16) fit the content to be written.
    """
    if blocking_file := file_in_place_of(path.parent):
        raise UserError(f"{path}: cannot be written: {blocking_file} is a file")
    if not os.path.lexists(path):
        return
    if path.is_dir():
        raise UserError(f"{path}: is a folder; choose another file")
    if not path.is_file():
        raise UserError(f"{path}: exists and is not a regular file; choose another file")
    with path.open("rb") as file:
        if not begins(file.read(16)):
            raise UserError(f"{path}: {_CONTENT_DIFFERS}")


def move_new(source: Path, target: Path) -> None:
    """Move a file. An existing target with the same content is kept; one with other content is a UserError."""
    if not target.exists():
        source.replace(target)
    elif not same_content(source, target):
        raise UserError(f"{target}: {_CONTENT_DIFFERS}")


def _recorded_work(folder: Path, flag: str) -> Any:
    """Return the content of a folder's `work.json`; None if the folder is missing or holds nothing else.

    Raises UserError if the path is a file, or a folder that holds files but no `work.json`.
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
        raise UserError(f"{flag}: {folder} holds the output of another run ({error}); {FOLDER_ADVICE}") from None
    return found if isinstance(found, dict) else {}


def _write_record(folder: Path, work: Mapping[str, Any]) -> dict[str, Any]:
    """Write `work.json` and return its content."""
    signed = {**work, "skope": __version__, "date": datetime.now(UTC).date().isoformat()}
    write_json(folder / WORK_FILE, signed)
    return signed


def _described(held: Any) -> str:
    """Describe the run of a `work.json`: its command and subject."""
    command, of = (held.get(name) if isinstance(held, dict) else None for name in ("command", "of"))
    return (f"`{command}`" if command else "another command") + (f" of {of}" if of else "")


def _files(held: Mapping[str, Any]) -> set[str]:
    """Return the names of files that an earlier `replaceable_output` wrote, without paths that lead elsewhere."""
    names = held.get("files")
    return (
        {name for name in names if isinstance(name, str) and name == Path(name).name}
        if isinstance(names, list)
        else set()
    )
