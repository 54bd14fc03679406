"""Spray: the cloud of fine drops that wheels throw up from a wet road, drawn over an image.

The cloud is behind each moving vehicle. It is denser and longer the faster the vehicle is and the wetter the road is.
It hides objects behind it, including the vehicle's own rear. It is computed on a grid coarser than the image.
"""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.render.glare import GLARE_STRENGTHS
from skope.gen.scene.conditions import Conditions
from skope.gen.scene.recording import Moment, body_of
from skope.types import Array


@dataclass(frozen=True)
class SprayModel:
    """Settings of the spray behind vehicles on wet roads."""

    least_mps: float = 5.0
    """Minimum speed for visible spray, m/s."""
    full_mps: float = 18.0
    """Speed at which spray has its full `density`, m/s. The density grows further up to 1.5 times that value."""
    density: float = 1.1
    """Optical depth through the middle of a puff behind a car at `full_mps`."""
    decay_s: float = 0.6
    """Time in which spray thins out to a third, seconds."""
    gone_s: float = 1.8
    """Time after which spray is not drawn, seconds."""
    puff_widths: float = 0.6
    """Distance between the puffs of a plume, in widths of the vehicle."""
    brightness: float = 0.82
    """Brightness of spray, as a share of that of the bright parts of the image."""
    variation: float = 0.55
    """Variation of the density within a plume, as a share."""
    pattern_cells: int = 128
    """Size of the pattern of density, cells."""


SPRAY_MODEL: Final = SprayModel()


