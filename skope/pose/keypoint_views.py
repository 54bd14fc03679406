"""Keypoints of vehicles by image, with the camera of each image: the input for poses and tracks."""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.camera.calibration_files import calibrated_seconds, read_uncertain_camera
from skope.camera.ground_plane import Ground
from skope.camera.model import Camera
from skope.camera.motion.camera_motion import TURN_ANGLES, CameraMotion, motion_of_info
from skope.camera.motion.view_registration import REGISTRATION_LIMITS, KnownView, read_views, view_numbers
from skope.camera.uncertain_camera import UncertainCamera
from skope.dataset import coco
from skope.dataset.camera_of_file import read_camera, sized
from skope.dataset.folder import FRAMES_FILE, PREDICTIONS_FILE
from skope.dataset.image_selection import part as part_of
from skope.errors import UserError
from skope.metrics import read_inputs
from skope.metrics.match import match
from skope.metrics.thresholds import KEPT_SCORE
from skope.pose.camera_error import CALIBRATED_FIELD, camera_of_info
from skope.pose.turned_view import TurnedView, turned_view
from skope.schema import Annotation, AnnotationFile, Image, Result, RoadUserResult
from skope.terminal.console import counted
from skope.types import Array

if TYPE_CHECKING:
    from skope.detections import Detections


@dataclass(frozen=True)
class ViewErrors:
    """Error model of predicted keypoints and boxes."""

    match_iou: float = 0.6
    """Minimum IoU at which a detection belongs to a ground-truth vehicle."""
    sigma_share: float = 0.02
    """Standard deviation of a predicted keypoint as a share of its box's longer edge; at least a pixel."""
    edge_share: float = 0.04
    """Maximum distance from the image's edge of a predicted box that is cut, as a share of the box's longer edge."""
    edge_px: float = 4.0
    """Minimum of that limit, pixels."""
    pushed_share: float = 0.02
    """Maximum distance of a keypoint from the edge that cuts its box at which it counts as pushed there by the
    detector, as a share of the box's longer edge."""
    pushed_px: float = 2.0
    """Minimum of that limit, pixels."""


VIEW_ERRORS: Final = ViewErrors()


