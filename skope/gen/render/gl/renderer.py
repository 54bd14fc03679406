"""Renders a recording's frames with OpenGL.

The scenery's light comes from `background`, worked out once. Per frame only the vehicles are drawn, in the tiles that
they and their shadows may touch: once for depth, slope and ids at pixel centres, once per vehicle for its whole
silhouette, and in colour over the scenery.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.recording import Recording
from skope.gen.render import Silhouette, View
from skope.gen.render.gl.background import SCALE, light_the_scenery
from skope.gen.render.gl.beams import Beams
from skope.gen.render.gl.context import Device, DeviceMesh, light_projection, projection, put
from skope.gen.render.gl.lamps import MAP_RADIUS
from skope.gen.render.gl.motion import Moving, moving
from skope.gen.render.gl.placer import PARTS, Placed, Placer
from skope.gen.render.gl.reflections import Reflections
from skope.gen.render.glare import Glare
from skope.gen.render.signals import light_signals
from skope.gen.render.windows import (
    CONTACT,
    Window,
    crossing,
    hull_of,
    inside,
    runs,
    shadow_hull_of,
    tiles,
    union,
)
from skope.gen.towns.scenery import scenery
from skope.gen.vehicles.model import Body

Array = NDArray[np.float64]

SHADOW_MAP: Final = 2048
FAR: Final = 30.0
"""Vehicles farther from the camera than this are drawn coarsely in colour, and nobody sees through their windows."""
SHADOW_RADIUS: Final = 60.0
"""Vehicles nearer to the middle of the view than this throw shadows, metres."""
HAZY: Final = 1e-3
"""Extinction of the air, 1/m, from which on it shows before vehicles' shadows."""
CONTACT_MAP: Final = 1024
"""Texels of the map of the sky that vehicles take from the road, over the same area."""


