"""Licences of datasets: their names and addresses, and which one holds for a dataset made of several.

Creative Commons' own rules for what may be built from what: share-alike material may only go into something under its
own licence, which NonCommercial beside plain share-alike is not, and material under NoDerivatives goes into nothing
else. Other words are not judged: they stand side by side, unless one of the licences demands to hold for all.
"""

import itertools
import re
from collections.abc import Sequence
from typing import Final

from skope.errors import UserError

DEFAULT: Final = "CC BY 4.0"
ADDRESSES: Final = {
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

_CODE = re.compile(r"CC[ -]?(?:(?P<zero>0)|BY(?P<terms>(?:-(?:NC|SA|ND))*))(?:[ -](?P<version>\d\.\d))?(?![\w-])", re.I)
_ORDER = ("NC", "SA", "ND")

Terms = frozenset[str]


def named(text: str) -> str:
    """A licence as a card states it: one of `ADDRESSES` however its name is written, or any other line of text."""
    text = " ".join(text.split())
    if not text:
        raise UserError(f"--licence: expected a licence's name, such as {DEFAULT!r}")
    known = {_bare(name): name for name in ADDRESSES}
    return known.get(_bare(text), text)


def _bare(name: str) -> str:
    return "".join(letter for letter in name.casefold() if letter.isalnum())


def terms_of(licence: str) -> Terms | None:
    """The conditions (BY, NC, SA, ND) of a Creative Commons licence; None for any other text.

    The licence must stand at the beginning: "what is drawn is CC0, the photograph ..." is not CC0.
    """
    match = _CODE.match(licence)
    if match is None:
        return None
    return frozenset() if match["zero"] else frozenset({"BY", *match["terms"].upper().split("-")} - {""})


def united(licences: Sequence[str]) -> str:
    """The licence of a dataset made of parts under `licences`; a UserError says which two exclude each other."""
    different = list(dict.fromkeys(licences))
    known = {licence: terms_of(licence) for licence in different}
    for (licence, terms), (other, others) in itertools.permutations(known.items(), 2):
        alone = terms is not None and "ND" in terms and others != terms
        # What is shared alike ends under its own licence, so that nothing else may ask for more.
        alike = terms is not None and "SA" in terms and (others is None or not others <= terms)
        if alone or alike:
            raise UserError(f"licence: {licence!r} does not allow to be joined with {other!r}")
    if len(different) == 1 or None in known.values():
        return " | ".join(different)
    everything = frozenset[str]().union(*(terms for terms in known.values() if terms is not None))
    return _name_of(everything, [licence for licence, terms in known.items() if terms == everything])


def _name_of(terms: Terms, as_stated: Sequence[str]) -> str:
    """The words of the part that has just these terms, or the licence's name."""
    if as_stated:
        return as_stated[0]
    return "-".join(["CC BY", *(word for word in _ORDER if word in terms)]) + " 4.0"
