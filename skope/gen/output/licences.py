"""Licences of datasets: their names and addresses, and the licence of a dataset made of several.

The rules for combinations are those of Creative Commons. Share-alike material can only be used under its own licence;
NonCommercial terms are therefore incompatible with plain share-alike. Material under NoDerivatives can only be combined
with material under the same terms. Other texts are not judged: they are listed side by side, unless one of the licences
must apply to everything.
"""

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from skope.errors import UserError

DEFAULT_LICENCE: Final = "CC BY 4.0"
LICENCE_ADDRESSES: Final = {
    "CC0 1.0": "https://creativecommons.org/publicdomain/zero/1.0/",
    "CC BY 4.0": "https://creativecommons.org/licenses/by/4.0/",
    "CC BY-SA 4.0": "https://creativecommons.org/licenses/by-sa/4.0/",
    "CC BY-NC 4.0": "https://creativecommons.org/licenses/by-nc/4.0/",
    "CC BY-NC-SA 4.0": "https://creativecommons.org/licenses/by-nc-sa/4.0/",
    "CC BY-ND 4.0": "https://creativecommons.org/licenses/by-nd/4.0/",
    "CC BY-NC-ND 4.0": "https://creativecommons.org/licenses/by-nc-nd/4.0/",
    "ODC-By 1.0": "https://opendatacommons.org/licenses/by/1-0/",
    "ODbL 1.0": "https://opendatacommons.org/licenses/odbl/1-0/",
    "CDLA-Permissive-2.0": "https://cdla.dev/permissive-2-0/",
}

CC_CODE = re.compile(
    r"CC[ -]?(?:(?P<zero>0)|BY(?P<terms>(?:-(?:NC|SA|ND))*))(?:[ -](?P<version>\d\.\d))?(?![\w-])", re.I
)
CC_TERMS = ("NC", "SA", "ND")
CC_ADDRESS = re.compile(
    r"creativecommons\.org/(?:licenses/(?P<terms>[a-z-]+)|publicdomain/(?P<zero>zero))/(?P<version>\d\.\d)", re.I
)
CC_WORDS = {"noncommercial": "NC", "sharealike": "SA", "noderiv": "ND"}
NOT_STATED: Final = "not stated"
LICENCE_SEPARATOR: Final = " | "
"""Separator between licences that each apply to a part of a dataset."""
LONG_LICENCE = 200
"""Number of characters above which a licence is named by its first line."""

Terms = frozenset[str]


def named(text: str) -> str:
    """Return a licence as a card states it: one of `LICENCE_ADDRESSES` in any spelling, or another line of text."""
    text = " ".join(text.split())
    if not text:
        raise UserError(f"--licence: expected the name of a licence, such as {DEFAULT_LICENCE!r}")
    known = {_bare(name): name for name in LICENCE_ADDRESSES}
    return known.get(_bare(text), text)


def _bare(name: str) -> str:
    return "".join(letter for letter in name.casefold() if letter.isalnum())


def in_text(text: str) -> str:
    """Return the licence in a file like LICENCE.txt as one line; for a long text, its first non-empty line."""
    lines = [" ".join(line.split()) for line in text.removeprefix("\ufeff").splitlines()]
    words = [line for line in lines if line]
    whole = " ".join(words)
    if not words:
        return NOT_STATED
    return whole if len(words) == 1 or len(whole) <= LONG_LICENCE else words[0]


def in_coco(document: Mapping[str, Any]) -> list[str]:
    """Return the licences in a COCO file: those of `licenses` that its images name, and the one in `info`.

    If an image names none of them, all of them apply.
    """
    records = {r.get("id"): r for r in _list(document.get("licenses")) if isinstance(r, Mapping)}
    named = [i.get("license") for i in _list(document.get("images")) if isinstance(i, Mapping)]
    used = dict.fromkeys(key for key in named if isinstance(key, int | str))
    all_known = bool(named) and None not in named and used.keys() <= records.keys()
    found = [_in_record(record) for key, record in records.items() if key in used or not all_known]
    info = document.get("info")
    for holder in (document, info if isinstance(info, Mapping) else {}):
        found += [_in_record({"name": holder.get(name)}) for name in ("license", "licence")]
    return list(dict.fromkeys(filter(None, found)))


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


def _in_record(record: Mapping[str, Any]) -> str:
    """Return the name of the licence in a record with `name` and `url`; empty if there is none."""
    name, url = (" ".join(str(record.get(key) or "").split())[:LONG_LICENCE] for key in ("name", "url"))
    address = CC_ADDRESS.search(url) or CC_ADDRESS.search(name)
    code = ""
    if address is not None:
        code = f"CC0 {address['version']}" if address["zero"] else f"CC {address['terms'].upper()} {address['version']}"
    if not code and re.match(r"attribution\b", name, re.I):
        squeezed = re.sub(r"[\s-]", "", name.lower())
        version = re.search(r"\d\.\d", name)
        code = "-".join(["CC BY", *(term for word, term in CC_WORDS.items() if word in squeezed)])
        code += f" {version[0]}" if version else ""
    if code and licence_terms(name) is not None and licence_terms(name) != licence_terms(code):
        return f"{name}{LICENCE_SEPARATOR}{code}"
    return code or (named(name) if name else url)


def joint_licence(licences: Iterable[str]) -> str:
    """Return the different licences of a dataset's parts, side by side."""
    parts = dict.fromkeys(part for licence in licences for part in licence.split(LICENCE_SEPARATOR))
    if len(parts) > 1:
        parts.pop(NOT_STATED, None)
    return LICENCE_SEPARATOR.join(parts) or NOT_STATED


def licence_terms(licence: str) -> Terms | None:
    """Return the conditions (BY, NC, SA, ND) of a Creative Commons licence; None for any other text.

    The licence must be at the start: "what is drawn is CC0, the photograph ..." is not CC0.
    """
    match = CC_CODE.match(licence)
    if match is None:
        return None
    return frozenset() if match["zero"] else frozenset({"BY", *match["terms"].upper().split("-")} - {""})


def united(licences: Sequence[str]) -> str:
    """Return the licence of a dataset with parts under `licences`.

    Raises UserError if two licences are incompatible.
    """
    different = list(dict.fromkeys(licences))
    parts = {licence: licence.split(LICENCE_SEPARATOR) for licence in different}
    known = {part: licence_terms(part) for part_licences in parts.values() for part in part_licences}
    pairs = (
        pair for first, second in itertools.permutations(parts.values(), 2) for pair in itertools.product(first, second)
    )
    for licence, other_licence in pairs:
        terms, other_terms = known[licence], known[other_licence]
        alone = terms is not None and "ND" in terms and other_terms != terms
        # Share-alike material stays under its own licence, so the other part must not add conditions.
        alike = terms is not None and "SA" in terms and (other_terms is None or not other_terms <= terms)
        if alone or alike:
            raise UserError(f"licence: {licence!r} cannot be combined with {other_licence!r}")
    if len(different) == 1 or None in known.values():
        return LICENCE_SEPARATOR.join(known)
    everything = frozenset[str]().union(*(terms for terms in known.values() if terms is not None))
    return _name_of(everything, [licence for licence, terms in known.items() if terms == everything])


def _name_of(terms: Terms, as_stated: Sequence[str]) -> str:
    """Return the text of the part that has exactly these terms, or the name of such a licence."""
    if as_stated:
        return as_stated[0]
    return "-".join(["CC BY", *(word for word in CC_TERMS if word in terms)]) + " 4.0"
