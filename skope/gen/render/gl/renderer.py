"""Render a recording's frames with OpenGL.

The scenery's light comes from `background` and is computed once. Each frame draws only the vehicles, in the tiles that
they and their shadows may touch. They are drawn once for depth, slope and ids at pixel centres, once per vehicle for
the whole silhouette, and once in colour over the scenery.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.render.frame import RenderedFrame, Silhouette
from skope.gen.render.gl.background import BACKGROUND_SAMPLING, light_the_scenery
from skope.gen.render.gl.context import Device, DeviceMesh, Readback, light_projection, projection, put
from skope.gen.render.gl.ground_lights import GROUND_LIGHTS, Beams
from skope.gen.render.gl.placed_vehicles import PARTS_DEFINITION, Moving, PlacedVehicle, Placer, moving
from skope.gen.render.gl.wet_ground import Reflections
from skope.gen.render.glare import Glare
from skope.gen.render.lit_lamps import light_signals, light_signals_linear
from skope.gen.render.night_camera import NightCamera
from skope.gen.render.pixel_windows import (
    WINDOW_LIMITS,
    Window,
    crossing,
    inside_image,
    shadow_hull_of,
    tile_mask,
    tile_runs,
    tiles,
    union,
)
from skope.gen.render.spray import Spray
from skope.gen.scene.recording import Recording
from skope.gen.scenery.build import scenery
from skope.gen.vehicles.model import MODEL_PARTS
from skope.types import Array


@dataclass(frozen=True)
class RendererLimits:
    """Distances, maps and lamps of the OpenGL renderer."""

    shadow_map_texels: int = 2048
    """Side of the shadow map of vehicles, texels."""
    coarse_from_m: float = 30.0
    """Distance from the camera beyond which vehicles are drawn coarsely in colour, with opaque windows, metres."""
    shadowed_within_m: float = 60.0
    """Maximum distance from the middle of the view at which vehicles cast shadows, metres."""
    haze_extinction: float = 1e-3
    """Extinction of the air above which haze is drawn before vehicles' shadows, 1/m."""
    pulses_hz: float = 220.0
    """Approximate switching frequency of pulsed LED lamps, Hz (from dashed trails of real vehicles)."""
    pulsing_share: float = 0.4
    """Share of the vehicles with pulsed lamps."""
    golden_fraction: float = (5**0.5 - 1) / 2
    """Fractional part of the golden ratio, used to spread the phases."""
    signal_light: float = 40.0
    """Exposed light of traffic signals."""
    burnt_out: int = 245
    """Pixel value (0 to 255) at and above which a pixel shows a lamp."""
    unclipped_light: float = 6e4
    """Light level that no exposure clips."""
    contact_map_texels: int = 1024
    """Side of the map of the sky that vehicles hide from the road, texels. It covers the area of the shadow map."""


RENDERER_LIMITS: Final = RendererLimits()