class GLRenderer:
    """Draws the frames of one recording."""

    def __init__(self, recording: Recording) -> None:
        camera = recording.camera
        self._recording, self._camera = recording, camera
        self._device = device()
        self._background = light_the_scenery(self._device, recording)
        self._placer = Placer(self._device, camera)
        size = (camera.width, camera.height)
        self._image: Window = (0, 0, *size)
        self._project = projection(camera.K, self._image)
        self._geometry = self._device.target(size, ["4f4"])
        self._color = self._device.target((SCALE * size[0], SCALE * size[1]), ["4f1"])
        self._behind = self._device.target(size, ["4f1"])
        self._display = self._device.target(size, ["4f1"], depth=False)
        self._sun_map = self._device.shadow_map(SHADOW_MAP)
        self._open = self._device.target((CONTACT_MAP, CONTACT_MAP), ["1f1"], depth=False)
        # The average of a pixel's samples is a look-up half way between them.
        for texture in (*self._color.color_attachments, *self._open.color_attachments):
            texture.filter = (self._device.gl.LINEAR, self._device.gl.LINEAR)
        self._sun_clip, self._sun_map_from = light_projection(
            self._background.daylight.sun_direction, self._background.focus, SHADOW_RADIUS
        )
        self._uniforms = {
            "u_size": list(size),
            "u_world_from_pixel": camera.T_camera_world[:3, :3].T @ np.linalg.inv(camera.K),
            "u_vehicle_sun_map_from": self._sun_map_from,
            "u_sun_map_from": self._sun_map_from,
            "u_sun_at": self._sun_map_from[:3] @ [0, 0, 0.02, 1],
            "u_open_at": 0.5 - self._background.focus[:2] / (2 * SHADOW_RADIUS),
            "u_open_scale": 0.5 / SHADOW_RADIUS,
            "u_eye_height": float(camera.position[2]),
            "u_texel": 0.04 * 0.5 / SHADOW_RADIUS,
        }
        self._options: tuple[str, ...] = ()
        """What vehicles' programs are compiled for, for this recording's light."""
        background, middle = self._background, camera.position + self._background.focus
        self._beams = self._reflections = None
        if background.daylight.dark:
            self._options = ("LAMPS",)
            self._beams = Beams(self._device, middle, SHADOW_RADIUS, background.daylight.exposure)
            self._uniforms |= {
                **self._beams.uniforms,
                "u_lamp_vectors_at": 0.5 - background.focus[:2] / (2 * MAP_RADIUS),
                "u_lamp_vectors_scale": 0.5 / MAP_RADIUS,
                "u_plane": background.road.uniform,
            }
        if background.mirrored_depth:
            self._reflections = Reflections(
                self._device, camera, background.road, background.mirrored_depth, *self._options
            )
        self._glare = Glare(camera, recording.conditions, scenery(recording.town), background.depth)
        self._compose([self._image])
        self._plain = self._read_display()

    # --------------------------------------------------------------------------------------------------------- frames

    def render(self, frame: int) -> View:
        """Draw a frame."""
        camera, moment, empty = self._camera, self._recording.moment(frame), self._background
        placed = self._placer.place(moment)
        depth, slope, ids = empty.depth.copy(), empty.slope.copy(), empty.ids.copy()
        silhouettes = [Silhouette(0, 0, np.zeros((0, 0), dtype=bool))] * len(moment.vehicles)
        contrast = np.zeros(len(moment.vehicles))
        rgb = self._plain.copy()
        if placed:
            blurred = moving(reversed(placed), moment.velocity, self._recording.conditions.shutter_s, camera)
            self._draw_geometry(placed, whole=bool(blurred))
            shown = []
            for vehicle in placed:
                layer = _read(self._geometry, inside(vehicle.window, camera), np.float32)
                shown.append(self._put(layer, vehicle, depth, slope, ids))
                alone = not any(crossing(vehicle.window, other.window) for other in placed if other is not vehicle)
                silhouettes[vehicle.index] = self._silhouette(vehicle, layer if alone else None)
            self._draw_color(placed, blurred, rgb)
            others = self._draw_behind(placed)
            for vehicle, own, other in zip(placed, shown, others, strict=True):
                x0, y0, x1, y1 = inside(vehicle.window, camera)
                difference = cv2.mean(cv2.absdiff(rgb[y0:y1, x0:x1], other), own.view(np.uint8))
                contrast[vehicle.index] = sum(difference) / 3
        light_signals(rgb, depth, camera, moment, scenery(self._recording.town).signals)
        rgb = self._glare.spread(rgb, depth, ids, moment)
        return View(rgb, depth, slope, ids, tuple(silhouettes), contrast)

    # ----------------------------------------------------------------------------------- depth, ids and whole vehicles

    def _draw_geometry(self, placed: Sequence[Placed], *, whole: bool) -> None:
        """Depth, slope and number of the nearest vehicle, whatever of the scenery stands before it.

        With `whole` the rest of the target is empty.
        """
        program = self._device.program("geometry.vert.glsl", "geometry.frag.glsl", PARTS)
        if whole:
            self._geometry.clear(0, 0, 0, 0)
        windows = [inside(vehicle.window, self._camera) for vehicle in placed]
        self._device.prepare(self._geometry, windows, self._uniforms)
        self._device.context.enable_only(self._device.gl.DEPTH_TEST | self._device.gl.CULL_FACE)
        put(program, {"u_project": self._project})
        for vehicle in placed:
            put(program, {**vehicle.matrices, "u_id": float(vehicle.number)})
            vehicle.mesh.draw(program)

    def _put(
        self,
        layer: NDArray[np.float32],
        placed: Placed,
        depth: NDArray[np.float32],
        slope: NDArray[np.float32],
        ids: NDArray[np.int32],
    ) -> NDArray[np.bool_]:
        """Put a vehicle into the frame where it is nearer than the scenery; returns where, in its window."""
        x0, y0, x1, y1 = inside(placed.window, self._camera)
        there = slice(y0, y1), slice(x0, x1)
        own = (layer[..., 3] == placed.number) & (layer[..., 0] < depth[there])
        np.copyto(depth[there], layer[..., 0], where=own)
        np.copyto(slope[there], layer[..., 1:3], where=own[..., None])
        ids[there][own] = placed.number
        return np.asarray(own)

    def _silhouette(self, placed: Placed, layer: NDArray[np.float32] | None) -> Silhouette:
        """A vehicle's silhouette, from what was drawn of its window if nothing else was drawn there."""
        device, (x0, y0, x1, y1) = self._device, placed.window
        if layer is not None and placed.window == inside(placed.window, self._camera):
            return Silhouette(x0, y0, layer[..., 3] == placed.number)
        size = (x1 - x0, y1 - y0)
        target = _mask_target(device, _rounded(size))
        program = device.program("geometry.vert.glsl", "mask.frag.glsl", PARTS)
        target.viewport = (0, 0, *size)
        target.use()
        target.clear(0, 0, 0, 0, viewport=(0, 0, *size))
        device.context.enable_only(device.gl.CULL_FACE)
        put(program, {**placed.matrices, "u_project": projection(self._camera.K, placed.window)})
        placed.mesh.draw(program)
        data = target.read(viewport=(0, 0, *size), components=1, dtype="f1", alignment=1)
        return Silhouette(x0, y0, np.frombuffer(data, dtype=np.uint8).reshape(size[1], size[0]) > 0)

    # ---------------------------------------------------------------------------------------------------------- colour

    def _draw_color(self, placed: Sequence[Placed], blurred: Sequence[Moving], rgb: NDArray[np.uint8]) -> None:
        """Draw the vehicles, their shadows, their lamps' light and their mirror images into the picture."""
        camera, sun = self._camera, self._background.daylight.sun_direction
        size = (camera.width, camera.height)
        covered = tiles([hull_of(v.vehicle, v.T_world_chassis, camera) for v in placed], size)
        shaded = tiles([shadow_hull_of(v.vehicle, v.T_world_chassis, camera, sun) for v in placed], size)
        self._draw_shadows(placed)
        if self._beams:
            shaded |= tiles(self._beams.draw(placed, camera), size)
        swept = [tiles([one.hull], size) for one in blurred]
        for places in swept:
            covered |= places
        self._draw_vehicles(self._color, placed, runs(covered, size))
        mirrored = np.zeros_like(covered)
        if self._reflections:
            units = self._vehicle_textures()
            uniforms = {**self._background.bind(), **self._uniforms, **self._bind(units)}
            mirrored = self._reflections.draw(placed, uniforms, {**self._background.textures, **units})
        for there, more in ((~mirrored, ()), (mirrored, ("REFLECTIONS",))):
            self._compose(runs((shaded | mirrored) & ~covered & there, size), "SHADOWS", *more)
            self._compose(runs(covered & there, size), "SHADOWS", "VEHICLES", *more)
        more = ("REFLECTIONS",) if self._reflections else ()
        for one, places in zip(blurred, swept, strict=True):
            way = {"u_way": one.way, "u_id": float(one.vehicle.number), "u_nearest": one.nearest}
            self._compose(runs(places, size), "SHADOWS", "VEHICLES", "BLUR", *more, uniforms=way)
        changed = runs(covered | shaded | mirrored, size)
        window = union(changed)
        picture = _read(self._display, window, np.uint8)
        for x0, y0, x1, y1 in changed:
            rgb[y0:y1, x0:x1] = picture[y0 - window[1] : y1 - window[1], x0 - window[0] : x1 - window[0], :3]

    def _draw_shadows(self, placed: Sequence[Placed]) -> None:
        """The vehicles' shadow map, and the map of the sky that they leave the road."""
        device = self._device
        program = device.program("geometry.vert.glsl", "shadow.frag.glsl", PARTS)
        self._sun_map.use()
        self._sun_map.clear()
        device.context.enable_only(device.gl.DEPTH_TEST)
        put(program, {"u_project": self._sun_clip})
        middle = self._camera.position + self._background.focus
        for vehicle in placed:
            if (
                self._background.daylight.dark
                or np.linalg.norm(vehicle.T_world_chassis[:2, 3] - middle[:2]) > SHADOW_RADIUS + 10
            ):
                continue
            put(program, {"u_model": vehicle.matrices["u_world"], "u_world": vehicle.matrices["u_world"]})
            (vehicle.mesh if vehicle.distance < FAR else vehicle.coarse).draw(program)
        self._open.use()
        self._open.clear(1, 1, 1, 1)
        device.context.enable_only(device.gl.BLEND)
        device.context.blend_func = device.gl.ZERO, device.gl.SRC_COLOR
        corners = np.concatenate([_footprint(v.vehicle, v.T_world_chassis, middle) for v in placed])
        program = device.program("contact.vert.glsl", "contact.frag.glsl", f"CONTACT {CONTACT}")
        device.triangles(program, corners, "2f 2f 3f", "in_at", "in_local", "in_size")

    def _vehicle_textures(self) -> dict[str, Any]:
        """What vehicles' programs sample besides the background: their shadows, the light of their lamps."""
        own = {"u_vehicle_sun_map": self._sun_map.depth_attachment}
        return own | ({"u_beams": self._beams.texture} if self._beams else {})

    def _draw_vehicles(
        self, target: Any, placed: Sequence[Placed], places: Sequence[Window], *, peel: bool = False
    ) -> None:
        """Draw the vehicles' picture into parts of a target, where the scenery does not hide them.

        With `peel` it is a plain one of what stands behind the vehicles shown.
        """
        device, gl = self._device, self._device.gl
        uniforms = {**self._background.bind(), **self._uniforms}
        device.prepare(target, places, uniforms, "SCENERY", f"STEP {SCALE * self._camera.width // target.width}")
        device.context.enable_only(gl.DEPTH_TEST | gl.CULL_FACE)
        units = {**self._vehicle_textures(), "u_front": self._geometry.color_attachments[0]}
        uniforms |= {**self._bind(units), "u_project": self._project}

        def draw(option: str, meshes: Iterable[tuple[Placed, DeviceMesh | None]]) -> None:
            program = device.program("vehicle.vert.glsl", "vehicle.frag.glsl", PARTS, option, *self._options)
            put(program, uniforms)
            for vehicle, mesh in meshes:
                if mesh:
                    put(program, {**vehicle.matrices, **vehicle.look, "u_id": float(vehicle.number)})
                    mesh.draw(program)

        if peel:
            draw("PEEL", ((vehicle, vehicle.mesh) for vehicle in placed))
            return
        near = [vehicle for vehicle in placed if vehicle.distance < FAR]
        draw("SOLID", ((vehicle, vehicle.solid if vehicle.distance < FAR else vehicle.coarse) for vehicle in placed))
        # Through the windows the insides of the far walls are seen.
        device.context.cull_face = "front"
        draw("SOLID", ((vehicle, vehicle.coarse) for vehicle in near))
        device.context.cull_face = "back"
        # Panes last, from far to near, over what is seen through them.
        device.context.enable_only(gl.DEPTH_TEST | gl.CULL_FACE | gl.BLEND)
        device.context.blend_func = gl.ONE, gl.ONE_MINUS_SRC_ALPHA
        draw("PANES", ((vehicle, vehicle.panes) for vehicle in reversed(near)))

    def _compose(
        self, places: Sequence[Window], *options: str, uniforms: Mapping[str, Any] = MappingProxyType({})
    ) -> None:
        """Put parts of the picture together."""
        if not places:
            return
        device, wet = self._device, ("WET",) if self._reflections else ()
        air = ("HAZE",) if self._background.daylight.haze_density > HAZY else ()
        program = device.program("tiles.vert.glsl", "composite.frag.glsl", *self._options, *wet, *air, *options)
        units = {
            **self._vehicle_textures(),
            **({"u_reflections": self._reflections.texture} if self._reflections else {}),
            "u_vehicles": self._color.color_attachments[0],
            "u_open": self._open.color_attachments[0],
            "u_front": self._geometry.color_attachments[0],
        }
        put(program, {**self._background.bind(), **self._uniforms, **self._bind(units), **uniforms})
        self._display.use()
        device.context.enable_only(device.gl.NOTHING)
        device.tiles(program, places)

    def _bind(self, textures: dict[str, Any]) -> dict[str, int]:
        """Put textures into places after the background's; returns the uniforms."""
        first = len(self._background.textures)
        for unit, texture in enumerate(textures.values(), start=first):
            texture.use(unit)
        return {name: unit for unit, name in enumerate(textures, start=first)}

    def _read_display(self) -> NDArray[np.uint8]:
        return np.ascontiguousarray(_read(self._display, self._image, np.uint8)[..., :3])

    def _draw_behind(self, placed: Sequence[Placed]) -> list[NDArray[np.uint8]]:
        """For each vehicle, what its window of the image would show without it and its shadow."""
        crowd = [v for v in placed if any(crossing(v.window, w.window) for w in placed if w is not v)]
        if crowd:
            hulls = [hull_of(v.vehicle, v.T_world_chassis, self._camera) for v in crowd]
            size = (self._camera.width, self._camera.height)
            self._draw_vehicles(self._behind, crowd, runs(tiles(hulls, size), size), peel=True)
            window = union([inside(v.window, self._camera) for v in crowd])
            layer = _Layer(window, _read(self._behind, window, np.uint8))
        out = []
        for vehicle in placed:
            x0, y0, x1, y1 = inside(vehicle.window, self._camera)
            picture: NDArray[Any] = self._plain[y0:y1, x0:x1]
            if vehicle in crowd:
                behind = layer.crop((x0, y0, x1, y1))
                picture = cv2.copyTo(behind[..., :3], behind[..., 3], picture.copy())
            out.append(picture)
        return out


