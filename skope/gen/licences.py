"""Names of licences that datasets are often under, with their addresses."""

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


def named(text: str) -> str:
    """A licence as a card states it: one of `ADDRESSES` however its name is written, or any other line of text."""
    text = " ".join(text.split())
    if not text:
        raise UserError(f"--licence: expected a licence's name, such as {DEFAULT!r}")
    known = {_bare(name): name for name in ADDRESSES}
    return known.get(_bare(text), text)


def _bare(name: str) -> str:
    return "".join(letter for letter in name.casefold() if letter.isalnum())