class Spray:
    """Spray of a recording's vehicles."""

    def __init__(self, camera: Camera, conditions: Conditions) -> None:
        self._camera = camera
        self._amount = conditions.spray * conditions.wetness
        if self._amount > 0:
            noise = (
                np.random.default_rng(23)
                .standard_normal((SPRAY_MODEL.pattern_cells, SPRAY_MODEL.pattern_cells))
                .astype(np.float32)
            )
            soft = cv2.GaussianBlur(np.tile(noise, (3, 3)), (0, 0), 2.5)[
                SPRAY_MODEL.pattern_cells : 2 * SPRAY_MODEL.pattern_cells,
                SPRAY_MODEL.pattern_cells : 2 * SPRAY_MODEL.pattern_cells,
            ]
            mottle = np.clip(1 + SPRAY_MODEL.variation * soft / soft.std(), 0.1, 3.0).astype(np.float32)
            # One tile larger than the grid: frames show windows of it.
            tiles = [
                -(-side // (GLARE_STRENGTHS.cell_px * SPRAY_MODEL.pattern_cells)) + 1
                for side in (camera.height, camera.width)
            ]
            self._mottle = np.tile(mottle, tiles)

    def drift(
        self, rgb: NDArray[np.uint8], depth: NDArray[np.float32], moment: Moment, frame: int
    ) -> NDArray[np.uint8]:
        """Draw the spray of a moment into the image (H, W, 3), and return it; `depth` (H, W) is that of the image."""
        if self._amount <= 0:
            return rgb
        shown = np.ascontiguousarray(depth[:: GLARE_STRENGTHS.cell_px, :: GLARE_STRENGTHS.cell_px])
        thick = np.zeros(shown.shape, dtype=np.float32)
        for i, (recorded, T) in enumerate(zip(moment.vehicles, moment.T_world_chassis, strict=True)):
            speed = float(np.linalg.norm(moment.velocity[i]))
            if recorded.labelled and speed > SPRAY_MODEL.least_mps:
                self._add_plume(thick, shown, T, body_of(recorded).size_lwh, speed)
        if not thick.any():
            return rgb
        rows, columns = shown.shape
        # The pattern moves from frame to frame.
        y, x = (37 * frame) % SPRAY_MODEL.pattern_cells, (53 * frame) % SPRAY_MODEL.pattern_cells
        veil = 255 * (1 - np.exp(-thick * self._mottle[y : y + rows, x : x + columns]))
        veil = cv2.resize(
            veil.astype(np.uint8),
            (GLARE_STRENGTHS.cell_px * columns, GLARE_STRENGTHS.cell_px * rows),
            interpolation=cv2.INTER_LINEAR,
        )
        light = SPRAY_MODEL.brightness * np.quantile(rgb[::8, ::8].reshape(-1, 3), 0.9, axis=0)
        veiled = np.flatnonzero(veil[: rgb.shape[0]].any(axis=1))
        if len(veiled):
            veiled_rows = slice(int(veiled[0]), int(veiled[-1]) + 1)
            cover = cv2.cvtColor(np.ascontiguousarray(veil[veiled_rows, : rgb.shape[1]]), cv2.COLOR_GRAY2RGB)
            cloud = cv2.multiply(cover, np.array([*light, 0.0]), scale=1 / 255)
            rgb[veiled_rows] = cv2.add(cv2.multiply(rgb[veiled_rows], cv2.bitwise_not(cover), scale=1 / 255), cloud)
        return rgb

    def _add_plume(
        self,
        thick: NDArray[np.float32],
        shown: NDArray[np.float32],
        T: Array,
        size: tuple[float, float, float],
        speed: float,
    ) -> None:
        """Add one vehicle's plume to the optical depth on the grid."""
        length, width, height = size
        dense = (
            self._amount
            * SPRAY_MODEL.density
            * min((speed - SPRAY_MODEL.least_mps) / (SPRAY_MODEL.full_mps - SPRAY_MODEL.least_mps), 1.5)
        )
        dense *= 1.0 + 0.6 * (height > 2.4)
        behind = np.arange(0.0, speed * SPRAY_MODEL.gone_s, SPRAY_MODEL.puff_widths * width)
        ages = behind / speed
        heights = 0.35 + 0.55 * np.minimum(ages, 1.0)
        back = np.column_stack([-0.42 * length - behind, np.zeros(len(ages)), heights])
        radius = width * (0.50 + 0.45 * np.minimum(ages, 1.2)) * (1 + 0.25 * (height > 2.4))
        wheels = np.array([[x * length, y * width, 0.28] for x in (0.30, -0.30) for y in (-0.55, 0.55)])
        places = np.concatenate([back, wheels]) @ T[:3, :3].T + T[:3, 3]
        radii = np.concatenate([radius, np.full(len(wheels), 0.34)])
        depths = np.concatenate([dense * np.exp(-ages / SPRAY_MODEL.decay_s), np.full(len(wheels), 0.45 * dense)])
        pixels, z, valid = self._camera.project(places)
        focal = float(self._camera.K[0, 0])
        for k in np.flatnonzero(valid & (z > 1.0)).tolist():
            _add_puff(
                thick,
                shown,
                pixels[k] / GLARE_STRENGTHS.cell_px,
                float(z[k]),
                float(radii[k]),
                focal / GLARE_STRENGTHS.cell_px,
                float(depths[k]),
            )


def _add_puff(
    thick: NDArray[np.float32],
    shown: NDArray[np.float32],
    center: Array,
    z: float,
    radius: float,
    focal: float,
    dense: float,
) -> None:
    """Add a round puff. It counts less where the image shows an object inside or in front of it."""
    reach = max(focal * radius / z, 0.8)
    rows, columns = thick.shape
    x0, x1 = max(int(center[0] - 2.2 * reach), 0), min(int(center[0] + 2.2 * reach) + 2, columns)
    y0, y1 = max(int(center[1] - 2.2 * reach), 0), min(int(center[1] + 2.2 * reach) + 2, rows)
    if x0 >= x1 or y0 >= y1:
        return
    y, x = np.ogrid[y0:y1, x0:x1]
    square = ((x + 0.5 - center[0]) ** 2 + (y + 0.5 - center[1]) ** 2) / (reach * reach)
    before = np.clip((shown[y0:y1, x0:x1] - (z - radius)) / (2 * radius), 0, 1)
    thick[y0:y1, x0:x1] += (dense * before * np.exp(-1.4 * square)).astype(np.float32)
