"""Save a site file: changed values are replaced; comments, order and unknown keys are kept.

A file that has been saved elsewhere since it was read is not overwritten.
"""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from skope.errors import UserError, first_line
from skope.files.atomic import decoded, locked, read_bytes, replacing
from skope.site.site_file import SiteFile, parse_site


def save_site(path: Path, changes: Mapping[str, Any], revision: str | None) -> SiteFile:
    """Change keys of a site file, and return the new contents.

    Args:
        path: The file; a symbolic link is kept.
        changes: New values of top-level keys: texts, numbers, times, lists, tables. The keys of a table are changed
            one by one, and missing ones are kept; None removes a key. Rows of a list of tables are matched by `name`
            and changed in the same way; unmatched rows are removed.
        revision: `SiteFile.revision` of the file when it was read; None: there was no file.

    Raises:
        UserError: The file has been saved elsewhere since, it cannot be written, or the result would not be a valid
            site file. The file is then unchanged.
    """
    whole = path.resolve()
    if not whole.parent.is_dir():
        raise UserError(f"{path}: {whole.parent}: no such folder")
    lock = whole.with_name(f".{whole.name}.lock")
    try:
        with locked(lock, f"{path}: is being saved by another window; try again"):
            before = _unchanged(path, whole, revision)
            data = _changed(path, before, changes)
            site = parse_site(path, data)
            if data != before:
                with replacing(whole) as part:
                    part.write_bytes(data)
                    if before is not None:
                        part.chmod(whole.stat().st_mode)
            return site
    except OSError as error:  # of the lock file
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from None


def _unchanged(path: Path, whole: Path, revision: str | None) -> bytes | None:
    """Return the file's bytes; None if there is no file. Raises UserError if the bytes do not match the revision."""
    data = read_bytes(whole) if whole.exists() else None
    if (None if data is None else hashlib.sha256(data).hexdigest()) != revision:
        raise UserError(
            f"{path}: {'exists already' if revision is None else 'has been changed since it was read'}; "
            "nothing was saved: open it again"
        )
    return data


def _changed(path: Path, data: bytes | None, changes: Mapping[str, Any]) -> bytes:
    import tomlkit
    from tomlkit.exceptions import TOMLKitError

    try:
        document = tomlkit.parse(decoded(data or b""))
        _merge(document, changes, inline=False)
        return tomlkit.dumps(document).encode()
    except (TOMLKitError, ValueError, TypeError, RecursionError, UnicodeDecodeError) as error:
        line = first_line(error)
        raise UserError(f"{path}: cannot be saved: {line}") from None


def _merge(table: Any, changes: Mapping[str, Any], *, inline: bool) -> None:
    """Change a tomlkit table in place."""
    for key, value in changes.items():
        if value is None:
            if key in table:
                table.remove(key)
        elif key not in table:
            if not _only_removes(value):
                table[key] = _made(value, inline=inline)
        elif _plain(table[key]) == value and type(_plain(table[key])) is type(value):
            continue
        elif isinstance(value, Mapping) and isinstance(table[key], Mapping):
            _merge(table[key], value, inline=inline or _is_inline(table[key]))
        elif _tables(value) and _tables(_plain(table[key])):
            _merge_rows(table, key, value)
        else:
            table[key] = _made(value, inline=True) if not isinstance(value, Mapping) else _made(value, inline=inline)


def _merge_rows(table: Any, key: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Change a list of tables; rows keep their other keys."""
    from tomlkit.items import AoT

    old = table[key]
    before = [_plain(row) for row in old]
    partner = _partners(before, rows)
    kept = [k for k in partner if k is not None]
    inline = not isinstance(old, AoT)
    if kept == sorted(kept) and None not in partner[: len(kept)]:
        for row, k in zip(rows, kept, strict=False):
            _merge(old[k], row, inline=True)
        for k in sorted(set(range(len(before))) - set(kept), reverse=True):
            del old[k]
        for row in rows[len(kept) :]:
            old.append(_made(row, inline=inline))
        return
    whole = [{**(before[k] if k is not None else {}), **row} for row, k in zip(rows, partner, strict=True)]
    table[key] = _made(whole, inline=inline)


def _partners(before: Sequence[Mapping[str, Any]], rows: Sequence[Mapping[str, Any]]) -> list[int | None]:
    """Return the index of each row's earlier version: same name, or same place and content; None: it is new."""

    def without_name(row: Mapping[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in row.items() if key != "name" and value is not None}

    at = {row["name"]: k for k, row in enumerate(before) if "name" in row}
    out = [at.get(row["name"]) if "name" in row else None for row in rows]
    for i, row in enumerate(rows):
        if out[i] is not None or i in out or i >= len(before):
            continue
        nameless = "name" not in row and "name" not in before[i]
        if nameless or without_name(row).items() <= without_name(before[i]).items():
            out[i] = i
    return out


def _made(value: Any, *, inline: bool) -> Any:
    """Return a tomlkit value: tables one below the other, or within a line; lists of tables with a line each."""
    import tomlkit

    if isinstance(value, Mapping):
        made = tomlkit.inline_table() if inline else tomlkit.table()
        for key, entry in value.items():
            if entry is not None:
                made[key] = _made(entry, inline=inline or not isinstance(entry, Mapping))
        return made
    if _tables(value):
        if not inline:
            rows = tomlkit.aot()
            for row in value:
                rows.append(_made(row, inline=False))
            return rows
        listed = tomlkit.array().multiline(True)
        for row in value:
            listed.append(_made(row, inline=True))
        return listed
    return tomlkit.item(value)


def _only_removes(value: Any) -> bool:
    """Return whether a table only removes keys, so that there is nothing to add."""
    return isinstance(value, Mapping) and all(entry is None for entry in value.values())


def _tables(value: Any) -> bool:
    return isinstance(value, list | tuple) and len(value) > 0 and all(isinstance(row, Mapping) for row in value)


def _is_inline(table: Any) -> bool:
    from tomlkit.items import InlineTable

    return isinstance(table, InlineTable)


def _plain(value: Any) -> Any:
    return value.unwrap() if hasattr(value, "unwrap") else value
