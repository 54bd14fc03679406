"""Output folders belong to the work that began them: the same work goes on in them, other work is refused.

`work.json` in such a folder says which command made it, of what, with which version of skope and when.
"""

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from skope import __version__
from skope.errors import UserError
from skope.files import json_bytes, parse_json, read_json, sha256_of, write_bytes, write_json

WORK: Final = "work.json"


def claim(folder: Path, command: str, inputs: Iterable[Path], options: Mapping[str, Any]) -> dict[str, Any]:
    """Take `folder` for a command, or refuse to.

    Taken is a folder that is missing or empty, or whose `work.json` names the same command, contents of `inputs`
    (files) and `options` (JSON values); what the folder holds is then gone on with, or made again.

    Returns what `work.json` holds. Raises UserError for a file, and for a folder with other work or other files in it;
    nothing is written then.
    """
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--out: {folder} is a file, expected a folder")
    told = {"command": command, "inputs": {str(path): sha256_of(path) for path in inputs}, "options": dict(options)}
    work: dict[str, Any] = parse_json(json_bytes(told))
    held = folder / WORK
    if folder.is_dir() and any(path.name != WORK for path in folder.iterdir()):
        if not held.is_file():
            raise UserError(f"--out: {folder} holds other files; choose another folder, or remove what is there")
        found = read_json(held)
        different = _differences(found, work)
        if different:
            raise UserError(
                f"--out: {folder} holds other work ({different}); choose another folder, or remove what is there"
            )
    work |= {"skope": __version__, "date": datetime.now(UTC).date().isoformat()}
    write_json(held, work)
    return work


def _differences(held: Any, wanted: Mapping[str, Any]) -> str:
    """What of `wanted` a folder was not made with, in words; empty where it was made with all of it."""
    if not isinstance(held, dict) or held.get("command") != wanted["command"]:
        command = held.get("command") if isinstance(held, dict) else None
        return f"of `{command}`" if command else "of another command"
    inputs, options = (held[name] if isinstance(held.get(name), dict) else {} for name in ("inputs", "options"))
    # Files may have moved: what they hold decides.
    words = [f"not of {path}" for path, digest in wanted["inputs"].items() if digest not in inputs.values()]
    if not words and len(inputs) != len(wanted["inputs"]):
        words.append("of more files")
    return "; ".join([*words, *changed(options, wanted["options"])])


def changed(held: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """The options that differ, in words, by name; one that is missing on a side is None there."""
    pairs = [(name, held.get(name), wanted.get(name)) for name in sorted({*held, *wanted})]
    return [f"{name} = {was}, now {now}" for name, was, now in pairs if was != now]


def write_new(path: Path, data: bytes) -> None:
    """Write a file where there is none; one of the same content is left as it is, and another one a UserError."""
    if path.is_file():
        if path.read_bytes() == data:
            return
        raise UserError(f"{path}: is there already, with other content; choose another file with --out, or remove it")
    write_bytes(path, data)
