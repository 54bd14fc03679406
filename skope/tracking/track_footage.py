"""`skope eval track`: estimate poses in every frame, track vehicles through them and write the files."""

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.dataset.folder import FOLLOWED_KEY, START_TIME_KEY, VISIBILITY_KEY
from skope.errors import UserError
from skope.files.atomic import replacing, write_bytes, write_text
from skope.files.json_files import json_bytes
from skope.files.progress import Progress
from skope.pose.keypoint_views import Scene
from skope.pose.pose_records import locate_views
from skope.schema import CATEGORY_NAMES, VEHICLE_CATEGORY, Labelled
from skope.terminal.console import Console, counted
from skope.tracking import birdseye, birdseye_video, camera_picture
from skope.tracking.ground_points import ground_detections
from skope.tracking.ground_view import empty_road
from skope.tracking.headings import with_body_error
from skope.tracking.pedestrian_and_cycle_tracks import follow_road_users, of_body
from skope.tracking.track_flags import flagged
from skope.tracking.tracker_inputs import Detection, detection_from_dict, detection_to_dict, detections_of
from skope.tracking.vehicle_tracker import track_vehicles
from skope.tracks.csv_file import TRACKS_CSV, as_written, write_tracks
from skope.tracks.frame_files import mot_row, write_fcd, write_mot
from skope.tracks.track import Track
from skope.traffic.observation import FOOTAGE_FILE, Observation, checked_visibility, read_start_time
from skope.traffic.road_picture import empty_road_picture, write_empty_road_picture, write_road_picture
from skope.video.write import write_video

_PROGRESS_NAME: Final = ".poses.jsonl"


@dataclass(frozen=True, kw_only=True)
class TrackJob:
    """Settings of a tracking run and its outputs."""

    scene: Scene
    place: Path
    """Folder of the scene's file. Paths to footage in the file are relative to it."""
    out: Path
    fps: float | None
    """Images per second; None: the images carry their times."""
    start_time: datetime | None
    """Time of second 0 with its time zone; None: read from the file of frames, which has it for live streams."""
    noise: float
    """Standard deviation of the noise that is added to labelled keypoints, pixels."""
    score: float
    """Minimum score of the detections to follow."""
    sigma_px: float | None
    """Standard deviation of a keypoint, pixels; None: the default of `Scene.views`."""
    video: bool
    """Whether to write a bird's-eye video."""
    overlay: bool
    """Whether to write a copy of the footage with the tracks drawn in it."""


def follow_footage(job: TrackJob, console: Console) -> Iterator[str]:
    """Follow the vehicles, write their tracks to `job.out`, and yield lines that report files and results."""
    scene = job.scene
    start_time = start_time_of(scene, job.start_time)
    times = times_of(scene, job.fps)
    progress = poses_kept(job.out)
    if progress.count:
        console.say(f"{scene.file.name}: resuming after the poses of {progress.count} images")
    rejections = Counter[str]()
    every = followed(job, times, progress, rejections, console)
    camera = scene.camera_of(scene.file.images[0])
    index = [image.frame_index if image.frame_index is not None else i for i, image in enumerate(scene.file.images)]
    write_tracks(job.out / TRACKS_CSV, every, index)
    write_mot(job.out / "mot.txt", [track for track in every if track.category == VEHICLE_CATEGORY])
    write_fcd(job.out / "fcd.xml", every, times)
    observation = observation_of(scene, times, start_time)
    write_bytes(job.out / FOOTAGE_FILE, json_bytes(observation.to_dict()))
    written = [TRACKS_CSV, "mot.txt", "fcd.xml", FOOTAGE_FILE, "birdseye.png"]
    shown = [observation.with_camera_error(track) for track in every]  # the camera's error applies to each track
    tracks = [track for track in shown if track.category == VEHICLE_CATEGORY]
    road_users = [track for track in shown if track.category != VEHICLE_CATEGORY]
    road = _road(job, camera, console)
    birdseye.draw(job.out / "birdseye.png", tracks, camera, scene.ground, road, road_users)
    if road is not None and scene.ground is not None:
        written += write_road_picture(
            job.out, birdseye.road_picture([*tracks, *road_users], camera, scene.ground, road)
        )
    if road is not None and (picture := empty_road_picture(road, times)) is not None:
        written += write_empty_road_picture(job.out, picture)
    if scene.file.annotations:
        _write_truth(job.out / "mot_truth.txt", scene, scene.file.annotations)
        written.append("mot_truth.txt")
    written += _write_road_users(job, road_users)
    if job.video:
        with replacing(job.out / "birdseye.mp4") as temporary:
            above = birdseye_video.birdseye_frames(tracks, times, camera, scene.ground, road, road_users)
            write_video(temporary, above, 1 / float(np.median(np.diff(times))))
        written.append("birdseye.mp4")
    if job.overlay:
        with replacing(job.out / "overlay.mp4") as temporary:
            drawn = console.bar(
                camera_picture.overlay_frames(tracks, job.place, scene.file, road_users),
                total=len(times),
                unit="image",
                label="overlay",
            )
            write_video(temporary, drawn, 1 / float(np.median(np.diff(times))))
        written.append("overlay.mp4")
    progress.end()
    for name in written:
        yield f"wrote {job.out / name}"
    seconds = times[-1] - times[0]
    yield f"{counted(len(tracks), 'track')} over {seconds:.1f} s"
    yield from _road_user_words(job, road_users)
    doubtful = Counter(flag for track in (*tracks, *road_users) for flag in track.flags)
    if doubtful:
        yield f"of these: {', '.join(f'{number} {flag}' for flag, number in sorted(doubtful.items()))}"
    if rejections.total():
        why = ", ".join(f"{number} {reason}" for reason, number in rejections.most_common())
        yield f"{counted(rejections.total(), 'detection')} without a pose: {why}"
    if scene.has_truth:
        yield from speed_errors(scene, tracks)


