"""Labelled footage of a site: a video file and the annotation file of its frames."""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.dataset.coco import write
from skope.errors import UserError
from skope.files.atomic import replacing
from skope.files.json_files import read_json
from skope.files.output_folders import changed_options
from skope.files.safe_names import for_ffmpeg
from skope.gen.labels.annotate import annotate, annotate_road_users
from skope.gen.labels.ignore_rules import Rules
from skope.gen.output.frames import image_of
from skope.gen.pipeline.generate import lighting_messages
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.frame import Renderer
from skope.gen.scene.recording import Recording, RecordingPlan
from skope.gen.simulation.simulate import simulate
from skope.pictures import draw
from skope.schema import CATEGORY_NAMES, VEHICLE_ALONE, Annotation, AnnotationFile, Image, RoadUser
from skope.terminal.console import Console
from skope.video.write import VideoFile, create_video

FRAME_RATES: Final = (5, 8, 10, 12.5, 20, 25, 40, 50)
"""Permitted frames per second of a video; SUMO's steps are whole milliseconds that divide a frame's time."""


@dataclass(frozen=True)
class WrittenFootage:
    """Paths of the files written by `write_footage`."""

    video: Path
    labels: Path
    overlay: Path | None


def plan_of(plan: RecordingPlan, fps: float, seconds: float, size_field: str = "--size") -> RecordingPlan:
    """Adapt a recording's plan to the frames of a video.

    Args:
        plan: Plan with site, size and conditions.
        fps: Frames per second, one of `FRAME_RATES`.
        seconds: Length of the video, seconds, up to 3600.
        size_field: The option or field that gave the image size, for the error message.

    Raises:
        UserError: The frame rate, the length or the size (odd numbers of pixels) is not possible.
    """
    if fps not in FRAME_RATES:
        raise UserError(f"--fps: expected one of {', '.join(f'{rate:g}' for rate in FRAME_RATES)}, got {fps:g}")
    if not 0 < seconds <= 3600:
        raise UserError(f"--seconds: expected a number of seconds up to 3600, got {seconds:g}")
    width, height = plan.size
    if width % 2 or height % 2:  # the encoder would drop the last column or row, but the labels would include it
        raise UserError(f"{size_field}: expected an even width and height for a video, got {width}x{height}")
    return replace(plan, frames=max(1, round(fps * seconds)), interval=1 / fps)


def check_free(footage: WrittenFootage, options: Mapping[str, Any]) -> None:
    """Raise a UserError if one of the files exists, unless the label file records the same `options`."""
    existing = [path for path in (footage.video, footage.labels, footage.overlay) if path and path.exists()]
    if not existing:
        return
    held = _options_of(footage.labels)
    if held == options:
        return
    reason = f"belongs to other footage ({', '.join(changed_options(held, options))})" if held else "has no label file"
    raise UserError(f"{existing[0]}: exists and {reason}; choose another folder with --out, or move it away")


def _options_of(labels: Path) -> Mapping[str, Any]:
    """Return the options that footage was made with, from its label file; empty if there is none."""
    try:
        document = read_json(labels)
    except UserError:
        return {}
    info = document.get("info") if isinstance(document, dict) else None
    options = info.get("options") if isinstance(info, dict) else None
    return options if isinstance(options, dict) else {}


def write_footage(
    plan: RecordingPlan,
    renderer: str,
    out: Path,
    *,
    options: Mapping[str, Any],
    with_overlay: bool,
    console: Console,
) -> WrittenFootage:
    """Simulate and render a video with labels: `out`/<site>.mp4, <site>.json and, with overlay, <site>_labels.mp4.

    Args:
        plan: Plan of the recording, from `plan_of`.
        renderer: "gl" or "pybullet".
        out: Output folder.
        options: The user's options as JSON values; stored in the labels' `info`.
        with_overlay: Whether to write a second video that shows the labels.
        console: Output for progress messages.

    Raises:
        UserError: Files of other footage exist, or the video cannot be written.
    """
    name = plan.site.name
    footage = WrittenFootage(
        out / f"{name}.mp4", out / f"{name}.json", out / f"{name}_labels.mp4" if with_overlay else None
    )
    check_free(footage, options)
    for_ffmpeg(footage.video)  # fails before the simulation if the path cannot be written
    console.say(f"{name}: simulating {plan.frames * plan.interval:g} s")
    recording = simulate(plan)
    size, fps = (recording.camera.width, recording.camera.height), 1 / plan.interval
    images: list[Image] = []
    annotations: list[Annotation] = []
    road_users: list[RoadUser] = []
    with ExitStack() as stack:
        plain = stack.enter_context(_whole_video(footage.video, size, fps))
        drawn = stack.enter_context(_whole_video(footage.overlay, size, fps)) if footage.overlay else None
        drawn_by = make_renderer(renderer, recording, partial(lighting_messages(console), name))
        frames = _render_frames(recording, drawn_by, footage.video.name)
        for pixels, image, vehicles, users in console.bar(
            frames, total=len(recording), unit="image", label="rendering"
        ):
            before = len(annotations) + len(road_users)
            numbered = [replace(vehicle, id=before + i) for i, vehicle in enumerate(vehicles, start=1)]
            plain.add(pixels)
            if drawn:
                drawn.add(draw.annotations(pixels, numbered, users))
            images.append(image)
            annotations += numbered
            road_users += [replace(user, id=before + user.id) for user in users]
        info = {"split": recording.split, "video": footage.video.name, "fps": fps, "options": dict(options)}
        file = AnnotationFile(
            images=tuple(images),
            annotations=tuple(annotations),
            info=info,
            name=name,
            road_users=tuple(road_users),
            categories=CATEGORY_NAMES if recording.road_users else VEHICLE_ALONE,
        )
        # The labels are written before the videos are renamed into place, since they record what the files belong to.
        write(footage.labels, file)
    return footage


def _render_frames(
    recording: Recording, renderer: Renderer, video: str
) -> Iterator[tuple[NDArray[np.uint8], Image, list[Annotation], list[RoadUser]]]:
    camera, rules = recording.camera, Rules()
    for frame in range(len(recording)):
        view = renderer.render(frame)
        moment, image = recording.moment(frame), image_of(recording, frame, f"{video}/{frame:06d}", frame + 1)
        vehicles, _ = annotate(moment, view, camera, rules, image.id)
        first = len(vehicles) + 1
        road_users = annotate_road_users(moment, view, camera, rules, image.id, first) if recording.road_users else []
        yield view.rgb, image, vehicles, road_users


@contextmanager
def _whole_video(path: Path, size: tuple[int, int], fps: float) -> Iterator[VideoFile]:
    """Open a video file that is renamed into place when it is complete."""
    with replacing(path) as temporary, create_video(temporary, size, fps) as video:
        yield video
