"""Tracks drawn into their footage: box, number, class or category, and speed."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from skope.errors import UserError
from skope.pictures.draw import PALETTE
from skope.schema import AnnotationFile
from skope.tracking import map_signs
from skope.tracking.birdseye_video import put_text
from skope.tracking.empty_road import footage_of
from skope.tracks.track import Track
from skope.types import Pixels
from skope.video.footage import open_footage

_LABELLED: Final = 0.05
"""Boxes that are longer than this share of the picture's width have words beside them: far ones lie close together."""
_THICK: Final = 2
"""Lines of boxes, pixels."""


def overlay_frames(
    tracks: Sequence[Track], folder: Path, file: AnnotationFile, road_users: Sequence[Track] = ()
) -> Iterator[Pixels]:
    """The frames (H, W, 3) that were tracked, with the vehicles and other road users that are seen in them.

    Args:
        tracks: The tracks of vehicles.
        folder: Where the file of frames lies.
        file: The frames; `info` says where their footage is.
        road_users: The tracks of others.

    Raises:
        UserError: The footage is not said, not there any more, or cannot be read.
    """
    source = footage_of(folder, file.info)
    if source is None:
        raise UserError(f"{file.name}: does not say where its footage is, which --overlay draws into")
    place = {image.frame_index if image.frame_index is not None else i: i for i, image in enumerate(file.images)}
    present: dict[int, list[tuple[Track, int]]] = {}
    everybody: list[Track] = [*tracks, *road_users]
    for track in everybody:
        for i in np.flatnonzero(track.detected).tolist():
            present.setdefault(int(track.frames[i]), []).append((track, i))
    for image, pixels in open_footage(str(source)).frames():
        frame = place.get(-1 if image.frame_index is None else image.frame_index)
        if frame is not None:
            yield with_tracks_drawn(pixels, present.get(frame, []))


def with_tracks_drawn(pixels: Pixels, present: Sequence[tuple[Track, int]]) -> Pixels:
    """A copy of a frame (H, W, 3) with the tracks that are seen in it, each with its row there."""
    picture = pixels.copy()
    for track, i in present:
        x, y, w, h = track.boxes[i].tolist()
        color = PALETTE[track.number % len(PALETTE)]
        corners = np.rint([[x, y], [x + w, y], [x + w, y + h], [x, y + h]]).astype(np.int32)
        cv2.polylines(picture, [corners], True, color, _THICK, cv2.LINE_AA)
        if max(w, h) < _LABELLED * picture.shape[1]:
            continue
        number, _, speed = map_signs.label(track, i).partition("  ")
        put_text(picture, "  ".join(filter(None, (f"{number} {track.class_name}", speed))), (round(x), round(y) - 5))
    return picture