def start_time_of(scene: Scene, start_time: datetime | None) -> datetime | None:
    """Return the time of second 0: `start_time`, else the start of a live stream from the file of frames, else None."""
    text = scene.file.info.get(START_TIME_KEY)
    where = f"{scene.file.name}: info.{START_TIME_KEY}"
    return read_start_time(text, where) if start_time is None and text is not None else start_time


def poses_kept(folder: Path) -> Progress:
    """Return the file in a folder that keeps the poses of each image until a run is done."""
    return Progress(folder / _PROGRESS_NAME, ("sights",))


def followed(
    job: TrackJob, times: Sequence[float], progress: Progress, rejections: Counter[str], console: Console
) -> list[Track]:
    """Return the tracks of vehicles, then of other road users, with flags, rounded as in tracks.csv.

    Their errors assume a known camera. The camera's own uncertainty is in `observation_of`.

    Args:
        job: The footage and the tracking settings.
        times: Time of each image, seconds, as `times_of` returns them.
        progress: Poses of earlier images, as `poses_kept` returns them.
        rejections: Counter of the reasons why vehicles have no pose; updated in place.
        console: Console for the progress.
    """
    scene = job.scene
    seen = console.bar(_seen(job, progress, rejections), total=len(times), unit="image", label="poses")
    tracks = flagged(track_vehicles(seen, times))
    road_users = _road_users(job, times, 1 + len(tracks))
    if scene.ground is not None:
        eye, sigma_m = scene.camera_of(scene.file.images[0]).position, scene.ground.height_sigma
        tracks = [with_body_error(track, eye, sigma_m) for track in tracks]
    return [as_written(track) for track in (*tracks, *road_users)]


def observation_of(scene: Scene, times: Sequence[float], start_time: datetime | None) -> Observation:
    """Return the times at which the road was observed, and what is known of the camera, for `skope.traffic`.

    Args:
        scene: The footage.
        times: Time of each image, seconds.
        start_time: Time of second 0 with its time zone, as `start_time_of` returns it; None if not known.
    """
    moved = np.array([scene.moved_in(image) for image in scene.file.images])
    known = scene.known_in(scene.file.images[0])
    camera = scene.camera_of(scene.file.images[0])
    seconds = np.round(np.array(times), 4)  # as tracks.csv has them
    turned = list[tuple[float, Camera]]()
    latest = scene.turned.get(scene.file.images[0].id)  # None: the calibrated view
    for image, time_s in zip(scene.file.images, seconds.tolist(), strict=True):
        view = scene.turned.get(image.id)
        if view is not latest and not scene.moved_in(image):
            turned.append((time_s, scene.camera_of(image)))
            latest = view
    return Observation(
        times_s=seconds[~moved],
        source=str(scene.file.info.get("source", scene.file.name)),
        common_scale_sigma=known.distance_sigma() if known else None,
        camera=camera,
        uncertainty=known,
        ground=scene.ground,
        camera_moved_s=seconds[moved],
        turned=tuple(turned),
        visibility_samples=checked_visibility(
            scene.file.info.get(VISIBILITY_KEY, []), f"{scene.file.name}: info.{VISIBILITY_KEY}"
        ),
        start_time=start_time,
    )


def _road_users(job: TrackJob, times: Sequence[float], first_number: int) -> list[Track]:
    """Return tracks of pedestrians and two-wheelers; none if the height of the road is unknown."""
    if job.scene.ground is None:
        return []
    detections = ground_detections(job.scene, score=job.score, sigma_px=job.sigma_px)
    eye = job.scene.camera_of(job.scene.file.images[0]).position
    return [of_body(track, eye) for track in follow_road_users(detections, times, first_number)]