@dataclass(frozen=True, eq=False)
class View:
    """Keypoints of the N vehicles of one image."""

    image: Image
    found: Array
    """(N, 33, 3) x, y in pixels, and the probability that the point is correct."""
    sigma_px: Array
    """(N,) standard deviation of a keypoint of probability 1, pixels."""
    scores: Array
    """(N,) scores of the detections, 0 to 1; 1 for labelled vehicles."""
    boxes: Array
    """(N, 4) x, y, width, height, pixels."""
    cut: NDArray[np.bool_]
    """(N,) whether the box reaches the image's edge, so that the vehicle may be only partly visible."""
    truth: tuple[Annotation | None, ...]
    """(N,) the labelled or matching ground-truth vehicle; None if there is none or it is unknown."""
    interpolated: NDArray[np.bool_]
    """(N,) whether the vehicle was followed from other frames, not detected in this one."""
    tracks: NDArray[np.int64]
    """(N,) number of the vehicle, shared with other images of its video; -1 if unknown."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Images with the keypoints of their vehicles, camera and road."""

    file: AnnotationFile
    results: Iterable[Result] | None
    """Detections; read more than once. Those of a file are in the order of the images. None: the annotations' own
    keypoints are used."""
    camera: Camera | None
    """Camera of all images, in place of the images' own; None: each image has its own."""
    ground: Ground | None
    """The road; None: unknown."""
    left_out: str | None = None
    """Sentence on images of the file that are left out because they show another view; None: all are used."""
    road_users: Iterable[RoadUserResult] | None = None
    """Other detected road users, in any order, also of other images. None: those of the annotations."""
    roads: Mapping[int, Ground | None] = field(default_factory=dict)
    """Roads by image id, for a file with several cameras."""
    known: UncertainCamera | None = None
    """The camera of all images with its covariance; None: the uncertainty is unknown."""
    motion: CameraMotion | None = None
    """Shake of the camera around its calibrated orientation; None: the camera is still, as far as known."""
    moved: frozenset[int] = frozenset()
    """Ids of images with another view than the calibrated one: they have no positions in metres."""
    turned: Mapping[int, Camera] = field(default_factory=dict)
    """Cameras by image id for images of a turned calibrated camera: they have positions in metres."""

    @property
    def has_truth(self) -> bool:
        """Whether the annotations have 3D boxes, which poses can be compared with."""
        return any(a.box_3d is not None for a in self.file.annotations)

    def camera_of(self, image: Image) -> Camera:
        """Return the camera of an image, at the image's size. Raises UserError if neither scene nor image has one."""
        camera = self.turned.get(image.id) or self.camera or image.camera
        if camera is None:
            raise UserError(
                f"{self.file.name}: {image.file_name} has no camera; give one with --camera "
                "(`skope eval camera` finds one from vehicles or marked points)"
            )
        return sized(camera, (image.width, image.height), image.file_name)

    def camera_in(self, image: Image) -> Camera:
        """Return the camera of an image, turned by the camera shake in it. Raises UserError without a camera."""
        camera = self.camera_of(image)
        return self.motion.camera_in(camera, image.id) if self.motion else camera

    def shake_in(self, image: Image) -> UncertainCamera | None:
        """Return the camera's uncertainty in one image from its shake; None: the camera is still."""
        return self.motion.rest_in(self.camera_of(image), image.id) if self.motion else None

    def moved_in(self, image: Image) -> bool:
        """Return whether the camera had been moved before the image, so that its calibration is invalid."""
        return image.id in self.moved

    def known_in(self, image: Image) -> UncertainCamera | None:
        """Return the camera of an image with its uncertainty; None if that is unknown."""
        return self.known.of_camera(self.camera_of(image)) if self.known else None

    def road_in(self, image: Image) -> Ground | None:
        """Return the road in an image; None: unknown."""
        return self.roads.get(image.id, self.ground)

    def calibrated_part(self) -> "Scene":
        """Return the scene without the images for which the calibration is invalid."""
        if not self.moved and not self.turned:
            return self
        kept = (image for image in self.file.images if not self.moved_in(image) and image.id not in self.turned)
        return replace(self, file=part_of(self.file, kept), moved=frozenset(), turned={})

    def stilled(self, view: View) -> View:
        """Return a view with its keypoints where they would be without camera shake."""
        image = view.image
        if self.motion is None or image.id not in self.motion.frames:
            return view
        found = view.found.copy()
        found[..., :2] = self.motion.stilled(self.camera or image.camera, image, found[..., :2])
        found[~np.isfinite(found).all(axis=-1)] = 0.0
        return replace(view, found=found)

    def views(
        self, *, score: float = KEPT_SCORE, sigma_px: float | None = None, noise: float = 0.0, seed: int = 0
    ) -> Iterator[View]:
        """Yield every image with its detections, or its labelled vehicles.

        Args:
            score: Minimum score of detections.
            sigma_px: Standard deviation of a keypoint for the pose search, pixels; None: 2% of the box, or the noise.
            noise: Standard deviation of the noise that is added to labelled keypoints, pixels.
            seed: Seed of that noise.
        """
        rng = np.random.default_rng(seed)
        if self.results is None:
            labelled = self.file.by_image()
            for image in self.file.images:
                yield _labelled(image, labelled[image.id], noise, sigma_px, rng)
        elif isinstance(self.results, tuple) or self.file.annotations:
            results: dict[int, list[tuple[Result, Annotation | None]]] = {}
            for result, vehicle in self._matched(score):
                results.setdefault(result.image_id, []).append((result, vehicle))
            for image in self.file.images:
                yield _predicted(image, results.get(image.id, []), sigma_px)
        else:
            here = {image.id for image in self.file.images}
            wanted = (result for result in self.results if result.image_id in here)
            by_image = itertools.groupby(wanted, lambda result: result.image_id)
            image_id, found = next(by_image, (None, ()))
            for image in self.file.images:
                if image.id == image_id:
                    yield _predicted(image, [(result, None) for result in found if result.score > score], sigma_px)
                    image_id, found = next(by_image, (None, ()))
                else:
                    yield _predicted(image, [], sigma_px)

    def _matched(self, score: float) -> list[tuple[Result, Annotation | None]]:
        """Return detections above `score`, in file order, each with its matching ground-truth vehicle."""
        here = {image.id for image in self.file.images}
        kept = [result for result in self.results or () if result.score > score and result.image_id in here]
        matches = match(self.file, kept, score=score, thresholds=(VIEW_ERRORS.match_iou,))
        partner: list[Annotation | None] = [None] * len(kept)
        for result, vehicle in zip(matches.det_result, matches.taken[VIEW_ERRORS.match_iou], strict=True):
            if vehicle >= 0:
                partner[result] = matches.vehicles[vehicle]
        return list(zip(kept, partner, strict=True))


