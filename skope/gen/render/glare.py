"""Glare: light that lens and air spread around bright lamps, visible in the dark or in fog.

It is computed on a grid coarser than the image, in linear light as the camera exposes it.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.render.daylight import temperature_color
from skope.gen.render.lit_lamps import Lit, burning_street_lights, lit_lamps, lit_signals
from skope.gen.scene.conditions import DARK_DEG, Conditions
from skope.gen.scene.recording import Moment
from skope.gen.scenery.build import Scenery
from skope.types import Array


@dataclass(frozen=True)
class GlareStrengths:
    """Strengths and limits of the lamps' glare."""

    cell_px: int = 4
    """Pixels of the image per cell of the grid, on each axis."""
    haze_visibility_m: float = 2000.0
    """Visibility below which lamps glare by day too, metres."""
    street_light: float = 0.9
    """Glare of a street light."""
    signal: float = 0.4
    """Glare of a traffic signal."""
    smear_factor: float = 6.0
    """Factor on the mean glare around lamps that dirty glass spreads far."""
    far_widths: float = 0.06
    """Distance over which dirty glass spreads glare, as a share of the image's width."""
    full_within_m: float = 15.0
    """Distance within which lamps have their full glare, metres."""
    least_glare: float = 0.006
    """Exposed glare below which it is not drawn."""
    surface_slack_m: float = 0.35
    """Maximum distance by which a surface may be nearer than a lamp without hiding it, metres."""


GLARE_STRENGTHS: Final = GlareStrengths()