def _write_road_users(job: TrackJob, tracks: list[Track]) -> list[str]:
    """Write MOTChallenge files of pedestrians and two-wheelers, by category; return the files' names."""
    written = []
    for number, category in enumerate(CATEGORY_NAMES[1:], start=2):
        category_tracks = [track for track in tracks if track.category == category]
        if category_tracks:
            write_mot(job.out / f"mot_{category}.txt", category_tracks)
            written.append(f"mot_{category}.txt")
        truth = [user for user in job.scene.file.road_users if user.category_id == number]
        if truth:
            _write_truth(job.out / f"mot_truth_{category}.txt", job.scene, truth)
            written.append(f"mot_truth_{category}.txt")
    return written


def _road_user_words(job: TrackJob, tracks: list[Track]) -> Iterator[str]:
    """Yield the number of road users of each category, or why there are none."""
    if tracks:
        counts = Counter(track.category for track in tracks)
        yield f"also: {', '.join(counted(counts[name], name) for name in CATEGORY_NAMES if counts[name])}"
    elif job.scene.ground is None and len(job.scene.file.categories) > 1:
        categories = ", ".join(job.scene.file.categories[1:])
        yield f"{categories}: no tracks, because the height of the road is unknown (--ground)"


def _road(job: TrackJob, camera: Camera, console: Console) -> NDArray[np.uint8] | None:
    """Return the empty road as `camera` shows it, or None if the footage is not available."""
    try:
        road = empty_road(job.place, job.scene.calibrated_part().file)
    except UserError as error:
        console.say(f"birdseye.png has no picture of the road: {error}")
        return None
    return road if road is not None and road.shape[1::-1] == (camera.width, camera.height) else None


def _seen(job: TrackJob, progress: Progress, rejections: Counter[str]) -> Iterator[list[Detection]]:
    """Yield the vehicles of each image: from an earlier, interrupted run, or located now.

    `rejections` counts the reasons why vehicles have no pose.
    """
    linked = job.scene.file.info.get(FOLLOWED_KEY) is True

    def counted_rejections(found: list[Detection]) -> list[Detection]:
        rejections.update(detection.refused for detection in found if detection.refused)
        return found

    for row in itertools.islice(progress.rows(), progress.count):
        yield counted_rejections([detection_from_dict(entry) for entry in row["sights"]])
    views = job.scene.views(score=job.score, sigma_px=job.sigma_px, noise=job.noise)
    for located in locate_views(itertools.islice(views, progress.count, None), job.scene):
        found = detections_of(located, linked=linked)
        progress.add({"sights": [detection_to_dict(detection) for detection in found]})
        yield counted_rejections(found)


def times_of(scene: Scene, fps: float | None) -> list[float]:
    """Return the time of each image, seconds. Raises UserError if neither `fps` nor the file gives it."""
    images = scene.file.images
    if len(images) < 2:
        raise UserError(f"{scene.file.name}: tracks need two images or more, got {len(images)}")
    if fps is not None:
        index = [i if image.frame_index is None else image.frame_index for i, image in enumerate(images)]
        if any(b <= a for a, b in itertools.pairwise(index)):
            index = list(range(len(images)))
        return [(i - index[0]) / fps for i in index]
    times = [image.time_s for image in images]
    if any(time is None for time in times):
        raise UserError(f"{scene.file.name}: its images carry no times; give --fps")
    seconds = [float(time) for time in times if time is not None]
    if any(b <= a for a, b in itertools.pairwise(seconds)):
        raise UserError(f"{scene.file.name}: times do not rise; it is not the footage of one camera")
    return seconds


def _write_truth(path: Path, scene: Scene, labels: Sequence[Labelled]) -> None:
    """Write the labelled tracks of one category as MOTChallenge ground truth: all counted, class 1, visible."""
    of_image: dict[int, list[Labelled]] = {image.id: [] for image in scene.file.images}
    for label in labels:
        of_image[label.image_id].append(label)
    rows = [
        mot_row(frame, a.track_id, a.bbox, "1,1,1")
        for frame, image in enumerate(scene.file.images, start=1)
        for a in of_image[image.id]
        if not a.ignored and a.track_id is not None
    ]
    write_text(path, "".join(rows))


def speed_errors(scene: Scene, tracks: list[Track]) -> Iterator[str]:
    """Yield the speed errors against the simulation, over frames in which a vehicle drives at 2 m/s or more."""
    labelled = scene.file.by_image()
    truth = {
        (image.id, a.track_id): float(np.linalg.norm(a.velocity))
        for image in scene.file.images
        for a in labelled[image.id]
        if a.velocity is not None
    }
    ids = [image.id for image in scene.file.images]
    share = []
    for track in tracks:
        for frame, truth_id, speed in zip(track.frames, track.truth_ids.tolist(), track.speed, strict=True):
            real = truth.get((ids[frame], truth_id))
            if real is not None and real >= 2.0:
                share.append(abs(float(speed) - real) / real)
    if share:
        most = np.percentile(share, 90)
        yield f"speed: {np.median(share):.1%} off in the median, 90% within {most:.1%} ({len(share)} speeds)"