def _labelled(
    image: Image,
    vehicles: list[Annotation],
    noise: float,
    sigma: float | None,
    rng: np.random.Generator,
) -> View:
    kept = tuple(a for a in vehicles if not a.ignored)
    found = np.array([a.keypoints for a in kept]).reshape(-1, keypoints.K, 3)
    found[..., :2] += rng.normal(0.0, 1.0, found[..., :2].shape) * noise
    found[..., 2] = found[..., 2] == 2
    spread = max(noise, 0.5) if sigma is None else sigma
    boxes = np.array([a.bbox for a in kept]).reshape(-1, 4)
    cut = _margins(image, boxes).min(axis=1, initial=np.inf) <= 0
    ones, none = np.ones(len(kept)), np.zeros(len(kept), dtype=bool)
    tracks = np.array([-1 if a.track_id is None else a.track_id for a in kept], dtype=np.int64)
    return View(image, found, spread * ones, ones, boxes, cut, kept, none, tracks)


def view_of(detections: "Detections") -> View:
    """Return the view of one image and a detector's results in it."""
    width, height = detections.size
    image = Image(id=1, file_name="image", width=width, height=height)
    return _predicted(image, [(result, None) for result in detections.to_results(image.id)], None)


def _predicted(image: Image, pairs: list[tuple[Result, Annotation | None]], sigma: float | None) -> View:
    results = [result for result, _ in pairs]
    found = np.array([r.keypoints for r in results]).reshape(-1, keypoints.K, 3)
    boxes = np.array([r.bbox for r in results]).reshape(-1, 4)
    spread = (
        np.maximum(1.0, VIEW_ERRORS.sigma_share * boxes[:, 2:].max(axis=1, initial=0.0))
        if sigma is None
        else np.full(len(boxes), sigma)
    )
    scores = np.array([r.score for r in results])
    longer = boxes[:, 2:].max(axis=1, initial=0.0)
    reached = _margins(image, boxes) <= np.maximum(VIEW_ERRORS.edge_px, VIEW_ERRORS.edge_share * longer)[:, None]
    # Detectors put keypoints outside the image at its edge, with high scores: those do not count.
    edges = _margins(image, np.concatenate([found[..., :2], np.zeros_like(found[..., :2])], axis=-1))
    at_edge = (edges <= np.maximum(VIEW_ERRORS.pushed_px, VIEW_ERRORS.pushed_share * longer)[:, None, None]) & reached[
        :, None
    ]
    found[..., 2] = np.where(at_edge.any(axis=-1), 0.0, found[..., 2])
    truth = tuple(vehicle for _, vehicle in pairs)
    interpolated = np.array([r.interpolated for r in results], dtype=bool)
    tracks = np.array([-1 if r.track_id is None else r.track_id for r in results], dtype=np.int64)
    return View(image, found, spread, scores, boxes, reached.any(axis=1), truth, interpolated, tracks)