class Glare:
    """Spreads the light of a recording's lamps."""

    def __init__(self, camera: Camera, conditions: Conditions, town: Scenery, depth: NDArray[np.float32]) -> None:
        """Prepare a recording's lamps; `depth` is that of the scenery."""
        self._camera, self._signals = camera, town.signals
        self._dark = conditions.sun_elevation_deg < DARK_DEG
        self.seen = self._dark or conditions.visibility_m < GLARE_STRENGTHS.haze_visibility_m
        self._strength = conditions.glare * (1.0 if self._dark else 0.25)
        self._dirt = conditions.lens_dirt
        self._scatter = 3.0 / conditions.visibility_m
        shape = (-(-camera.height // GLARE_STRENGTHS.cell_px), -(-camera.width // GLARE_STRENGTHS.cell_px), 3)
        self._still = np.zeros(shape, dtype=np.float32)
        if self._dark and conditions.street_lighting > 0:
            color = tuple(temperature_color(conditions.street_light_k).tolist())
            down = np.array([0.0, 0.0, -1.0])
            lamps = burning_street_lights(town.lamps, conditions.street_lights_lit)[:, :3]
            lit = [
                Lit(-1, lamp, down, color, GLARE_STRENGTHS.street_light * conditions.street_lighting) for lamp in lamps
            ]
            self._add_lamps(self._still, lit, depth, None)

    def spread(
        self, rgb: NDArray[np.uint8], depth: NDArray[np.float32], ids: NDArray[np.int32], moment: Moment
    ) -> NDArray[np.uint8]:
        """Draw the glare of the lamps that are lit at a moment into the image (H, W, 3), and return it."""
        if not self.seen:
            return rgb
        light = self._still.copy()
        self._add_lamps(light, lit_lamps(moment), depth, ids)
        signals = (
            Lit(-1, center, facing, color, GLARE_STRENGTHS.signal)
            for center, facing, color in lit_signals(self._camera, moment, self._signals)
        )
        self._add_lamps(light, signals, depth, None)
        if not light.any():
            return rgb
        if self._dirt:
            light += GLARE_STRENGTHS.smear_factor * self._dirt * _far_around(light)
        veil = np.rint(255 * np.sqrt(1 - np.exp(-1.6 * light))).astype(np.uint8)
        rows = np.flatnonzero(veil.any(axis=(1, 2)))
        first, end = (
            GLARE_STRENGTHS.cell_px * int(rows[0]),
            min(GLARE_STRENGTHS.cell_px * int(rows[-1] + 1), rgb.shape[0]),
        )
        veil = veil[rows[0] : rows[-1] + 1]
        veil = cv2.resize(
            veil,
            (GLARE_STRENGTHS.cell_px * veil.shape[1], GLARE_STRENGTHS.cell_px * veil.shape[0]),
            interpolation=cv2.INTER_LINEAR,
        )
        veil, under = veil[: end - first, : rgb.shape[1]], rgb[first:end]
        # Screen blending: bright pixels gain less.
        cv2.add(under, cv2.multiply(veil, cv2.bitwise_not(under), scale=1 / 255), dst=under)
        return rgb

    def _add_lamps(
        self, light: NDArray[np.float32], lit: Iterable[Lit], depth: NDArray[np.float32], ids: NDArray[np.int32] | None
    ) -> None:
        """Add the lamps that the camera sees to the grid."""
        camera, lamps = self._camera, list(lit)
        if not lamps:
            return
        centers = np.stack([lamp.center for lamp in lamps])
        toward = camera.position - centers
        distances = np.linalg.norm(toward, axis=1)
        cosines = (toward * np.stack([lamp.facing for lamp in lamps])).sum(axis=1) / distances
        turned_away = (cosines <= 0.05) & np.array([lamp.index >= 0 for lamp in lamps])
        pixels, z, valid = camera.project(centers)
        for i in np.flatnonzero(valid & camera.inside(pixels) & ~turned_away).tolist():
            lamp, away = lamps[i], float(distances[i])
            if self._is_hidden(lamp, pixels[i], float(z[i]), depth, ids):
                continue
            aimed = 0.35 + 0.65 * max(float(cosines[i]), 0.0) ** 2
            strength = self._strength * lamp.intensity * aimed * min(1.0, GLARE_STRENGTHS.full_within_m / away) ** 1.1
            color = np.array(lamp.color, dtype=np.float32)
            scale = camera.width / 1920
            through = float(np.exp(-self._scatter * away))
            _add_spread_light(light, pixels[i] / GLARE_STRENGTHS.cell_px, 2.2 * scale, strength * through * color)
            # Fog droplets scatter light mostly forwards.
            halo = strength * (1 - np.exp(-self._scatter * min(away, 60.0))) * 0.5
            _add_spread_light(light, pixels[i] / GLARE_STRENGTHS.cell_px, 11.0 * scale, halo * color)

    @staticmethod
    def _is_hidden(
        lamp: Lit, pixel: Array, z: float, depth: NDArray[np.float32], ids: NDArray[np.int32] | None
    ) -> bool:
        column, row = pixel.astype(int)
        if ids is not None and ids[row, column] == lamp.index + 1:
            return False
        return bool(depth[row, column] < z - GLARE_STRENGTHS.surface_slack_m)


def _far_around(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the light on the grid (h, w, 3) with a blur wide enough to remove most detail."""
    height, width = light.shape[:2]
    small = cv2.resize(light, (max(width // 8, 1), max(height // 8, 1)), interpolation=cv2.INTER_AREA)
    wide = cv2.GaussianBlur(small, (0, 0), max(GLARE_STRENGTHS.far_widths * small.shape[1], 0.5))
    return np.asarray(cv2.resize(wide, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32)


@lru_cache(maxsize=64)
def _point_spread(radius: int, core: float) -> NDArray[np.float32]:
    """Return a point-spread function (2 r + 1, 2 r + 1) with the falloff of glare in eyes and lenses.

    It is 1 in the middle.
    """
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1].astype(np.float32)
    square = (x * x + y * y) / (core * core)
    edge = np.clip(1 - np.sqrt(x * x + y * y) / radius, 0, 1)
    return np.asarray((1 + square) ** -1.3 * edge, dtype=np.float32)


def _add_spread_light(light: NDArray[np.float32], center: Array, core: float, color: NDArray[np.float32]) -> None:
    """Add a lamp's spread light around `center`, in cells."""
    peak = float(color.max())
    if peak < GLARE_STRENGTHS.least_glare:
        return
    core = max(core, 0.7)
    radius = max(2, int(min(9.0, (peak / GLARE_STRENGTHS.least_glare) ** 0.4) * core))
    height, width = light.shape[:2]
    x, y = (int(v) for v in np.floor(center))
    x0, y0, x1, y1 = max(x - radius, 0), max(y - radius, 0), min(x + radius + 1, width), min(y + radius + 1, height)
    spread = _point_spread(radius, core)[y0 - y + radius : y1 - y + radius, x0 - x + radius : x1 - x + radius]
    light[y0:y1, x0:x1] += spread[..., None] * color
