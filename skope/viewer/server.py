"""Server of the viewer: the page, its JSON documents, and images by number."""

import re
from typing import Final

from skope.errors import UserError
from skope.files.json_files import json_bytes
from skope.terminal.console import Console
from skope.viewer.collection import Collection
from skope.viewer.documents import SCORE_STEPS_KEPT, Documents
from skope.viewer.local_server import (
    CSS_TYPE,
    HTML_TYPE,
    JSON_TYPE,
    SCRIPT_TYPE,
    SHARED_FILES,
    Answer,
    LocalHandler,
    LocalServer,
    bound_to,
    read_resource,
    serve_until_stopped,
    served_page,
)

IMAGE_ADDRESS: Final = re.compile(r"/images/([0-9]{1,9})(\.json)?")
SCORES_ADDRESS: Final = re.compile(r"/scores/([0-9]{1,4})\.json")
_SERVED_FILES: Final = SHARED_FILES | {
    "/viewer.css": ("skope.viewer", "viewer.css", CSS_TYPE),
    "/viewer.js": ("skope.viewer", "viewer.js", SCRIPT_TYPE),
}


def serve(collection: Collection, port: int | None, console: Console) -> None:
    """Serve a collection to the browser until Ctrl-C; the address is printed on one line.

    Args:
        collection: The images.
        port: Port; None: `SERVER_LIMITS.port`, or any free port if that is in use.
        console: Receives the address.

    Raises:
        UserError: `port` cannot be used.
    """
    documents = Documents(collection)
    if not len(documents):
        raise UserError(f"{collection.title}: has no images")
    serve_until_stopped(bound(documents, port), collection.title, console)


def bound(documents: Documents, port: int | None) -> "ViewerServer":
    """Return a running server; see `serve`."""
    return bound_to(lambda free: ViewerServer(documents, free), port)


class ViewerServer(LocalServer):
    """Server of a collection's documents."""

    def __init__(self, documents: Documents, port: int) -> None:
        self.documents = documents
        self.index = json_bytes(documents.index())
        super().__init__(port, _Handler)


class _Handler(LocalHandler):
    server: ViewerServer

    def answer_to(self, path: str) -> Answer | None:
        documents = self.server.documents
        if path == "/":
            return HTML_TYPE, served_page("viewer/viewer.html", "viewer")
        if file := _SERVED_FILES.get(path):
            return file[2], read_resource(*file[:2])
        if path == "/index.json":
            return JSON_TYPE, self.server.index
        if (
            (scores := SCORES_ADDRESS.fullmatch(path))
            and int(scores[1]) <= SCORE_STEPS_KEPT.steps
            and documents.has_predictions
        ):
            return JSON_TYPE, json_bytes(documents.scores(int(scores[1])))
        if (image := IMAGE_ADDRESS.fullmatch(path)) and (number := int(image[1])) < len(documents):
            if image[2]:
                return JSON_TYPE, json_bytes(documents.details(number))
            picture = documents.picture(number)
            return picture.media_type, picture.data
        return None