class GLRenderer:
    """OpenGL renderer of the frames of one recording."""

    def __init__(self, recording: Recording, on_light: Callable[[], None]) -> None:
        """Prepare a recording.

        `on_light` is called before the light of the scenery is computed, if it is not in the cache.
        """
        camera = recording.camera
        self._recording, self._camera = recording, camera
        self._device = device()
        self._pixels = Readback(self._device.context)
        self._background = light_the_scenery(self._device, recording, on_light)
        self._placer = Placer(self._device, camera)
        size = (camera.width, camera.height)
        self._image: Window = (0, 0, *size)
        self._project = projection(camera.K, self._image)
        self._geometry = self._device.target(size, ["4f4"])
        # At night the image stays in linear light until the camera develops it.
        kind, self._read_as = ("f2", "f4") if self._background.daylight.dark else ("f1", "f1")
        self._color = self._device.target(
            (BACKGROUND_SAMPLING.vehicle_scale * size[0], BACKGROUND_SAMPLING.vehicle_scale * size[1]), [f"4{kind}"]
        )
        self._behind = self._device.target(size, [f"4{kind}"])
        self._display = self._device.target(size, [f"4{kind}"], depth=False)
        self._sun_map = self._device.shadow_map(RENDERER_LIMITS.shadow_map_texels)
        self._open = self._device.target(
            (RENDERER_LIMITS.contact_map_texels, RENDERER_LIMITS.contact_map_texels), ["1f1"], depth=False
        )
        # Sampling halfway between the samples of a pixel returns their average.
        for texture in (*self._color.color_attachments, *self._open.color_attachments):
            texture.filter = (self._device.gl.LINEAR, self._device.gl.LINEAR)
        self._sun_clip, self._sun_map_from = light_projection(
            self._background.daylight.sun_direction, self._background.focus, RENDERER_LIMITS.shadowed_within_m
        )
        self._uniforms = {
            "u_size": list(size),
            "u_world_from_pixel": camera.T_camera_world[:3, :3].T @ np.linalg.inv(camera.K),
            "u_vehicle_sun_map_from": self._sun_map_from,
            "u_sun_map_from": self._sun_map_from,
            "u_sun_at": self._sun_map_from[:3] @ [0, 0, 0.02, 1],
            "u_open_at": 0.5 - self._background.focus[:2] / (2 * RENDERER_LIMITS.shadowed_within_m),
            "u_open_scale": 0.5 / RENDERER_LIMITS.shadowed_within_m,
            "u_eye_height": float(camera.position[2]),
            "u_texel": 0.04 * 0.5 / RENDERER_LIMITS.shadowed_within_m,
        }
        self._options: tuple[str, ...] = ()
        """Definitions with which the vehicles' programs are compiled for this recording's light."""
        background, middle = self._background, camera.position + self._background.focus
        self._beams = self._reflections = None
        if background.daylight.dark:
            self._options = ("LAMPS", "LINEAR")
            self._beams = Beams(self._device, middle, RENDERER_LIMITS.shadowed_within_m, background.daylight.exposure)
            self._uniforms |= {
                **self._beams.uniforms,
                "u_lamp_vectors_at": 0.5 - background.focus[:2] / (2 * GROUND_LIGHTS.map_radius_m),
                "u_lamp_vectors_scale": 0.5 / GROUND_LIGHTS.map_radius_m,
                "u_plane": background.road.uniform,
                "u_full": 1.0,
                "u_short": (0.0, 1.0),
            }
        if recording.conditions.snow_cover > 0:
            self._options += ("SNOW",)
        if background.mirrored_depth:
            self._reflections = Reflections(
                self._device, camera, background.road, background.mirrored_depth, *self._options
            )
        self._spray = Spray(camera, recording.conditions)
        self._compose_picture([self._image])
        self._night: NightCamera | None = None
        self._glare: Glare | None = None
        if background.daylight.dark:
            light = self._read_light()
            self._night = NightCamera(light[..., :3], background.depth, recording.conditions, background.daylight)
            self._uniforms |= self._night.uniforms
            self._compose_picture([self._image])
            self._plain_light = self._read_light()
            self._plain = self._night.without_glare(self._plain_light)
        else:
            self._glare = Glare(camera, recording.conditions, scenery(recording.town), background.depth)
            self._plain = self._read_display()

    # --------------------------------------------------------------------------------------------------------- frames

    def render(self, frame: int) -> RenderedFrame:
        """Draw a frame."""
        self._device.use()
        camera, moment, empty = self._camera, self._recording.moment(frame), self._background
        shutter_s = self._recording.conditions.shutter_s
        placed = self._placer.place(moment)
        depth, slope, ids = empty.depth.copy(), empty.slope.copy(), empty.ids.copy()
        silhouettes = [Silhouette(0, 0, np.zeros((0, 0), dtype=bool))] * len(moment.vehicles)
        contrast = np.zeros(len(moment.vehicles))
        night, light, rgb = self._night, None, self._plain.copy()
        if night:
            light = self._plain_light.copy()
        if placed:
            before, after = (1.0, 0.0) if night and night.exposure.short_share else (0.5, -0.5)
            blurred = moving(reversed(placed), moment.velocity, shutter_s, camera, before, after)
            drawn = self._draw_frame(placed, blurred, (before, after))
            x0, y0, x1, y1 = drawn.picture.window
            mask = tile_mask(drawn.changed, drawn.picture.window)
            if night and light is not None:
                part = drawn.picture.pixels
                cv2.copyTo(part, mask, light[y0:y1, x0:x1])
                picture = night.without_glare(part)
            else:
                picture = np.asarray(cv2.cvtColor(drawn.picture.pixels, cv2.COLOR_RGBA2RGB), dtype=np.uint8)
            cv2.copyTo(picture, mask, rgb[y0:y1, x0:x1])
            for vehicle, layer in zip(placed, drawn.layers, strict=True):
                visible = _put_vehicle(layer, vehicle.number, depth, slope, ids)
                silhouettes[vehicle.index] = Silhouette(*vehicle.window[:2], drawn.masks[vehicle.index])
                contrast[vehicle.index] = self._contrast(vehicle, visible, rgb, drawn)
        signals = scenery(self._recording.town).signals
        if night and light is not None:
            light_signals_linear(light, depth, camera, moment, signals, RENDERER_LIMITS.signal_light / night.gain)
            rgb = self._spray.drift(night.develop(light), depth, moment, frame)
            return RenderedFrame(rgb, depth, slope, ids, tuple(silhouettes), contrast, night.noise)
        light_signals(rgb, depth, camera, moment, signals)
        rgb = self._spray.drift(rgb, depth, moment, frame)
        if self._glare:
            rgb = self._glare.spread(rgb, depth, ids, moment)
        return RenderedFrame(rgb, depth, slope, ids, tuple(silhouettes), contrast)

    def _draw_frame(
        self, placed: Sequence[PlacedVehicle], blurred: Sequence[Moving], open_during: tuple[float, float]
    ) -> "_Drawn":
        """Draw all of a frame, and wait for it once; `open_during` is the pair `before`, `after` of `moving`."""
        camera, pixels = self._camera, self._pixels
        pixels.forget()
        windows = [inside_image(vehicle.window, camera) for vehicle in placed]
        self._draw_geometry(placed, windows, whole=bool(blurred))
        for window in windows:
            pixels.ask(self._geometry, window, "f4")
        crowd = [vehicle for vehicle in placed if _crosses_another(vehicle, placed)]
        apart = [v for v, window in zip(placed, windows, strict=True) if v.window != window or v in crowd]
        for vehicle in apart:
            self._draw_silhouette(vehicle)
        changed = self._draw_color(placed, blurred, open_during)
        # A window may touch the image although its hull does not.
        shown = union(tile_runs(changed, (camera.width, camera.height)) or [(0, 0, 1, 1)])
        pixels.ask(self._display, shown, self._read_as)
        if crowd:
            self._draw_behind(crowd)
            around = union([inside_image(vehicle.window, camera) for vehicle in crowd])
            pixels.ask(self._behind, around, self._read_as)
        fetched = iter(pixels.fetch())
        layers = [_Layer(window, next(fetched)) for window in windows]
        masks = {vehicle.index: next(fetched)[..., 0] > 0 for vehicle in apart}
        for vehicle, layer in zip(placed, layers, strict=True):
            if vehicle.index not in masks:
                masks[vehicle.index] = layer.pixels[..., 3] == vehicle.number
        picture = _Layer(shown, next(fetched))
        return _Drawn(layers, masks, changed, picture, _Layer(around, next(fetched)) if crowd else None, crowd)

    # ----------------------------------------------------------------------------------- depth, ids and whole vehicles

    def _draw_geometry(self, placed: Sequence[PlacedVehicle], windows: Sequence[Window], *, whole: bool) -> None:
        """Draw depth, slope and number of the nearest vehicle, without occlusion by the scenery.

        With `whole` the rest of the target is cleared.
        """
        program = self._device.program("geometry.vert.glsl", "geometry.frag.glsl", PARTS_DEFINITION)
        if whole:
            self._geometry.clear(0, 0, 0, 0)
        self._device.prepare(self._geometry, windows, self._uniforms)
        self._device.context.enable_only(self._device.gl.DEPTH_TEST | self._device.gl.CULL_FACE)
        put(program, {"u_project": self._project})
        for vehicle in placed:
            put(program, {**vehicle.matrices, "u_id": float(vehicle.number)})
            vehicle.mesh.draw(program)

    def _draw_silhouette(self, placed: PlacedVehicle) -> None:
        """Draw a vehicle without any occlusion in its own window, and request the pixels."""
        device, window = self._device, placed.window
        size = (window[2] - window[0], window[3] - window[1])
        target = _mask_target(device, _rounded_up(size))
        program = device.program("geometry.vert.glsl", "mask.frag.glsl", PARTS_DEFINITION)
        target.viewport = (0, 0, *size)
        target.use()
        target.clear(0, 0, 0, 0, viewport=(0, 0, *size))
        device.context.enable_only(device.gl.CULL_FACE)
        put(program, {**placed.matrices, "u_project": projection(self._camera.K, window)})
        placed.mesh.draw(program)
        self._pixels.ask(target, (0, 0, *size), "f1", components=1)

    # ---------------------------------------------------------------------------------------------------------- colour

    def _draw_color(
        self, placed: Sequence[PlacedVehicle], blurred: Sequence[Moving], open_during: tuple[float, float]
    ) -> NDArray[np.bool_]:
        """Draw the vehicles, their shadows, lamp light and mirror images; return a mask of the changed tiles."""
        camera, sun = self._camera, self._background.daylight.sun_direction
        size = (camera.width, camera.height)
        covered = tiles([vehicle.hull for vehicle in placed], size)
        shaded = tiles([shadow_hull_of(v.vehicle, v.T_world_parts, camera, sun) for v in placed], size)
        self._draw_shadows(placed)
        if self._beams:
            shaded |= tiles(self._beams.draw(placed, camera), size)
        swept = [tiles([vehicle.hull], size) for vehicle in blurred]
        for places in swept:
            covered |= places
        self._draw_vehicles(self._color, placed, tile_runs(covered, size))
        mirrored = np.zeros_like(covered)
        if self._reflections:
            units = self._vehicle_textures()
            uniforms = {**self._background.bind(), **self._uniforms, **self._bind_textures(units)}
            mirrored = self._reflections.draw(placed, uniforms, {**self._background.textures, **units})
        for area, more in ((~mirrored, ()), (mirrored, ("REFLECTIONS",))):
            self._compose_picture(tile_runs((shaded | mirrored) & ~covered & area, size), "SHADOWS", *more)
            self._compose_picture(tile_runs(covered & area, size), "SHADOWS", "VEHICLES", *more)
        more = ("REFLECTIONS",) if self._reflections else ()
        for vehicle, places in zip(blurred, swept, strict=True):
            way = {
                "u_way": vehicle.way,
                "u_open_during": open_during,
                "u_id": float(vehicle.vehicle.number),
                "u_nearest": vehicle.nearest,
                "u_pulses": self._pulses(vehicle.vehicle.look["u_plate"]),
            }
            self._compose_picture(tile_runs(places, size), "SHADOWS", "VEHICLES", "BLUR", *more, uniforms=way)
        return covered | shaded | mirrored

    def _draw_shadows(self, placed: Sequence[PlacedVehicle]) -> None:
        """Draw the vehicles' shadow map, and the map of the sky that they leave visible from the road."""
        device = self._device
        program = device.program("geometry.vert.glsl", "shadow.frag.glsl", PARTS_DEFINITION)
        self._sun_map.use()
        self._sun_map.clear()
        device.context.enable_only(device.gl.DEPTH_TEST)
        put(program, {"u_project": self._sun_clip})
        middle = self._camera.position + self._background.focus
        for vehicle in placed:
            if (
                self._background.daylight.dark
                or np.linalg.norm(vehicle.T_world_chassis[:2, 3] - middle[:2]) > RENDERER_LIMITS.shadowed_within_m + 10
            ):
                continue
            put(program, {"u_model": vehicle.matrices["u_world"], "u_world": vehicle.matrices["u_world"]})
            (vehicle.mesh if vehicle.distance < RENDERER_LIMITS.coarse_from_m else vehicle.coarse).draw(program)
        self._open.use()
        self._open.clear(1, 1, 1, 1)
        device.context.enable_only(device.gl.BLEND)
        device.context.blend_func = device.gl.ZERO, device.gl.SRC_COLOR
        corners = np.concatenate([_footprint(v, middle) for v in placed])
        program = device.program("contact.vert.glsl", "contact.frag.glsl", f"CONTACT {WINDOW_LIMITS.contact_m}")
        device.triangles(program, corners, "2f 2f 3f", "in_at", "in_local", "in_size")

    def _vehicle_textures(self) -> dict[str, Any]:
        """Return the textures that vehicles' programs sample in addition to the background: shadows and lamp light."""
        textures = {"u_vehicle_sun_map": self._sun_map.depth_attachment}
        return textures | ({"u_beams": self._beams.texture} if self._beams else {})

    def _draw_vehicles(
        self, target: Any, placed: Sequence[PlacedVehicle], places: Sequence[Window], *, peel: bool = False
    ) -> None:
        """Draw the vehicles into parts of a target where the scenery does not hide them.

        With `peel`, draw a plain image of the objects behind the visible vehicles.
        """
        device, gl = self._device, self._device.gl
        uniforms = {**self._background.bind(), **self._uniforms}
        device.prepare(
            target,
            places,
            uniforms,
            "SCENERY",
            f"STEP {BACKGROUND_SAMPLING.vehicle_scale * self._camera.width // target.width}",
        )
        device.context.enable_only(gl.DEPTH_TEST | gl.CULL_FACE)
        units = {**self._vehicle_textures(), "u_front": self._geometry.color_attachments[0]}
        uniforms |= {**self._bind_textures(units), "u_project": self._project}

        def draw(option: str, meshes: Iterable[tuple[PlacedVehicle, DeviceMesh | None]]) -> None:
            program = device.program("vehicle.vert.glsl", "vehicle.frag.glsl", PARTS_DEFINITION, option, *self._options)
            put(program, uniforms)
            for vehicle, mesh in meshes:
                if mesh:
                    put(program, {**vehicle.matrices, **vehicle.look, "u_id": float(vehicle.number)})
                    mesh.draw(program)

        if peel:
            draw("PEEL", ((vehicle, vehicle.mesh) for vehicle in placed))
            return
        near = [vehicle for vehicle in placed if vehicle.distance < RENDERER_LIMITS.coarse_from_m]
        draw(
            "SOLID",
            (
                (vehicle, vehicle.solid if vehicle.distance < RENDERER_LIMITS.coarse_from_m else vehicle.coarse)
                for vehicle in placed
            ),
        )
        # Windows show the inner sides of the far walls.
        device.context.cull_face = "front"
        draw("SOLID", ((vehicle, vehicle.coarse) for vehicle in near))
        device.context.cull_face = "back"
        # Panes are drawn last, from far to near, over the objects that are visible through them.
        device.context.enable_only(gl.DEPTH_TEST | gl.CULL_FACE | gl.BLEND)
        device.context.blend_func = gl.ONE, gl.ONE_MINUS_SRC_ALPHA
        draw("PANES", ((vehicle, vehicle.panes) for vehicle in reversed(near)))

    def _compose_picture(
        self, places: Sequence[Window], *options: str, uniforms: Mapping[str, Any] = MappingProxyType({})
    ) -> None:
        """Compose parts of the image."""
        if not places:
            return
        device, wet = self._device, ("WET",) if self._reflections else ()
        air = ("HAZE",) if self._background.daylight.haze_density > RENDERER_LIMITS.haze_extinction else ()
        program = device.program("tiles.vert.glsl", "composite.frag.glsl", *self._options, *wet, *air, *options)
        units = {
            **self._vehicle_textures(),
            **({"u_reflections": self._reflections.texture} if self._reflections else {}),
            "u_vehicles": self._color.color_attachments[0],
            "u_open": self._open.color_attachments[0],
            "u_front": self._geometry.color_attachments[0],
        }
        put(program, {**self._background.bind(), **self._uniforms, **self._bind_textures(units), **uniforms})
        self._display.use()
        device.context.enable_only(device.gl.NOTHING)
        device.tiles(program, places)

    def _bind_textures(self, textures: dict[str, Any]) -> dict[str, int]:
        """Bind textures after those of the background; return the uniforms."""
        first = len(self._background.textures)
        for unit, texture in enumerate(textures.values(), start=first):
            texture.use(unit)
        return {name: unit for unit, name in enumerate(textures, start=first)}

    def _pulses(self, track_id: int) -> float:
        """Return the number of pulses of a vehicle's lamps while the shutter is open; 0 for lamps that are not pulsed.

        LED lamps are dimmed by switching them.
        """
        share = track_id * RENDERER_LIMITS.golden_fraction % 1.0
        return (
            0.0
            if share > RENDERER_LIMITS.pulsing_share
            else self._recording.conditions.shutter_s * RENDERER_LIMITS.pulses_hz * (0.8 + share)
        )

    def _read_light(self) -> NDArray[np.float32]:
        """Return the linear light of the image and the light at which its exposures saturate, (H, W, 4)."""
        self._pixels.ask(self._display, self._image, "f4")
        (picture,) = self._pixels.fetch()
        return np.asarray(picture)

    def _read_display(self) -> NDArray[np.uint8]:
        self._pixels.ask(self._display, self._image, "f1")
        (picture,) = self._pixels.fetch()
        return np.ascontiguousarray(picture[..., :3])

    def _draw_behind(self, crowd: Sequence[PlacedVehicle]) -> None:
        """Draw the image behind vehicles that are in front of other vehicles."""
        size = (self._camera.width, self._camera.height)
        self._draw_vehicles(self._behind, crowd, tile_runs(tiles([v.hull for v in crowd], size), size), peel=True)

    def _contrast(
        self, placed: PlacedVehicle, visible: NDArray[np.bool_], rgb: NDArray[np.uint8], drawn: "_Drawn"
    ) -> float:
        """Return the mean difference over a vehicle's visible pixels to the image without it and its shadow."""
        window = x0, y0, x1, y1 = inside_image(placed.window, self._camera)
        picture: NDArray[Any] = self._plain[y0:y1, x0:x1]
        if drawn.behind and placed in drawn.crowd:
            behind = drawn.behind.crop(window)
            drawn_behind: NDArray[Any] = behind[..., 3]
            if self._night:
                full = np.full_like(drawn_behind, RENDERER_LIMITS.unclipped_light)
                behind = self._night.without_glare(np.dstack([behind[..., :3], full]))
                drawn_behind = (drawn_behind > 0).astype(np.uint8)
            picture = cv2.copyTo(np.ascontiguousarray(behind[..., :3]), drawn_behind, picture.copy())
        shown = rgb[y0:y1, x0:x1]
        if self._night:
            # A body is visible by its own contrast; lamps alone do not count.
            visible = visible & (shown.min(axis=-1) < RENDERER_LIMITS.burnt_out)
        difference = cv2.mean(cv2.absdiff(shown, picture), visible.view(np.uint8))
        return sum(difference) / 3


