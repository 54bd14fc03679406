"""Renderer with pybullet's own TinyRenderer: the fallback that needs no graphics library.

The camera does not move, so the scenery is drawn once per recording. Each frame draws only its vehicles, each by itself
in its own window. The layers are then composed by depth. That gives every vehicle's whole silhouette, and the frame
without it, at no further cost. Everything is drawn three times as fine as the image. The middle of each 3 x 3 samples
is the pixel's centre (depth, ids); their mean is its colour.
"""

import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.mesh import Mesh
from skope.gen.render.frame import SKY_ID, STATIC_ID, RenderedFrame, Silhouette
from skope.gen.render.glare import Glare
from skope.gen.render.lit_lamps import light_signals
from skope.gen.render.materials import (
    COLOR_TYPE,
    GROUND_MATERIALS,
    MATERIAL_COLORS,
    MATERIAL_PATTERNS,
    Light,
    Palette,
    grain,
    named_color,
)
from skope.gen.render.pixel_windows import WINDOW_LIMITS, Window, hull_of, window_of
from skope.gen.render.spray import Spray
from skope.gen.scene.recording import LAMP_BITS, Moment, RecordedVehicle, Recording, body_of
from skope.gen.scenery.build import scenery
from skope.gen.simulation.pybullet_engine import engine
from skope.gen.towns.town import Town
from skope.gen.vehicles.model import MODEL_PARTS, Body
from skope.gen.vehicles.paints import ALL_PAINTS
from skope.types import Array

Slices = tuple[slice, slice]


@dataclass(frozen=True)
class TinyRendererLimits:
    """Resolution and light of pybullet's renderer."""

    samples: int = 3
    """Samples per pixel and axis."""
    far_m: float = 1200.0
    """Distance of the far plane, metres."""
    shadow: float = 0.45
    """Share of the road's light that a vehicle's shadow removes."""
    wet_loss: float = 0.4
    """Share of the road's light that water removes."""


TINY_LIMITS: Final = TinyRendererLimits()


@dataclass(frozen=True, eq=False)
class _FineLayer:
    """Samples of a window of the image, at `TINY_LIMITS.samples` times its resolution."""

    x: int
    y: int
    """The window's first column and row in image pixels; may be negative."""
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    """Planar depth z; +inf if nothing was hit."""
    part: NDArray[np.int32]
    """Index of the mesh part that was hit; -1 if none was."""

    @property
    def window(self) -> Window:
        rows, columns = self.depth.shape
        return self.x, self.y, self.x + columns // TINY_LIMITS.samples, self.y + rows // TINY_LIMITS.samples

    def within(self, window: Window) -> tuple[Slices, Slices] | None:
        """Return the fine samples of a window that the layer covers, and the layer's own samples there.

        Return None if they do not overlap.
        """
        x0, y0, x1, y1 = (f(a, b) for f, a, b in zip((max, max, min, min), self.window, window, strict=True))
        if x0 >= x1 or y0 >= y1:
            return None
        in_window, in_layer = (
            (
                slice((y0 - y) * TINY_LIMITS.samples, (y1 - y) * TINY_LIMITS.samples),
                slice((x0 - x) * TINY_LIMITS.samples, (x1 - x) * TINY_LIMITS.samples),
            )
            for x, y in (window[:2], (self.x, self.y))
        )
        return in_window, in_layer


