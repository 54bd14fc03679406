"""Estimate the images, disk space and time of a dataset before it is generated.

Without a GPU, times are those of one core of a 2.1 GHz Xeon. With a GPU, they are those of a worker process with an
NVIDIA H100 (docs/evidence/scale.md). Both assume that nothing else runs; other machines differ by the speed of their
cores. Towns and vehicle models are assumed to be in the cache, lights are not.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.cpu_count import usable_processors
from skope.gen.output.frames import Encoding
from skope.gen.pipeline.config import DatasetRequest
from skope.gen.pipeline.dataset_store import Store
from skope.gen.pipeline.workers import WORKER_TIMES
from skope.gen.scene.recording import RecordingInfo, RecordingPlan
from skope.terminal.console import counted, disk_size, minutes


@dataclass(frozen=True)
class WorkRates:
    """Times and sizes that estimates are computed from."""

    start_s: float = 6.0
    """Time to start the worker processes and to complete the dataset, seconds."""
    simulation_s: float = 1.4
    """Core time of the start of a simulation, in which traffic enters the town, seconds."""
    simulated_second_s: float = 0.17
    """Core time per recorded second, seconds."""
    town_s: float = 6.0
    """Core time of drawing and building roadside scenery for a simulation, seconds."""
    shapes_s: float = 5.0
    """Core time of the vehicles of a recording in which each vehicle has its own shape, seconds."""
    light_parts: int = 4
    """Number of parts of a light's computation that workers without a GPU share."""
    labels_bytes: int = 30_000
    """Size of an image's annotations with a dozen vehicles, bytes."""
    image_bytes: tuple[int, float] = (360_000, 0.88)
    """Size in bytes of a JPEG of quality 95 with one megapixel, and the exponent of the number of megapixels."""
    depth_bytes: tuple[int, float] = (240_000, 0.78)
    """Size in bytes of a depth file with one megapixel, and the exponent of the number of megapixels."""


WORK_RATES: Final = WorkRates()

WET_WEATHERS: Final = ("rain", "after_rain", "snow")


@dataclass(frozen=True)
class Rate:
    """Rendering cost on one core: a fixed part in seconds and a part in seconds per megapixel."""

    frame: tuple[float, float]
    """Cost of a frame with a dozen vehicles, including labels and files."""
    light: tuple[float, float]
    """Cost of a camera's light in dry weather, if it is not in the cache."""
    wet_light: tuple[float, float]


RENDER_RATES: Final[Mapping[str, Rate]] = {
    "llvmpipe": Rate(frame=(0.18, 0.07), light=(6.0, 9.5), wet_light=(7.0, 18.0)),
    "GPU": Rate(frame=(0.10, 0.02), light=(0.5, 0.0), wet_light=(0.5, 0.0)),
    "pybullet": Rate(frame=(0.20, 1.0), light=(0.5, 28.0), wet_light=(0.5, 28.0)),
}
_BY_QUALITY: Final = {
    "jpeg": ((1, 50, 80, 90, 95, 100), (0.05, 0.25, 0.45, 0.76, 1.0, 1.7)),
    "webp": ((1, 50, 80, 95, 100), (0.05, 0.17, 0.30, 0.85, 1.1)),
    "png": ((1, 100), (3.8, 3.8)),
}
"""Qualities, and file sizes at these qualities relative to a JPEG of quality 95."""


@dataclass(frozen=True)
class Estimate:
    """Estimate of the missing part of a dataset."""

    images: int
    disk_bytes: float
    seconds: float | None
    """Estimated time, seconds; None if the workers are unknown."""
    workers: int | None
    cores: int | None
    """Number of cores that the workers share on this machine."""

    @property
    def line(self) -> str:
        """Estimate in words."""
        if not self.images:
            return "all images exist already"
        images = f"{counted(self.images, 'image')} to make"
        disk = disk_size(self.disk_bytes)
        if self.seconds is None or self.workers is None or self.cores is None:
            return f"{images}, about {disk}; the time on a cluster is not known"
        workers = counted(self.workers, "worker")
        shared = f" on {counted(self.cores, 'core')}" if self.cores != self.workers else ""
        return f"{images}, about {disk} and {minutes(self.seconds)} with {workers}{shared}"


def estimate(request: DatasetRequest, store: Store, workers: int | None) -> Estimate:
    """Estimate the time and disk space for a dataset, or for its missing part, on this machine.

    Args:
        request: Requested dataset.
        store: Its folder, which is only read.
        workers: Number of worker processes on this machine; None for a cluster.

    Raises:
        UserError: The folder contains other files, or a dataset with other parameters.
    """
    left = store.frames_left(request.dataset_plan())
    plans = [plan for plan in request.plans() if left[plan.info]]
    images = sum(left.values())
    seconds = cores = None
    if workers is not None:
        groups = [group for group in request.simulations() if not all(store.recorded(plan.info) for plan in group)]
        cores = min(workers, usable_processors())
        seconds = WORK_RATES.start_s + _simulating(request, groups, cores) + _rendering(request, plans, left, cores)
    return Estimate(images, images * _frame_bytes(request), seconds, workers, cores)


def _simulating(request: DatasetRequest, groups: Sequence[Sequence[RecordingPlan]], cores: int) -> float:
    """Return the time of the simulations, seconds; each simulation runs on one worker."""
    each = [
        WORK_RATES.simulation_s + WORK_RATES.simulated_second_s * sum(plan.frames * plan.interval for plan in group)
        for group in groups
    ]
    return max(sum(each) / cores, max(each, default=0.0))


def _rendering(
    request: DatasetRequest, plans: Sequence[RecordingPlan], left: Mapping[RecordingInfo, int], cores: int
) -> float:
    """Return the time of lights and frames, seconds."""
    p = request.parameters
    kind = p.renderer if p.renderer == "pybullet" else "llvmpipe" if "llvmpipe" in p.driver else "GPU"
    rate, (width, height) = RENDER_RATES[kind], p.pixels()
    megapixels = width * height / 1e6

    def of(pair: tuple[float, float]) -> float:
        return pair[0] + pair[1] * megapixels

    lights = [of(rate.wet_light if plan.site.weather in WET_WEATHERS else rate.light) for plan in plans]
    if request.user_site and request.user_site.road.photograph:
        lights = []
    lighting = max(sum(lights) / cores, max(lights, default=0.0) / WORK_RATES.light_parts)
    grown = (
        WORK_RATES.town_s * len({(plan.site.name, plan.leader) for plan in plans}) if p.variation.town_jitter else 0.0
    )
    shapes = WORK_RATES.shapes_s * len(plans) if p.variation.shape_jitter else 0.0
    frames = sum(left[plan.info] for plan in plans)
    drawing = of(rate.frame) * max(frames / cores, min(frames, WORKER_TIMES.frames_per_job))
    return lighting + (grown + shapes) / cores + drawing


def _frame_bytes(request: DatasetRequest) -> float:
    """Return the size of a frame's files and labels, bytes."""
    p = request.parameters
    width, height = p.pixels()
    megapixels = width * height / 1e6
    depth = _of_pixels(WORK_RATES.depth_bytes, megapixels) if p.encoding.depth else 0.0
    return (
        WORK_RATES.labels_bytes + depth + _of_pixels(WORK_RATES.image_bytes, megapixels) * _size_by_quality(p.encoding)
    )


def _of_pixels(law: tuple[int, float], megapixels: float) -> float:
    return float(law[0] * megapixels ** law[1])


def _size_by_quality(encoding: Encoding) -> float:
    qualities, sizes = _BY_QUALITY[encoding.image]
    return float(np.interp(encoding.quality, qualities, sizes))