def _margins(image: Image, boxes: Array) -> Array:
    """Return (..., 4) pixels between boxes x, y, width, height and the left, top, right, bottom edge of the image."""
    x, y, w, h = np.moveaxis(boxes, -1, 0)
    return np.stack([x, y, image.width - x - w, image.height - y - h], axis=-1)


def read_scene(
    folder: Path | None,
    annotations: Path | None,
    predictions: Path | None,
    camera: Path | None,
    ground: float | None,
) -> Scene:
    """Read the keypoints for poses and tracks.

    Args:
        folder: Output folder of `skope eval predict`. Either this or `annotations` is given.
        annotations: COCO file with the images and optionally their cameras and vehicles.
        predictions: COCO results for the images; None: those in `folder`, or the annotations' own keypoints.
        camera: File of the camera of all images; None: each image has its own.
        ground: Height of the level road in the camera's world, metres; None: unknown. It is also unknown if the camera
            file has no pose.

    Raises:
        UserError: Both or neither of `folder` and `annotations` are given, or a file is missing or malformed.
    """
    if (folder is None) == (annotations is None):
        raise UserError("give either the folder that `skope eval predict` wrote or --annotations")
    if folder is not None:
        if not folder.is_dir():
            raise UserError(f"{folder}: no such folder; `skope eval predict SOURCE --out {folder}` makes it")
        annotations, predictions = folder / FRAMES_FILE, predictions or folder / PREDICTIONS_FILE
    assert annotations is not None
    file = coco.read(annotations)
    if file.scheme.name != keypoints.SCHEME:
        raise UserError(f"{annotations}: has keypoint scheme {file.scheme.name}: poses need {keypoints.SCHEME}")
    results = read_inputs.stream_results(predictions, file) if predictions else None
    users = read_inputs.RoadUsersFile(predictions, file) if predictions else None
    motion = motion_of_info(file.name, file.info)
    if camera is None:
        shown = file.images[0].camera if file.images else None
        if shown is None:  # the camera is still to be calibrated
            file, left_out = _longest_view(file)
            road = None if ground is None else Ground(height=ground)
            return Scene(file, results, None, road, left_out, users, motion=motion)
        read, posed, known = None, True, camera_of_info(file.name, file.info, shown)
        seconds = file.info.get(CALIBRATED_FIELD)
    else:
        read, posed = read_camera(camera, _size(file))
        shown, known, seconds = read, read_uncertain_camera(camera), calibrated_seconds(camera)
    other_views = _other_views(file, seconds, shown if posed else None)
    if known is not None:
        known = known.widened(other_views.added)
    if motion is not None:
        known = motion.at_rest(shown, known)
    road = Ground(height=ground) if posed and ground is not None else None
    return Scene(
        file,
        results,
        read,
        road,
        other_views.words,
        users,
        known=known,
        motion=motion,
        moved=other_views.lost,
        turned=other_views.turned,
    )


def _parts(file: AnnotationFile, views: Sequence[KnownView]) -> NDArray[np.intp] | None:
    """Return (N,) the index in `views` for each image, or `REGISTRATION_LIMITS.moving_view`; None: all images show one
    view, as far as known."""
    times = [image.time_s for image in file.images if image.time_s is not None]
    return view_numbers(views, times) if len(views) > 1 and len(times) == len(file.images) > 0 else None


def _longest_view(file: AnnotationFile) -> tuple[AnnotationFile, str | None]:
    """Return the images of the longest part of a video with one view, and a sentence on what was left out."""
    views = read_views(file.name, file.info)
    part = _parts(file, views)
    if part is None:
        return file, None
    kept = np.flatnonzero(part == int(np.bincount(part[part != REGISTRATION_LIMITS.moving_view]).argmax()))
    begin, end = (file.images[i].time_s for i in (kept[0], kept[-1]))
    words = (
        f"{file.name}: the view changes ({counted(len(views) - 1, 'time')}); the longest part is used, "
        f"from {begin:.1f} to {end:.1f} s"
    )
    return part_of(file, (file.images[i] for i in kept)), words