@dataclass(frozen=True, eq=False)
class _Layer:
    """Pixels of a window of the image."""

    window: Window
    pixels: NDArray[Any]
    """(h, w, C) pixel values."""

    def crop(self, window: Window) -> NDArray[Any]:
        """Return the pixels of a window within the layer."""
        x, y = self.window[:2]
        x0, y0, x1, y1 = window
        return self.pixels[y0 - y : y1 - y, x0 - x : x1 - x]


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Handles of the results that the device has drawn for a frame."""

    layers: list[_Layer]
    """Depth, slope and number in the window of each vehicle."""
    masks: dict[int, NDArray[np.bool_]]
    """Masks of whole vehicles by their index, in their own windows."""
    changed: NDArray[np.bool_]
    """Tiles in which the image differs from that of the empty road."""
    picture: _Layer
    behind: _Layer | None
    """The view behind vehicles that are in front of other vehicles."""
    crowd: list[PlacedVehicle]
    """Vehicles with windows that overlap those of other vehicles."""


def _put_vehicle(
    layer: _Layer, number: int, depth: NDArray[np.float32], slope: NDArray[np.float32], ids: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Put a vehicle into the frame where it is nearer than the scenery.

    Return the mask of these pixels in its window.
    """
    x0, y0, x1, y1 = layer.window
    window = slice(y0, y1), slice(x0, x1)
    # OpenCV splits pixels and copies selected pixels much faster than numpy.
    z, right, down, shown = cv2.split(layer.pixels)
    visible = (shown == number) & (z < depth[window])
    mask = visible.view(np.uint8)
    cv2.copyTo(z, mask, depth[window])
    cv2.copyTo(cv2.merge([right, down]), mask, slope[window])
    cv2.copyTo(np.full(visible.shape, number, dtype=np.int32), mask, ids[window])
    return np.asarray(visible)