class _Stage:
    """A pybullet client that holds the parts of one object and draws windows of it."""

    def __init__(self) -> None:
        self._engine = engine()
        self._client = self._engine.connect(self._engine.DIRECT)
        weakref.finalize(self, self._engine.disconnect, self._client)
        self.parts: list[str] = []
        self._bodies: list[int] = []

    def add(self, mesh: Mesh, colors: Mapping[str, COLOR_TYPE]) -> list[int]:
        """Add a mesh, one body per material; return the indices of its parts."""
        first = len(self._bodies)
        for material, part in mesh.by_material().items():
            shape = self._engine.createVisualShape(
                self._engine.GEOM_MESH,
                vertices=part.vertices.tolist(),
                indices=part.triangles.ravel().tolist(),
                normals=part.normals.tolist(),
                rgbaColor=[*(named_color(material) or colors[material]), 1],
                specularColor=[0, 0, 0],
                physicsClientId=self._client,
            )
            body = self._engine.createMultiBody(0, -1, shape, physicsClientId=self._client)
            assert body == len(self._bodies)
            self._bodies.append(body)
            self.parts.append(material)
        return list(range(first, len(self._bodies)))

    def paint(self, part: int, color: COLOR_TYPE) -> None:
        self._engine.changeVisualShape(self._bodies[part], -1, rgbaColor=[*color, 1], physicsClientId=self._client)

    def move(self, part: int, T: Array) -> None:
        orientation = quaternion(T[:3, :3])
        self._engine.resetBasePositionAndOrientation(
            self._bodies[part], T[:3, 3], orientation, physicsClientId=self._client
        )

    def draw(self, camera: Camera, T_camera_stage: Array, window: Window, light: Light) -> _FineLayer:
        """Draw a window (x0, y0, x1, y1) of the image, in image pixels."""
        x0, y0, x1, y1 = window
        width, height = (x1 - x0) * TINY_LIMITS.samples, (y1 - y0) * TINY_LIMITS.samples
        fx, fy = camera.K[0, 0] * TINY_LIMITS.samples, camera.K[1, 1] * TINY_LIMITS.samples
        # TinyRenderer samples at integer continuous coordinates, counted from the lower left. The centres are half a
        # sample to the right and up.
        cx, cy = (camera.K[0, 2] - x0) * TINY_LIMITS.samples - 0.5, (camera.K[1, 2] - y0) * TINY_LIMITS.samples + 0.5
        projection = np.zeros((4, 4))
        projection[0, 0], projection[0, 2] = 2 * fx / width, 1 - 2 * cx / width
        projection[1, 1], projection[1, 2] = 2 * fy / height, 2 * cy / height - 1
        projection[2, 2:] = (
            -(TINY_LIMITS.far_m + WINDOW_LIMITS.clip_depth_m) / (TINY_LIMITS.far_m - WINDOW_LIMITS.clip_depth_m),
            -2 * TINY_LIMITS.far_m * WINDOW_LIMITS.clip_depth_m / (TINY_LIMITS.far_m - WINDOW_LIMITS.clip_depth_m),
        )
        projection[3, 2] = -1
        view = np.diag([1.0, -1.0, -1.0, 1.0]) @ T_camera_stage
        sun = T_camera_stage[:3, :3].T @ camera.T_camera_world[:3, :3] @ np.array(light.direction)
        _, _, rgba, buffer, segmentation = self._engine.getCameraImage(
            width,
            height,
            view.T.ravel().tolist(),
            projection.T.ravel().tolist(),
            lightDirection=(100 * sun).tolist(),
            lightColor=light.tint,
            lightAmbientCoeff=light.ambient,
            lightDiffuseCoeff=light.sun,
            lightSpecularCoeff=0.0,
            shadow=0,
            renderer=self._engine.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        part = np.reshape(np.asarray(segmentation, dtype=np.int32), (height, width))
        depth = np.reshape(np.asarray(buffer, dtype=np.float64), (height, width))
        z = (
            TINY_LIMITS.far_m
            * WINDOW_LIMITS.clip_depth_m
            / (TINY_LIMITS.far_m - (TINY_LIMITS.far_m - WINDOW_LIMITS.clip_depth_m) * depth)
        )
        rgb = np.reshape(np.asarray(rgba, dtype=np.uint8), (height, width, 4))[..., :3]
        through = np.exp(-light.haze_density * z).astype(np.float32)[..., None]
        rgb = (rgb * through + 255 * np.array(light.horizon, np.float32) * (1 - through)).astype(np.uint8)
        return _FineLayer(x0, y0, np.ascontiguousarray(rgb), np.where(part >= 0, z, np.inf).astype(np.float32), part)


# pybullet releases little of a closed client's memory (140 MB for a town), so recordings share clients.


@cache
def _town_stage(town: Town) -> _Stage:
    stage = _Stage()
    stage.add(scenery(town).mesh, Palette.of(town).plain)
    return stage


@lru_cache(maxsize=256)
def _vehicle_stage(vehicle: Body) -> tuple[_Stage, list[list[int]]]:
    """Return the stage of a vehicle, and its parts on the stage for each of its moving parts, its body first."""
    stage = _Stage()
    colors = {**MATERIAL_COLORS, "paint": (0.5, 0.5, 0.5)}
    return stage, [stage.add(mesh, colors) for mesh in vehicle.parts]


class TinyRenderer:
    """Draws the frames of one recording with TinyRenderer."""

    def __init__(self, recording: Recording) -> None:
        self._recording, self._camera = recording, recording.camera
        self._light = Light.of(recording.conditions)
        self._image: Window = (0, 0, recording.camera.width, recording.camera.height)
        self._signals = scenery(recording.town).signals
        self._background, self._ground = self._draw_background()
        depth = self._background.depth[
            TINY_LIMITS.samples // 2 :: TINY_LIMITS.samples, TINY_LIMITS.samples // 2 :: TINY_LIMITS.samples
        ]
        self._glare = Glare(self._camera, recording.conditions, scenery(recording.town), depth)
        self._spray = Spray(self._camera, recording.conditions)

    # ------------------------------------------------------------------------------------------------------ scenery

    def _draw_background(self) -> tuple[_FineLayer, NDArray[np.bool_]]:
        camera = self._camera
        stage = _town_stage(self._recording.town)
        layer = stage.draw(camera, camera.T_camera_world, self._image, self._light)
        is_ground = np.array(
            [*(name in GROUND_MATERIALS for name in stage.parts), False]
        )  # part -1, the sky, is the last
        ground = is_ground[layer.part]
        if (photograph := self._recording.photograph) is not None:
            fine = photograph.repeat(TINY_LIMITS.samples, axis=0).repeat(TINY_LIMITS.samples, axis=1)
            return _FineLayer(0, 0, fine, layer.depth, layer.part), ground
        rows, columns = np.mgrid[: layer.depth.shape[0], : layer.depth.shape[1]]
        pixels = (np.stack([columns, rows], axis=-1) + 0.5) / TINY_LIMITS.samples
        rgb = layer.rgb.astype(np.float32)
        positions, _ = camera.unproject(pixels, np.where(ground, layer.depth, 0))
        wet = np.float32(1 - TINY_LIMITS.wet_loss * self._recording.conditions.wetness)
        rgb *= np.where(ground, wet * grain(positions[..., :2]), np.float32(1))[..., None]
        sky = layer.part < 0
        rays, _ = camera.rays(pixels[sky])
        up = (rays @ camera.T_camera_world[:3, :3])[:, 2] / np.linalg.norm(rays, axis=-1)
        share = np.clip(up / 0.5, 0, 1)[:, None] ** 0.6
        zenith, horizon = np.array(self._light.zenith), np.array(self._light.horizon)
        rgb[sky] = 255 * (horizon + (zenith - horizon) * share)
        return _FineLayer(0, 0, np.clip(rgb, 0, 255).astype(np.uint8), layer.depth, layer.part), ground

    # ----------------------------------------------------------------------------------------------------- vehicles

    def _draw_vehicle(self, recorded: RecordedVehicle, T_world_parts: Array, lamps: int) -> _FineLayer | None:
        """Draw a vehicle by itself; return None if it lies outside the image."""
        chassis = T_world_parts[0]
        T_camera_chassis = self._camera.T_camera_world @ chassis
        vehicle = body_of(recorded)
        window = window_of(hull_of(vehicle, T_world_parts, self._camera), self._camera)
        if window is None:
            return None
        stage, on_stage = _vehicle_stage(vehicle)
        for part in [part for k, some in enumerate(on_stage) if k in (0, MODEL_PARTS.trailer_part) for part in some]:
            if stage.parts[part] in ("paint", "livery"):
                paint = ALL_PAINTS[recorded.color]
                red, green, blue = paint.rgb if stage.parts[part] == "paint" else paint.livery
                stage.paint(part, (red / 255, green / 255, blue / 255))
            if stage.parts[part] == "brake_light":
                stage.paint(
                    part,
                    MATERIAL_PATTERNS.brake_light if lamps & LAMP_BITS["brake"] else MATERIAL_COLORS["brake_light"],
                )
        T_chassis_world = np.linalg.inv(chassis)
        for some, T_world_part in zip(on_stage[1:], T_world_parts[1:], strict=False):
            for part in some:
                stage.move(part, T_chassis_world @ T_world_part)
        return stage.draw(self._camera, T_camera_chassis, window, self._light)

    def _shadowed_background(self, moment: Moment) -> NDArray[np.uint8]:
        """Return the background with the vehicles' shadows on the ground."""
        mask = np.zeros(self._ground.shape, dtype=np.uint8)
        contact = np.zeros_like(mask)
        for mesh, T in _bodies(moment):
            points = mesh.vertices @ T[:3, :3].T + T[:3, 3]
            height = points[:, 2:] - T[2, 3]
            flat = points * [1, 1, 0] + [0, 0, T[2, 3]]
            if self._light.shadows:
                sun = np.array(self._light.direction)
                self._fill_hull(mask, flat - height * np.array([*(sun[:2] / sun[2]), 0.0]))
            self._fill_hull(contact, flat)
        if not contact.any():
            return self._background.rgb.copy()
        shade = 1 - TINY_LIMITS.shadow * cv2.blur(mask, (3, 3)).astype(np.float32) / 255
        shade *= 1 - 0.35 * cv2.blur(contact, (7, 7)).astype(np.float32) / 255
        shade = np.where(self._ground, shade, np.float32(1))
        return (self._background.rgb * shade[..., None]).astype(np.uint8)

    def _fill_hull(self, mask: NDArray[np.uint8], points: Array) -> None:
        """Fill the convex hull of ground points (N, 3) in a fine mask."""
        pixels, depth, valid = self._camera.project(points)
        if (
            valid.all()
            and (depth > WINDOW_LIMITS.clip_depth_m).all()
            and np.abs(pixels).max() < 20 * self._camera.width
        ):
            hull = cv2.convexHull((pixels * TINY_LIMITS.samples).astype(np.int32))
            cv2.fillConvexPoly(mask, hull, 255)

    # ------------------------------------------------------------------------------------------------------- frames

    def render(self, frame: int) -> RenderedFrame:
        """Draw a frame."""
        moment = self._recording.moment(frame)
        layers = [
            self._draw_vehicle(recorded, moment.part_poses(i), int(moment.lamps[i]))
            for i, recorded in enumerate(moment.vehicles)
        ]
        shaded = self._shadowed_background(moment)
        rgb, depth = shaded.copy(), self._background.depth.copy()
        ids = np.where(self._background.part >= 0, STATIC_ID, SKY_ID).astype(np.int32)
        for i, layer in enumerate(layers):
            _draw_layer(layer, self._image, rgb, depth, ids, i + 1)
        light_signals(rgb, depth, self._camera, moment, self._signals, TINY_LIMITS.samples)
        clean = _mean_colors(rgb)
        middle = ids[TINY_LIMITS.samples // 2 :: TINY_LIMITS.samples, TINY_LIMITS.samples // 2 :: TINY_LIMITS.samples]
        contrast = np.array([self._contrast(i, layers, shaded, clean, middle) for i in range(len(layers))])
        coarse = np.ascontiguousarray(
            depth[TINY_LIMITS.samples // 2 :: TINY_LIMITS.samples, TINY_LIMITS.samples // 2 :: TINY_LIMITS.samples]
        )
        wet = self._spray.drift(np.rint(clean).astype(np.uint8), coarse, moment, frame)
        return RenderedFrame(
            self._glare.spread(wet, coarse, middle, moment),
            coarse,
            _slope(depth),
            np.ascontiguousarray(middle),
            tuple(_silhouette(layer) for layer in layers),
            contrast,
        )

    def _contrast(
        self,
        i: int,
        layers: list[_FineLayer | None],
        shaded: NDArray[np.uint8],
        clean: NDArray[np.float32],
        ids: NDArray[np.int32],
    ) -> float:
        """Return the difference between the visible pixels of vehicle i and the image without it."""
        layer = layers[i]
        overlap = layer.within(self._image) if layer else None
        if layer is None or overlap is None:
            return 0.0
        fine = overlap[0]
        coarse = tuple(slice(s.start // TINY_LIMITS.samples, s.stop // TINY_LIMITS.samples) for s in fine)
        visible = ids[coarse] == i + 1
        if not visible.any():
            return 0.0
        rgb, depth = shaded[fine].copy(), self._background.depth[fine].copy()
        window = (coarse[1].start, coarse[0].start, coarse[1].stop, coarse[0].stop)
        for other_layer in (*layers[:i], *layers[i + 1 :]):
            _draw_layer(other_layer, window, rgb, depth)
        return float(np.abs(clean[coarse] - _mean_colors(rgb))[visible].mean())


def _bodies(moment: Moment) -> Iterator[tuple[Mesh, Array]]:
    """Yield the bodies and trailers of a moment, each with its pose (4, 4)."""
    for i, recorded in enumerate(moment.vehicles):
        vehicle = body_of(recorded)
        yield vehicle.mesh, moment.T_world_chassis[i]
        if vehicle.trailer:
            yield vehicle.trailer.mesh, moment.T_world_trailer[i, 0]


def _draw_layer(
    layer: _FineLayer | None,
    window: Window,
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32],
    ids: NDArray[np.int32] | None = None,
    number: int = 0,
) -> None:
    """Draw a layer over the fine buffers of a window, where it is nearer."""
    overlap = layer.within(window) if layer else None
    if layer is None or overlap is None:
        return
    in_window, in_layer = overlap
    nearer = layer.depth[in_layer] < depth[in_window]
    depth[in_window][nearer] = layer.depth[in_layer][nearer]
    rgb[in_window][nearer] = layer.rgb[in_layer][nearer]
    if ids is not None:
        ids[in_window][nearer] = number


def quaternion(R: Array) -> list[float]:
    """Return the unit quaternion x, y, z, w of a rotation, by its largest component (Shepperd's method)."""
    q = np.array([R[0, 0], R[1, 1], R[2, 2], R.trace()])
    k = int(q.argmax())
    if k == 3:
        out = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1 + q[3]])
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        out = np.zeros(4)
        out[k] = 1 + R[k, k] - R[i, i] - R[j, j]
        out[i], out[j] = R[i, k] + R[k, i], R[j, k] + R[k, j]
        out[3] = R[j, i] - R[i, j]
    result: list[float] = (out / np.linalg.norm(out)).tolist()
    return result


def _mean_colors(rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return image colours from fine colours, before rounding."""
    rows, columns = rgb.shape[0] // TINY_LIMITS.samples, rgb.shape[1] // TINY_LIMITS.samples
    return np.asarray(cv2.resize(rgb.astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA))


def _slope(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the slope (H, W, 2) of the surface at pixel centres, from the fine depth."""
    m = TINY_LIMITS.samples // 2
    inverse = 1 / depth.astype(np.float64)
    center = inverse[m :: TINY_LIMITS.samples, m :: TINY_LIMITS.samples]
    z = np.divide(1, center, out=np.zeros_like(center), where=center > 0)
    change = np.stack(
        [_line_slope(inverse[m :: TINY_LIMITS.samples]), _line_slope(inverse[:, m :: TINY_LIMITS.samples].T).T], axis=-1
    )
    return np.asarray(-change * (z * z)[..., None], dtype=np.float32)


def _line_slope(inverse: Array) -> Array:
    """Return the change of the inverse depth per pixel along fine rows: (R, C * FINE) -> (R, C).

    The result is 0 if no neighbours lie on the surface. On a plane the inverse depth is linear in the pixel. There are
    three groups of samples: before, around and after a centre. The straightest group belongs to the visible surface;
    the others reach over an edge to another surface.
    """
    padded = np.pad(inverse, ((0, 0), (1, 1)), mode="edge")
    a, b, c, d, e = (padded[:, k : k + inverse.shape[1] : TINY_LIMITS.samples] for k in range(TINY_LIMITS.samples + 2))
    slopes = np.stack([c - a, d - b, e - c]) / 2
    bends = np.abs(np.stack([c - 2 * b + a, d - 2 * c + b, e - 2 * d + c]))
    straightest = bends.argmin(axis=0)[None]
    slope, bend = (np.take_along_axis(values, straightest, axis=0)[0] for values in (slopes, bends))
    return np.asarray(TINY_LIMITS.samples * np.where(bend < 0.25 * np.abs(slope), slope, 0.0))


def _silhouette(layer: _FineLayer | None) -> Silhouette:
    if layer is None:
        return Silhouette(0, 0, np.zeros((0, 0), dtype=bool))
    return Silhouette(
        layer.x,
        layer.y,
        layer.part[TINY_LIMITS.samples // 2 :: TINY_LIMITS.samples, TINY_LIMITS.samples // 2 :: TINY_LIMITS.samples]
        >= 0,
    )