@dataclass(frozen=True, eq=False)
class _Layer:
    """Pixels of a window of the image."""

    window: Window
    pixels: NDArray[Any]
    """(h, w, C)"""

    def crop(self, window: Window) -> NDArray[Any]:
        """Those of a window within it."""
        x, y = self.window[:2]
        x0, y0, x1, y1 = window
        return self.pixels[y0 - y : y1 - y, x0 - x : x1 - x]


def _viewport(window: Window) -> tuple[int, int, int, int]:
    x0, y0, x1, y1 = window
    return x0, y0, x1 - x0, y1 - y0


def _read(target: Any, window: Window, kind: type[np.generic]) -> NDArray[Any]:
    """(h, w, 4) pixels of a window of a target."""
    viewport = _viewport(window)
    name = {np.float32: "f4", np.uint8: "f1"}[kind]  # type: ignore[index]
    data = target.read(viewport=viewport, components=4, dtype=name, alignment=1)
    return np.frombuffer(data, dtype=kind).reshape(viewport[3], viewport[2], 4)


def _footprint(vehicle: Body, T_world_chassis: Array, middle: Array) -> Array:
    """(6, 7) corners of two triangles around the ground that a vehicle takes sky from.

    Their place in the map around `middle`, their place in the vehicle's axes, half the vehicle's length and width, and
    its height.
    """
    size = np.array(vehicle.size_lwh) * [0.5, 0.5, 1.0]
    local = np.array([[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) * (size[:2] + CONTACT)
    world = local @ T_world_chassis[:2, :2].T + T_world_chassis[:2, 3]
    return np.column_stack([(world - middle[:2]) / SHADOW_RADIUS, local, np.tile(size, (6, 1))])


@cache
def device() -> Device:
    """This process's OpenGL device."""
    return Device()


@cache
def _mask_target(device: Device, size: tuple[int, int]) -> Any:
    return device.target(size, ["1f1"], depth=False)


def _rounded(size: tuple[int, int]) -> tuple[int, int]:
    """A size up to which targets are kept, so that few of them serve all silhouettes."""
    return tuple(1 << max(6, (side - 1).bit_length()) for side in size)  # type: ignore[return-value]
