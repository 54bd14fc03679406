"""Detection and tracking of footage for commands that need tracks: in metres with a camera, else in the image."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from skope.dataset.folder import FRAMES_FILE, SKIPPED_KEY
from skope.errors import UserError
from skope.eval.cli.options import MachineOptions
from skope.eval.cli.scene_options import SceneOptions
from skope.files.output_folders import claim_output
from skope.terminal.console import Console

if TYPE_CHECKING:
    from skope.site.site_file import SiteFile
    from skope.video.footage import Footage

_CAMERA_NAME: Final = "camera.json"
SEEN_NAME: Final = "seen"
"""The folder of detections below the output."""
TRACKS_NAME: Final = "tracks"
"""The folder of tracks below the output."""


def recorded_video(source: str) -> "Footage":
    """Open a video file.

    Raises:
        UserError: The file cannot be read, is a live stream, or has images without times.
    """
    from skope.video.footage import FrameRange, open_footage

    footage = open_footage(source, FrameRange())
    if footage.clip is None:
        raise UserError(f"{source}: images have no times; run `skope eval predict` and `skope eval track --fps` first")
    if footage.live:
        raise UserError(f"{source}: is a live stream; record it, or run `skope eval predict {source}` first")
    return footage


def site_at_size(site: "SiteFile", footage: "Footage", console: Console) -> "SiteFile":
    """Return the site with its camera, or else the pixels of its gates, scaled to the size of the footage.

    A line is printed if the camera is scaled.

    Raises:
        UserError: The camera, or a gate that is counted in the image, has another aspect ratio than the footage.
    """
    from skope.dataset.camera_of_file import fitted_camera

    size = footage.frame_size()
    if size is None:
        raise UserError(f"{footage.name}: none of its frames can be decoded: {'; '.join(footage.skipped)}")
    if site.camera is None:
        return gates_at_size(site, size)
    camera, scaled = fitted_camera(site.camera.camera, size, f"{site.path}: camera", footage.name)
    if scaled:
        console.result(scaled)
    return replace(site, camera=replace(site.camera, camera=camera))


def gates_at_size(site: "SiteFile", size: tuple[int, int]) -> "SiteFile":
    """Return the site with the pixels of its gates scaled to images of a size (width, height).

    Raises:
        UserError: A gate was drawn in an image of another aspect ratio; the message names the site file and the gate.
    """
    from skope.site.gates_zones_lanes import gate_at_size

    try:
        return replace(site, gates=tuple(gate_at_size(gate, size) for gate in site.gates))
    except UserError as error:
        raise UserError(f"{site.path}: {error}") from None


def skipped_lines(folder: Path) -> list[str]:
    """Return the lines of `skope eval predict` on unreadable parts of the footage, from its output folder."""
    from skope.dataset import coco

    return list(map(str, coco.read(folder / FRAMES_FILE).info.get(SKIPPED_KEY, ())))


def detected_footage(
    footage: "Footage",
    site: "SiteFile",
    checkpoint: Path,
    hardware: MachineOptions,
    out: Path,
    command: str,
    options: Mapping[str, Any],
    console: Console,
) -> Path:
    """Detect and track road users of a video in the image, in a folder below `out`; a stopped run resumes.

    Args:
        footage: The video.
        site: Its site, which identifies the run.
        checkpoint: The detector.
        hardware: The machine settings.
        out: The output folder of `command`, which is claimed here.
        command: Name of the calling command.
        options: Further options that the result depends on.
        console: Console for messages.

    Returns:
        The folder of detections, as from `skope eval predict`.

    Raises:
        UserError: The footage cannot be read, or `out` has the output of another run.
    """
    from skope.footage.predict_footage import predict
    from skope.footage.predict_job import PROGRESS_FILE, PredictJob, content_of

    claim_output(out, command, [site.path], {**options, "source": content_of(footage), "checkpoint": str(checkpoint)})
    seen = out / SEEN_NAME
    if (seen / FRAMES_FILE).is_file() and not (seen / PROGRESS_FILE).exists():
        console.say(f"{seen}: has the detections of {footage.name}")
        return seen
    job = PredictJob(footage=footage, checkpoint=checkpoint, out=seen, settings=hardware.settings(tiles="none"))
    for path in predict(job, console):
        console.say(f"wrote {path}")
    return seen


def tracked_footage(
    footage: "Footage",
    site: "SiteFile",
    checkpoint: Path,
    hardware: MachineOptions,
    out: Path,
    command: str,
    options: Mapping[str, Any],
    console: Console,
) -> Path:
    """Detect and track road users of a video in metres, in folders below `out`; a stopped run resumes.

    Args:
        footage: The video.
        site: Its site, with the camera of the video.
        checkpoint: The detector.
        hardware: The machine settings.
        out: The output folder of `command`, which is claimed here.
        command: Name of the calling command.
        options: Further options that the result depends on.
        console: Console for messages.

    Returns:
        The folder of tracks.

    Raises:
        UserError: The footage cannot be read, or `out` has the output of another run.
    """
    from skope.camera.fit.write_camera import write_camera
    from skope.dataset.camera_of_file import read_camera
    from skope.footage.predict_footage import predict
    from skope.footage.predict_job import PredictJob, content_of
    from skope.pose.camera_error import camera_info
    from skope.traffic.observation import FOOTAGE_FILE

    assert site.camera is not None
    known = site.camera.known
    extra_fields: dict[str, Any] = {"covariance": known.covariance_dict()} if known else {}
    if site.camera.calibrated:
        extra_fields["calibrated"] = dict(site.camera.calibrated)
    # The site file may name a camera file; its content is part of what identifies the run.
    camera = {**site.camera.camera.to_dict(), **extra_fields}
    named = {"source": content_of(footage), "checkpoint": str(checkpoint), "camera": camera}
    claim_output(out, command, [site.path], {**options, **named})
    tracks = out / TRACKS_NAME
    if (tracks / FOOTAGE_FILE).is_file() and not list(tracks.glob(".*")):
        console.say(f"{tracks}: has the tracks of {footage.name}")
        return tracks
    for line in write_camera(out / _CAMERA_NAME, site.camera.camera, extra_fields):
        console.say(line)
    job = PredictJob(
        footage=footage,
        checkpoint=checkpoint,
        out=out / SEEN_NAME,
        settings=hardware.settings(tiles="none"),
        camera=read_camera(out / _CAMERA_NAME)[0],
        camera_info=camera_info(out / _CAMERA_NAME),
    )
    for path in predict(job, console):
        console.say(f"wrote {path}")
    for line in track_folder(out / SEEN_NAME, tracks, console):
        console.say(line)
    return tracks


def track_folder(seen: Path, out: Path, console: Console) -> Iterator[str]:
    """Track road users in metres, as `skope eval track` does by default; yield the lines that it prints.

    Args:
        seen: Folder of detections, whose frames have a camera.
        out: Output folder, which is claimed here.
        console: Console for messages.

    Raises:
        UserError: The detections cannot be read, or `out` has the output of another run.
    """
    from skope.tracking.track_footage import TrackJob, follow_footage

    options = SceneOptions(folder=seen)
    scene = options.scene(0.0, console=console)
    options.claim_output(out, "skope eval track", fps=None, noise=0.0)
    job = TrackJob(
        scene=scene,
        place=options.images_folder,
        out=out,
        fps=None,
        start_time=None,
        noise=0.0,
        score=options.score,
        sigma_px=options.sigma,
        video=False,
        overlay=False,
    )
    yield from follow_footage(job, console)
