"""Renders a recording's frames with OpenGL.

The scenery's light comes from `background`, worked out once. Per frame only the vehicles are drawn, in the rectangle
that they and their shadows may touch: once for depth, slope and ids at pixel centres, once per vehicle for its whole
silhouette, and in colour over the scenery.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.errors import UserError
from skope.gen.recording import Moment, RecordedVehicle, Recording
from skope.gen.render import Silhouette, View
from skope.gen.render.gl.background import light_the_scenery
from skope.gen.render.gl.context import Device, DeviceMesh, light_projection, linear, projection, put
from skope.gen.render.sensor import NOISE_SIGMA, with_noise
from skope.gen.render.signals import light_signals
from skope.gen.render.windows import Window, runs, window_of, window_with_shadow
from skope.gen.towns.scenery import scenery
from skope.gen.vehicles import PAINTS, build

Array = NDArray[np.float64]

SCALE: Final = 2
"""Colour samples per pixel and axis on vehicles."""
SHADOW_MAP: Final = 2048
SHADOW_RADIUS: Final = 60.0
"""Vehicles nearer to the middle of the view than this throw shadows, metres."""


@dataclass(frozen=True, eq=False)
class _Part:
    """A vehicle's body or wheel in a frame, ready to draw."""

    mesh: DeviceMesh
    T_camera: Array
    T_axes: Array
    """Mesh -> world axes, relative to the camera."""
    wheel: bool


