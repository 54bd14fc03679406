"""Joining what two windows have made of one document."""

from collections.abc import Mapping
from typing import Any

from skope.site.page.document_values import entries_of
from skope.site.page.drawings import DRAWN
from skope.site.page.marks import KINDS


def merged_document(base: Mapping[str, Any], mine: Mapping[str, Any], theirs: Mapping[str, Any]) -> dict[str, Any]:
    """One document with the changes of both.

    Where both have changed the same entry, mine counts. Entries are told by their names, or by their content.

    Args:
        base: What both began with.
        mine: What this window made of it.
        theirs: What is saved now.
    """
    out = dict(mine)
    for kind in (*KINDS, *DRAWN):
        own, other, before = (_by_name(document, kind) for document in (mine, theirs, base))
        rows = []
        for name, entry in own.items():
            changed_here = entry != before.get(name)
            if name in other:
                rows.append(entry if changed_here else other[name])
            elif changed_here:  # new here, or taken away there but changed here
                rows.append(entry)
        rows += [entry for name, entry in other.items() if name not in own and entry != before.get(name)]
        out[kind] = rows
    for key in ("camera", "known", "world", "plan", "time_zone", "start"):
        out[key] = mine.get(key) if mine.get(key) != base.get(key) else theirs.get(key)
    return out


def _by_name(document: Mapping[str, Any], kind: str) -> dict[str, Mapping[str, Any]]:
    return {str(entry.get("name") or entry): entry for entry in entries_of(document, kind)}
