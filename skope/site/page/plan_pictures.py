"""The pictures of plans that the page shows: one that the site file names, and those that the user has loaded."""

import hashlib
from pathlib import Path
from typing import Any, Final

from skope.errors import UserError
from skope.files.atomic import replacing
from skope.files.reading import read_bytes
from skope.viewer.pictures import Picture

_KINDS: Final = (
    (b"\x89PNG\r\n\x1a\n", ".png", "image/png"),
    (b"\xff\xd8\xff", ".jpg", "image/jpeg"),
    (b"RIFF", ".webp", "image/webp"),
)
"""First bytes, ending and type of the files that every browser shows."""
_LARGEST: Final = 24 << 20


class PlanPictures:
    """Pictures by the SHA-256 of their bytes, by which the page names them: a name of the page is never a path."""

    def __init__(self) -> None:
        self._pictures: dict[str, Picture] = {}
        self._files: dict[str, str] = {}

    def hold(self, data: bytes) -> str:
        """Keep a picture's bytes; returns its name. Raises UserError where they are no picture for browsers."""
        kind = next((media for begin, _, media in _KINDS if data.startswith(begin)), None)
        if kind is None or (kind == "image/webp" and data[8:12] != b"WEBP"):
            what = "a PDF: save its page as PNG" if data.startswith(b"%PDF") else "expected a PNG, JPEG or WebP picture"
            raise UserError(what)
        if len(data) > _LARGEST:
            raise UserError(f"expected a picture of up to {_LARGEST >> 20} MB")
        name = hashlib.sha256(data).hexdigest()
        self._pictures.setdefault(name, Picture(media_type=kind, data=data))
        return name

    def hold_file(self, path: Path, as_written: str) -> str | None:
        """Keep the picture of a file, which the site file names `as_written`; None where there is none."""
        try:
            name = self.hold(read_bytes(path))
        except UserError:
            return None
        self._files[name] = as_written
        return name

    def picture(self, name: Any) -> Picture | None:
        """The picture of a name."""
        return self._pictures.get(name) if isinstance(name, str) else None

    def saved_beside(self, site: Path, name: Any) -> str | None:
        """Name of a picture in the site file; the picture is written beside that where it is not there yet.

        No other file is overwritten. None where there is no such picture.
        """
        picture = self.picture(name)
        if picture is None:
            return None
        if name in self._files:
            return self._files[name]
        suffix = next(suffix for _, suffix, media in _KINDS if media == picture.media_type)
        number = 1
        while True:
            path = site.with_name(f"{site.stem}_plan{'' if number == 1 else f'_{number}'}{suffix}")
            if not path.exists():
                with replacing(path) as part:
                    part.write_bytes(picture.data)
                break
            if path.is_file() and read_bytes(path) == picture.data:
                break
            number += 1
        self._files[name] = path.name
        return path.name