def _crosses_another(vehicle: PlacedVehicle, vehicles: Iterable[PlacedVehicle]) -> bool:
    """Return whether a vehicle's window overlaps that of another vehicle."""
    return any(crossing(vehicle.window, neighbour.window) for neighbour in vehicles if neighbour is not vehicle)


def _footprint(placed: PlacedVehicle, middle: Array) -> Array:
    """Return the corners (6, 7) of two triangles around the ground near a vehicle; (12, 7) with a trailer.

    Columns: position in the map around `middle`, position in the part's axes, half its length and width, and its
    height.
    """
    trailer, out = placed.vehicle.trailer, []
    bodies = [(placed.vehicle.size_lwh, 0.0, placed.T_world_chassis)]
    if trailer:
        bodies.append(
            (trailer.size_lwh, float(trailer.corners[:, 0].mean()), placed.T_world_parts[MODEL_PARTS.trailer_part])
        )
    for size_lwh, ahead, T in bodies:
        size = np.array(size_lwh) * [0.5, 0.5, 1.0]
        local = np.array([[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]]) * (size[:2] + WINDOW_LIMITS.contact_m)
        world = (local + [ahead, 0.0]) @ T[:2, :2].T + T[:2, 3]
        out.append(
            np.column_stack([(world - middle[:2]) / RENDERER_LIMITS.shadowed_within_m, local, np.tile(size, (6, 1))])
        )
    return np.concatenate(out)


def device() -> Device:
    """Return this process's OpenGL device, and make it the current one."""
    device = _only_device()
    device.use()
    return device


@cache
def _only_device() -> Device:
    return Device()


@cache
def _mask_target(device: Device, size: tuple[int, int]) -> Any:
    return device.target(size, ["1f1"], depth=False)


def _rounded_up(size: tuple[int, int]) -> tuple[int, int]:
    """Return a rounded-up target size, so that few targets serve all silhouettes."""
    return tuple(1 << max(6, (side - 1).bit_length()) for side in size)  # type: ignore[return-value]
