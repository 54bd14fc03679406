"""Server of the page of `skope eval site`: images, answers to the page's document, and saving."""

import base64
import os
import re
import shlex
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final
from zoneinfo import available_timezones

from skope.camera.evidence import MARKING_ERRORS
from skope.errors import UserError
from skope.files.json_files import json_bytes, parse_json
from skope.site.gates_zones_lanes import DEFAULT_LANE_M
from skope.site.mark_parser import MARK_LIMITS
from skope.site.page.drawings import FEWEST_POSITIONS, drawn_in_image, read_drawings
from skope.site.page.inputs import SiteFrames, decoded_frame, read_file
from skope.site.page.marks import marks_of_document, read_time
from skope.site.page.plan import PlanPictures, map_places, plan_scale, seen_from_above
from skope.site.page.site_store import Opened, SavedElsewhereError, SiteStore, merged_document
from skope.site.page.solved_page import SolvedPage, unfinished
from skope.terminal.console import Console
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

PAGE_PACKAGE: Final = "skope.site.page"
PLAN_ADDRESS: Final = re.compile(r"/plans/([0-9a-f]{64})")
FRAME_ADDRESS: Final = re.compile(r"/frames/([0-9]{1,9})")
PAGE_SCRIPTS: Final = ("site", "draw", "input", "marks", "panel", "picture", "server", "views")
PAGE_FILES: Final = SHARED_FILES | {
    "/site.css": (PAGE_PACKAGE, "site.css", CSS_TYPE),
    **{f"/{name}.js": (PAGE_PACKAGE, f"{name}.js", SCRIPT_TYPE) for name in PAGE_SCRIPTS},
}
PAGE_LIMITS: Final = {
    "fewest": FEWEST_POSITIONS,
    "usual": {"points": MARKING_ERRORS.position_m, "lengths": MARK_LIMITS.length_sigma_m, "lanes": DEFAULT_LANE_M},
    "longest_name": MARK_LIMITS.name_letters,
}
"""Limits of the parser for the page: number of positions by kind, default values of empty fields, letters of a name."""
SAVED_ELSEWHERE: Final = "{name} was saved by another window since this one read it. Your work is not lost: join both versions, or take the saved one (undo restores yours)."  # noqa: E501


def serve_site(frames: SiteFrames, path: Path, added: Mapping[str, Any], port: int | None, console: Console) -> None:
    """Serve the page until Ctrl-C; its address is printed in one line.

    Args:
        frames: The footage.
        path: The site file, which may be missing.
        added: Additional content of the page's document: points, a camera.
        port: Port of the server; None: any usual one.
        console: Console for the address.

    Raises:
        UserError: The site file cannot be read, or `port` cannot be used.
    """
    server = bound_site(frames, path, added, port)
    camera = server.store.read().document["camera"]
    if camera is not None and (size := (camera["width"], camera["height"])) != frames.size:
        console.result(
            f"{path}: camera: camera of {size[0]}x{size[1]}, scaled to the {frames.size[0]}x{frames.size[1]} of "
            f"{frames.title}"
        )
    serve_until_stopped(server, f"{frames.title}, {path}", console)


def bound_site(frames: SiteFrames, path: Path, added: Mapping[str, Any], port: int | None) -> "SiteServer":
    """Start the listening server of a site's page; `serve_site` lets it answer.

    Args:
        frames: The footage.
        path: The site file, which may be missing.
        added: Additional content of the page's document.
        port: Port of the server; None: any usual one.

    Raises:
        UserError: The site file cannot be read, or `port` cannot be used.
    """
    return bound_to(lambda free: SiteServer(frames, path, added, free), port)