class GLRenderer:
    """Draws the frames of one recording."""

    def __init__(self, recording: Recording) -> None:
        camera = recording.camera
        if camera.distortion.model != "none":
            raise UserError(f"{recording.site}: --renderer gl draws cameras without distortion only")
        self._recording, self._camera = recording, camera
        self._device = device()
        self._background = light_the_scenery(self._device, recording)
        size = (camera.width, camera.height)
        self._geometry = self._device.target(size, ["4f4"])
        self._color = self._device.target((SCALE * size[0], SCALE * size[1]), ["4f2"])
        self._behind = self._device.target(size, ["4f2"])
        self._display = self._device.target(size, ["4f1"], depth=False)
        self._sun_map, self._top_map = self._device.shadow_map(SHADOW_MAP), self._device.shadow_map(SHADOW_MAP)
        self._meshes: dict[tuple[Any, ...], tuple[DeviceMesh, DeviceMesh, DeviceMesh]] = {}
        self._color.use()
        self._color.clear(0, 0, 0, 0)
        ((_, plain),) = self._compose([(0, 0, *size)], self._color.color_attachments[0], SCALE, None)
        self._plain = plain

    # ------------------------------------------------------------------------------------------------------- vehicles

    def _mesh(self, recorded: RecordedVehicle) -> tuple[DeviceMesh, DeviceMesh, DeviceMesh]:
        key = (recorded.model, *sorted(recorded.shape.items()))
        if key not in self._meshes:
            vehicle = build(recorded.model, recorded.shape)
            meshes = (vehicle.mesh, vehicle.wheel.mirrored(), vehicle.wheel)
            self._meshes[key] = tuple(self._device.upload(mesh) for mesh in meshes)  # type: ignore[assignment]
        return self._meshes[key]

    def _parts(self, moment: Moment, i: int) -> list[_Part]:
        body, right, left = self._mesh(moment.vehicles[i])
        eye = np.eye(4)
        eye[:3, 3] = -self._camera.position
        poses = [moment.T_world_chassis[i], *moment.T_world_wheels[i]]
        meshes = (body, right, left, right, left)
        return [
            _Part(mesh, self._camera.T_camera_world @ T, eye @ T, wheel=k > 0)
            for k, (mesh, T) in enumerate(zip(meshes, poses, strict=True))
        ]

    # --------------------------------------------------------------------------------------------------------- frames

    def render(self, frame: int) -> View:
        """Draw a frame."""
        camera, moment = self._camera, self._recording.moment(frame)
        models = [build(vehicle.model, vehicle.shape) for vehicle in moment.vehicles]
        places = list(zip(models, moment.T_world_chassis, strict=True))
        windows = [window_of(model, T, camera) for model, T in places]
        # From near to far: what a nearer vehicle hides is then not shaded.
        away = np.linalg.norm(moment.T_world_chassis[:, :3, 3] - camera.position, axis=1)
        parts = {int(i): self._parts(moment, int(i)) for i in away.argsort(kind="stable") if windows[i] is not None}
        empty = self._background
        view = _Buffers(empty.depth.copy(), empty.slope.copy(), empty.ids.copy(), self._plain.copy())
        contrast = np.zeros(len(windows))
        if parts:
            shades = [window_with_shadow(model, T, camera, self._background.sun_direction) for model, T in places]
            size = (camera.width, camera.height)
            vehicle_runs = runs([window for window in windows if window], size)
            self._draw_geometry(parts, view, vehicle_runs)
            contrast = self._draw_color(
                moment, parts, view, vehicle_runs, runs([w for w in (*shades, *windows) if w], size)
            )
        light_signals(view.rgb, view.depth, camera, moment, scenery(self._recording.town).signals)
        silhouettes = tuple(self._silhouette(parts.get(i), window) for i, window in enumerate(windows))
        rgb = with_noise(view.rgb, self._recording, frame)
        return View(rgb, view.depth, view.slope, view.ids, silhouettes, contrast)

    def _draw_parts(self, program: Any, parts: list[_Part], P: Array) -> None:
        for part in parts:
            put(
                program,
                {"u_model": part.T_camera, "u_world": part.T_axes, "u_project": P, "u_wheel": float(part.wheel)},
            )
            part.mesh.draw(program)

    def _draw_geometry(self, parts: dict[int, list[_Part]], view: "_Buffers", places: list[Window]) -> None:
        """Draw depth, slope and ids, and put them into the view where a vehicle is nearer than the scenery."""
        device, camera = self._device, self._camera
        program = device.program("geometry.vert.glsl", "geometry.frag.glsl")
        self._geometry.use()
        self._geometry.clear(0, 0, 0, 0)
        device.context.enable_only(device.gl.DEPTH_TEST)
        P = projection(camera.K, (0, 0, camera.width, camera.height))
        for i, vehicle in parts.items():
            program["u_id"] = float(i + 1)
            self._draw_parts(program, vehicle, P)
        for there, layer in _read(self._geometry, places, 4, np.float32):
            nearer = (layer[..., 3] > 0) & (layer[..., 0] < view.depth[there])
            view.depth[there][nearer] = layer[..., 0][nearer]
            view.slope[there][nearer] = layer[..., 1:3][nearer]
            view.ids[there][nearer] = layer[..., 3][nearer].astype(np.int32)

    def _silhouette(self, parts: list[_Part] | None, window: Window | None) -> Silhouette:
        if parts is None or window is None:
            return Silhouette(0, 0, np.zeros((0, 0), dtype=bool))
        device = self._device
        x0, y0, x1, y1 = window
        size = (x1 - x0, y1 - y0)
        target = _mask_target(device, _rounded(size))
        program = device.program("geometry.vert.glsl", "geometry.frag.glsl")
        target.viewport = (0, 0, *size)
        target.use()
        target.clear(0, 0, 0, 0, viewport=(0, 0, *size))
        device.context.enable_only(device.gl.NOTHING)
        program["u_id"] = 1.0
        self._draw_parts(program, parts, projection(self._camera.K, window))
        data = target.read(viewport=(0, 0, *size), components=1, dtype="f1", alignment=1)
        return Silhouette(x0, y0, np.frombuffer(data, dtype=np.uint8).reshape(size[1], size[0]) > 0)

    # --------------------------------------------------------------------------------------------------------- colour

    def _draw_shadows(self, parts: dict[int, list[_Part]]) -> dict[str, Any]:
        """Shadow maps of the vehicles from the sun and from straight above; returns their uniforms."""
        device = self._device
        program = device.program("geometry.vert.glsl", "shadow.frag.glsl")
        device.context.enable_only(device.gl.DEPTH_TEST)
        uniforms: dict[str, Any] = {"u_texel": 0.5 / SHADOW_RADIUS}
        maps = (("sun", self._sun_map, self._background.sun_direction), ("top", self._top_map, np.array([0, 0, 1.0])))
        for unit, (name, target, direction) in enumerate(maps, start=4):
            clip, texture = light_projection(direction, self._background.focus, SHADOW_RADIUS)
            target.use()
            target.clear()
            for vehicle in parts.values():
                for part in vehicle:
                    put(program, {"u_model": part.T_axes, "u_world": part.T_axes, "u_project": clip})
                    part.mesh.draw(program)
            target.depth_attachment.use(unit)
            uniforms |= {f"u_vehicle_{name}_map": unit, f"u_vehicle_{name}_map_from": texture}
        return uniforms

    def _draw_color(
        self,
        moment: Moment,
        parts: dict[int, list[_Part]],
        view: "_Buffers",
        vehicle_runs: list[Window],
        shaded_runs: list[Window],
    ) -> Array:
        """Draw vehicles and shadows into the view's picture; returns the vehicles' contrast.

        For that the vehicle shown in front is left out, pixel by pixel, in a second picture.
        """
        device, camera = self._device, self._camera
        uniforms = self._draw_shadows(parts) | self._background.bind()
        self._geometry.color_attachments[0].use(6)
        P = projection(camera.K, (0, 0, camera.width, camera.height))
        total, count = np.zeros(len(moment.vehicles) + 1), np.zeros(len(moment.vehicles) + 1)
        for target, scale, places, peel in (
            (self._color, SCALE, shaded_runs, False),
            (self._behind, 1, vehicle_runs, True),
        ):
            target.use()
            target.clear(0, 0, 0, 0)
            device.context.enable_only(device.gl.DEPTH_TEST)
            options = [f"SCALE {scale}", *(["PEEL"] if peel else [])]
            program = device.program("geometry.vert.glsl", "vehicle.frag.glsl", *options)
            put(program, {**uniforms, "u_front": 6})
            for i, vehicle in parts.items():
                paint = linear(np.array(PAINTS[moment.vehicles[i].color][1]) / 255)
                put(program, {"u_paint": paint, "u_lamps": int(moment.lamps[i]), "u_id": float(i + 1)})
                self._draw_parts(program, vehicle, P)
            # Without the vehicle its shadow is gone too.
            shadows = None if peel else uniforms
            for there, rgb in self._compose(places, target.color_attachments[0], scale, shadows):
                if not peel:
                    view.rgb[there] = rgb
                    continue
                ids = view.ids[there]
                shown = ids > 0
                difference = np.abs(view.rgb[there][shown].astype(np.int16) - rgb[shown]).mean(axis=-1)
                total += np.bincount(ids[shown], weights=difference, minlength=len(total))
                count += np.bincount(ids[shown], minlength=len(count))
        return np.asarray(total[1:] / np.maximum(count[1:], 1) / NOISE_SIGMA)

    def _compose(
        self, places: list[Window], vehicles: Any, scale: int, shadows: dict[str, Any] | None
    ) -> Iterator[tuple[tuple[slice, slice], NDArray[Any]]]:
        """The picture of parts of the image, with `vehicles` over the scenery in their `shadows`, if any."""
        device, camera = self._device, self._camera
        options = [f"SCALE {scale}", *(["SHADOWS"] if shadows else [])]
        program = device.program("tiles.vert.glsl", "composite.frag.glsl", *options)
        vehicles.use(7)
        put(
            program,
            {
                **self._background.bind(),
                **self._background.display_uniforms(),
                **(shadows or {}),
                "u_vehicles": 7,
                "u_size": [camera.width, camera.height],
            },
        )
        self._display.use()
        device.context.enable_only(device.gl.NOTHING)
        device.tiles(program, places)
        return _read(self._display, places, 3, np.uint8)


@dataclass(frozen=True, eq=False)
class _Buffers:
    """A frame in the making."""

    depth: NDArray[np.float32]
    slope: NDArray[np.float32]
    ids: NDArray[np.int32]
    rgb: NDArray[np.uint8]


def _read(
    target: Any, places: list[Window], components: int, kind: type[np.generic]
) -> Iterator[tuple[tuple[slice, slice], NDArray[Any]]]:
    """Pixels of parts of a target, with where they are."""
    if not places:
        return
    x0, y0, x1, y1 = (f(place[k] for place in places) for k, f in enumerate((min, min, max, max)))
    name = {np.float32: "f4", np.uint8: "f1"}[kind]  # type: ignore[index]
    data = target.read(viewport=(x0, y0, x1 - x0, y1 - y0), components=components, dtype=name, alignment=1)
    pixels = np.frombuffer(data, dtype=kind).reshape(y1 - y0, x1 - x0, components)
    for a, b, c, d in places:
        yield (slice(b, d), slice(a, c)), pixels[b - y0 : d - y0, a - x0 : c - x0]


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