@dataclass(frozen=True, eq=False)
class _OtherViews:
    """Images with other views than the calibrated one."""

    lost: frozenset[int] = frozenset()
    """Ids of the images without positions in metres."""
    turned: Mapping[int, Camera] = field(default_factory=dict)
    """Cameras of the others, by image id."""
    added: Mapping[tuple[str, ...], Array] = field(default_factory=dict)
    """Covariances that the least certain of the turns adds to the camera's."""
    words: str | None = None


def _other_views(file: AnnotationFile, calibrated: object, camera: Camera | None) -> _OtherViews:
    """Return the images for which a calibration is invalid, and the cameras of those to which it can be turned.

    The calibration belongs to the first view of the footage, unless its `source` and `seconds` name another view. A
    change at the first image means that the first view was that of earlier footage.
    `camera` is None if its pose is unknown: then it cannot be turned.
    """
    views = read_views(file.name, file.info)
    part = _parts(file, views)
    if part is None:
        return _OtherViews()
    valid = 0
    if isinstance(calibrated, Mapping) and calibrated.get("source") == file.info.get("source"):
        try:
            middle = float(np.mean([float(second) for second in calibrated["seconds"]]))
        except (TypeError, ValueError):
            raise UserError(f"{file.name}: calibrated.seconds: expected two numbers") from None
        times = [image.time_s or 0.0 for image in file.images]
        first = int(np.searchsorted(times, middle).clip(0, len(part) - 1))
        valid = int(next((k for k in part[first:] if k != REGISTRATION_LIMITS.moving_view), 0))
    if (part == valid).all():
        return _OtherViews()
    found = {} if camera is None else _turned_views(views, valid, sized(camera, _shape(file), file.name))
    of_image = dict(zip([image.id for image in file.images], part.tolist(), strict=True))
    turned = {number: found[k].camera for number, k in of_image.items() if k in found}
    lost = frozenset(number for number, k in of_image.items() if k != valid and k not in found)
    begin, end = ([0.0, *(view.begin_s for view in views[1:])] + [None])[valid : valid + 2]
    words = (
        f"{file.name}: the view changes ({counted(len(views) - 1, 'time')}): the camera's calibration holds "
        f"from {begin:.1f} s {'on' if end is None else f'to {end:.1f} s'}"
    )
    for k, view in found.items():
        zoom = "" if view.zoom == 1 else f" and zoomed by {view.zoom:.3f}"
        since = "before that," if k == 0 else f"from {views[k].settled_s:.1f} s on"
        words += f"; {since} the camera is turned{zoom} ({view.off_px:.2f} px off)"
    if lost:
        words += (
            f"; {counted(len(lost), 'other image')} {'has' if len(lost) == 1 else 'have'} no metres "
            "(`skope eval camera --refit` finds a moved camera's pose)"
        )
    vaguest = max(found.values(), key=lambda view: float(np.trace(view.added[TURN_ANGLES])), default=None)
    return _OtherViews(lost, turned, vaguest.added if vaguest else {}, words)


def _turned_views(views: Sequence[KnownView], valid: int, camera: Camera) -> dict[int, TurnedView]:
    """Return the views, by index, to which the camera of view `valid` was reliably turned."""
    calibrated = views[valid].from_first
    found = dict[int, TurnedView]()
    for k, view in enumerate(views):
        if k != valid and view.from_first is not None and calibrated is not None:
            turned = turned_view(camera, calibrated.inverse().then(view.from_first))
            if turned is not None:
                found[k] = turned
    return found


def _shape(file: AnnotationFile) -> tuple[int, int]:
    return file.images[0].width, file.images[0].height


def _size(file: AnnotationFile) -> tuple[int, int] | None:
    return _shape(file) if file.images else None