class SiteServer(LocalServer):
    """Server of one site."""

    def __init__(self, frames: SiteFrames, path: Path, added: Mapping[str, Any], port: int) -> None:
        self.frames, self.added = frames, added
        self.store = SiteStore(path, frames.size)
        self.solved = SolvedPage(frames.size, self.store.read().vehicles)
        self.clearest = frames.clearest()
        self.plans = PlanPictures()
        super().__init__(port, _Handler)

    def _measure(self) -> str | None:
        """Return the command that measures the traffic of the footage; None for an empty canvas or without one."""
        if self.frames.source is None or self.frames.count < 2:
            return None
        return shlex.join(["skope", "eval", "traffic", self.frames.source, "--site", str(self.store.path)])

    def begin(self) -> dict[str, Any]:
        """Return the page's title, its document, and the saved document."""
        opened = self._opened()
        document = opened.document
        if opened.revision is None:
            document = document | {key: [*document[key], *value] if isinstance(value, list) else value
                                   for key, value in self.added.items()}  # fmt: skip
        return {
            "title": self.frames.title,
            "size": list(self.frames.size),
            "frames": self.frames.count,
            "frame": self.clearest,
            "file": self.store.path.name,
            "measure": self._measure(),
            "exists": opened.revision is not None,
            "document": document,
            "saved": opened.document,
            "revision": opened.revision,
            "zones": sorted(available_timezones()),
            "limits": PAGE_LIMITS,
        }

    def _opened(self) -> Opened:
        """Return the site file, with its plan's image under the name that the page uses."""
        opened = self.store.read()
        if opened.plan is not None:
            path = opened.plan
            as_written = os.path.relpath(path, self.store.path.parent)
            opened.document["plan"]["picture"] = self.plans.hold_file(path, as_written)
        return opened

    def hold_plan(self, sent: Mapping[str, Any]) -> dict[str, Any]:
        """Store the image of a plan that the user has loaded; `picture` of the answer is its name."""
        try:
            data = base64.b64decode(sent.get("data", ""), validate=True)
        except (TypeError, ValueError):
            raise UserError("data: expected base64") from None
        return {"picture": self.plans.hold(data)}

    def save(self, sent: Mapping[str, Any]) -> tuple[int, dict[str, Any]]:
        """Save a document; return status and answer."""
        document = _document(sent)
        problems = [
            *marks_of_document(document, self.frames.size).problems,
            *read_drawings(document, self.frames.size)[1],
        ]
        problems += read_time(document).problems
        if problems:
            words = unfinished(problems)
            return HTTPStatus.UNPROCESSABLE_ENTITY, {"text": f"not saved: {words}", "problem": asdict(problems[0])}
        solved, _ = self.solved.solve(document)
        revision = sent.get("revision")
        if not isinstance(revision, str | None):
            raise UserError("revision: expected a text")
        now, plan = datetime.now(UTC).astimezone().replace(microsecond=0), document.get("plan")
        try:
            self.store.check(revision)  # before an image is written in vain
            file = self.plans.saved_beside(self.store.path, plan.get("picture")) if isinstance(plan, dict) else None
            revision = self.store.save(document, solved, revision, now, file)
        except SavedElsewhereError:
            return HTTPStatus.CONFLICT, {"text": SAVED_ELSEWHERE.format(name=self.store.path.name)}
        counts = solved.camera or any(drawn_in_image("gates", gate) for gate in document.get("gates", []))
        message = "" if counts else "saved; the camera is not calibrated yet"
        return HTTPStatus.OK, {"revision": revision, "said": message}

    def read(self, sent: Mapping[str, Any]) -> dict[str, Any]:
        """Return the content of a file that the browser sends."""
        with tempfile.TemporaryDirectory() as folder:
            return read_file(sent, Path(folder), self.frames.size)

    def merge(self, sent: Mapping[str, Any]) -> dict[str, Any]:
        """Return the page's document merged with the saved one, and the saved one with its revision."""
        opened = self._opened()
        document = merged_document(_document(sent, "base"), _document(sent, "mine"), opened.document)
        return {"document": document, "saved": opened.document, "revision": opened.revision}

    def above(self, sent: Mapping[str, Any]) -> dict[str, Any]:
        """Return the view from above of a frame."""
        solved, _ = self.solved.solve(_document(sent))
        if solved.camera is None:
            raise UserError("the camera is not calibrated yet: " + solved.message)
        number = sent.get("frame")
        if not self.frames.count:
            return seen_from_above(solved.camera, None)
        if not isinstance(number, int) or not 0 <= number < self.frames.count:
            raise UserError("frame: no such frame")
        pixels = decoded_frame(self.frames.picture(number))
        if (pixels.shape[1], pixels.shape[0]) != self.frames.size:
            raise UserError(f"frame {number + 1}: has another size than the first one")
        return seen_from_above(solved.camera, pixels)


class _Handler(LocalHandler):
    server: SiteServer
    posts = True

    def answer_to(self, path: str) -> Answer | None:
        if path == "/":
            return HTML_TYPE, served_page("site/page/site.html", "site")
        if file := PAGE_FILES.get(path):
            return file[2], read_resource(*file[:2])
        if path == "/begin.json":
            return JSON_TYPE, json_bytes(self.server.begin())
        frames = self.server.frames
        if (frame := FRAME_ADDRESS.fullmatch(path)) and (number := int(frame[1])) < frames.count:
            picture = frames.picture(number)
            return picture.media_type, picture.data
        if (plan := PLAN_ADDRESS.fullmatch(path)) and (held := self.server.plans.picture(plan[1])):
            return held.media_type, held.data
        return None

    def answer_to_post(self, path: str, data: bytes) -> tuple[int, str, bytes] | None:
        server = self.server
        answers: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
            "/look": server.solved.look,
            "/places": lambda sent: server.solved.places(_document(sent), sent.get("pixels")),
            "/above": server.above,
            "/plan": plan_scale,
            "/plan-picture": server.hold_plan,
            "/map-places": map_places,
            "/read": server.read,
            "/merge": server.merge,
        }
        if path not in answers and path != "/save":
            return None
        try:
            sent = parse_json(data)
        except ValueError:
            raise UserError("expected JSON") from None
        if not isinstance(sent, dict):
            raise UserError("expected a JSON object")
        status, answer = server.save(sent) if path == "/save" else (HTTPStatus.OK, answers[path](sent))
        return status, JSON_TYPE, json_bytes(answer)


def _document(sent: Mapping[str, Any], key: str = "document") -> Mapping[str, Any]:
    value = sent.get(key)
    if not isinstance(value, dict):
        raise UserError(f"{key}: expected an object")
    return value
