"""OpenGL context, programs and meshes on the device. Only this package imports moderngl."""

import atexit
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.errors import UserError
from skope.gen.mesh import Mesh
from skope.gen.render.materials import MATERIAL_COLORS, MATERIAL_ROUGHNESS, Palette
from skope.gen.render.pixel_windows import Window
from skope.gen.scene.recording import LAMP_BITS
from skope.types import Array


@dataclass(frozen=True)
class ContextLimits:
    """Clipping planes and buffers of the OpenGL context."""

    near_m: float = 0.3
    """Distance of the near plane, metres."""
    far_m: float = 1500.0
    """Distance of the far plane, metres."""
    readback_bytes: int = 1 << 24
    """Initial size of the readback buffer for pixels, bytes."""


CONTEXT_LIMITS: Final = ContextLimits()

PAINT_MATERIAL: Final = len(MATERIAL_COLORS)
"""Number of the material that has the vehicle's own colour."""

_MATERIAL_NUMBERS: Final = {**{name: i for i, name in enumerate(MATERIAL_COLORS)}, "paint": PAINT_MATERIAL}


def linear(srgb: Any) -> Array:
    """Convert sRGB in 0..1 to linear light."""
    c = np.asarray(srgb, dtype=np.float64)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def shader_sources() -> str:
    """Return all shaders in one text, for the digest of the inputs of images other than data."""
    files = resources.files("skope.gen.render.gl").joinpath("shaders").iterdir()
    return "".join(file.read_text(encoding="utf-8") for file in sorted(files, key=lambda file: file.name))


def _shader_source(name: str) -> str:
    text = resources.files("skope.gen.render.gl").joinpath(f"shaders/{name}").read_text(encoding="utf-8")
    return re.sub(r'#include "([\w.]+)"', lambda match: _shader_source(match[1]), text)


def _material_number(material: str) -> int:
    """Return a material's number in shaders; colours such as "#a0b4c8" are numbers with four bits per channel."""
    if not material.startswith("#"):
        return _MATERIAL_NUMBERS[material]
    red, green, blue = (int(material[i : i + 2], 16) // 17 for i in (1, 3, 5))
    return len(_MATERIAL_NUMBERS) + (red << 8 | green << 4 | blue)


def _shader_defines() -> str:
    lines = [f"#define M_{name.upper()} {number}" for name, number in _MATERIAL_NUMBERS.items()]
    lines += [f"#define LAMP_{name.upper()} {bit}" for name, bit in LAMP_BITS.items()]
    return "\n".join([*lines, f"#define MATERIAL_COUNT {len(_MATERIAL_NUMBERS)}"])


WORKER_VARIABLE: Final = "SKOPE_WORKER"
"""Environment variable with the number of a worker process."""
VERTEX_INPUTS: Final = {"in_position": "3f", "in_normal": "3f", "in_material": "1f", "in_part": "1f"}


class DeviceMesh:
    """Vertices of a mesh's parts on the device; any program can draw them with the inputs that it needs."""

    def __init__(self, context: Any, rows: NDArray[np.float32], triangles: NDArray[np.int32]) -> None:
        """Upload a mesh.

        Args:
            context: OpenGL context.
            rows: (V, 8) position, normal, number of the material and of the part.
            triangles: (T, 3) indices into `rows`.
        """
        self._context, self._vertices = context, context.buffer(rows.tobytes())
        self._triangles = context.buffer(triangles.tobytes())
        self._arrays: dict[int, Any] = {}

    def draw(self, program: Any) -> None:
        if program.glo not in self._arrays:
            used = [name for name in VERTEX_INPUTS if name in program]
            # Inputs that a program does not use are skipped, in bytes.
            layout = " ".join(kind if name in used else f"{4 * int(kind[0])}x" for name, kind in VERTEX_INPUTS.items())
            content = [(self._vertices, layout, *used)]
            self._arrays[program.glo] = self._context.vertex_array(program, content, self._triangles)
        self._arrays[program.glo].render()


def _gpu_number(worker: str | None) -> int:
    """Return the number of the GPU that a worker draws on. Workers take the GPUs of a machine in turn."""
    gpus = len(list(Path("/dev").glob("nvidia[0-9]*")))
    return int(worker or 0) % gpus if gpus else 0


def _create_context(gl: Any, number: int) -> Any:
    """Create an OpenGL context on GPU `number`, or on the first device if EGL has fewer devices than there are GPUs.

    Containers with CUDA but without NVIDIA's graphics libraries have only Mesa's device.
    """
    settings = {"standalone": True, "backend": "egl", "require": 430}
    try:
        return gl.create_context(**settings, device_index=number)
    except Exception:  # EGL loaders raise various exceptions
        if number == 0:
            raise
        return gl.create_context(**settings, device_index=0)


class Device:
    """One OpenGL context with its programs."""

    def __init__(self) -> None:
        import moderngl

        # Mesa's llvmpipe (here 22.3) may free the fence of its own threads while they still unlock it, which damages
        # the heap. Workers share the cores anyway.
        os.environ["LP_NUM_THREADS"] = "0"
        self.gl: Any = moderngl
        try:
            self.context: Any = _create_context(self.gl, _gpu_number(os.environ.get(WORKER_VARIABLE)))
        except Exception as error:  # EGL loaders raise various exceptions
            raise UserError(
                f"--renderer gl: no OpenGL context through EGL ({error}); install libegl1 and libgl1-mesa-dri "
                "(Debian's names), or use --renderer pybullet"
            ) from None
        self.software = "llvmpipe" in self.context.info["GL_RENDERER"]
        """Whether the processor renders (no GPU)."""
        self.name = " ".join(str(self.context.info[key]) for key in ("GL_RENDERER", "GL_VERSION"))
        self.context.front_face = "cw"  # image rows run down
        self.context.depth_func = "<"
        # `use` frees unreferenced objects: Python may collect them while another context is current, and in any
        # thread. Nothing is freed while Python exits and is partly torn down.
        self.context.gc_mode = "context_gc"
        atexit.register(setattr, self.context, "gc_mode", None)
        self._empty: dict[int, Any] = {}
        self._programs: dict[tuple[str, ...], Any] = {}

    def use(self) -> None:
        """Make this context the thread's current one, and free its unreferenced objects.

        Other code of the process may have made a context of its own current since the last frame. OpenGL commands go to
        the current context, and crash if their objects belong to a different context.
        """
        self.context.__enter__()
        self.context.gc()

    def program(self, vertex: str, fragment: str, *options: str) -> Any:
        """Return the program of two shader files, compiled once per set of options (llvmpipe skips no branches)."""
        key = vertex, fragment, *options
        if key not in self._programs:
            head = "\n".join([_shader_defines(), *(f"#define {option}" for option in options)])
            sources = [
                _shader_source(name).replace("#version 430", f"#version 430\n{head}\n", 1)
                for name in (vertex, fragment)
            ]
            self._programs[key] = self.context.program(vertex_shader=sources[0], fragment_shader=sources[1])
        return self._programs[key]

    def screen(self, program: Any) -> None:
        """Run a program for every pixel of the target."""
        if program.glo not in self._empty:
            self._empty[program.glo] = self.context.vertex_array(program, [])
        self._empty[program.glo].render(mode=self.gl.TRIANGLES, vertices=3)

    def tiles(self, program: Any, places: Sequence[Window]) -> None:
        """Run a program for every pixel of parts of the target's image."""
        windows = np.array(places, dtype="f4").reshape(-1, 4)
        self.triangles(program, windows[:, [0, 1, 2, 1, 2, 3, 0, 1, 2, 3, 0, 3]], "2f", "in_corner")

    def prepare(self, target: Any, places: Sequence[Window], uniforms: Mapping[str, Any], *options: str) -> None:
        """Prepare parts of a target for drawing (see prepare.frag.glsl)."""
        program = self.program("tiles.vert.glsl", "prepare.frag.glsl", *options)
        put(program, uniforms)
        target.use()
        self.context.enable_only(self.gl.DEPTH_TEST)
        self.context.depth_func = "1"
        self.tiles(program, places)
        self.context.depth_func = "<"

    def triangles(self, program: Any, rows: NDArray[np.float32], layout: str, *names: str) -> None:
        """Draw triangles from the values of their corners, which are uploaded for this draw only."""
        if not rows.size:
            return
        buffer = self.context.buffer(np.ascontiguousarray(rows, dtype="f4").tobytes())
        self.context.vertex_array(program, [(buffer, layout, *names)]).render()

    def upload(self, *parts: Mesh, origin: Array | None = None) -> DeviceMesh:
        """Upload meshes that are drawn together, each with its own matrices.

        Their positions are relative to `origin`, so that float32 keeps tenths of millimetres.
        """
        rows, triangles, count = [], [], 0
        for part, mesh in enumerate(parts):
            # A vertex is stored once per material around it.
            kinds = len(mesh.materials)
            keys, index = np.unique(mesh.triangles * kinds + mesh.material[:, None], return_inverse=True)
            vertex, material = np.divmod(keys, kinds)
            positions = mesh.vertices[vertex] - (np.zeros(3) if origin is None else origin)
            numbers = np.array([_material_number(name) for name in mesh.materials])[material]
            rows.append(np.column_stack([positions, mesh.normals[vertex], numbers, np.full(len(keys), part)]))
            triangles.append(index.reshape(-1, 3) + count)
            count += len(keys)
        return DeviceMesh(self.context, np.concatenate(rows).astype("f4"), np.concatenate(triangles).astype("i4"))

    def texture(self, values: NDArray[Any], kind: str) -> Any:
        """Return a texture of values (H, W, C), sampled without interpolation; `kind` is "f1", "f2" or "f4"."""
        height, width, components = values.shape
        texture = self.context.texture(
            (width, height), components, values.astype({"f1": "u1"}.get(kind, kind)).tobytes(), alignment=1, dtype=kind
        )
        texture.filter = (self.gl.NEAREST, self.gl.NEAREST)
        return texture

    def target(self, size: tuple[int, int], kinds: Sequence[str], *, depth: bool = True) -> Any:
        """Return a framebuffer with colour attachments such as "4f4" (components, type) and a depth buffer."""
        textures = [self.context.texture(size, int(kind[0]), dtype=kind[1:]) for kind in kinds]
        for texture in textures:
            texture.filter = (self.gl.NEAREST, self.gl.NEAREST)
        buffer = self.context.depth_renderbuffer(size) if depth else None
        return self.context.framebuffer(textures, buffer)

    def depth_target(self, size: tuple[int, int]) -> Any:
        """Return a framebuffer that is a depth texture."""
        texture = self.context.depth_texture(size)
        texture.compare_func = ""
        texture.filter = (self.gl.NEAREST, self.gl.NEAREST)
        return self.context.framebuffer(depth_attachment=texture)

    def shadow_map(self, size: int) -> Any:
        """Return a framebuffer that is a depth texture, compared when sampled; everything outside it counts as lit."""
        target = self.depth_target((size, size))
        texture = target.depth_attachment
        texture.compare_func = "<="
        texture.filter = (self.gl.LINEAR, self.gl.LINEAR)
        texture.repeat_x = texture.repeat_y = False
        return target


class Readback:
    """Queue of pixel windows that are requested one by one and fetched together.

    Waiting for the device is the main cost. If many processes share a GPU, each wait is as long as the others' work.
    """

    def __init__(self, context: Any) -> None:
        self._context, self._buffer = context, context.buffer(reserve=CONTEXT_LIMITS.readback_bytes)
        self._asked: list[tuple[int, tuple[int, int, int], np.dtype[Any]]] = []
        self._end = 0

    def ask(self, target: Any, window: Window, kind: str, components: int = 4) -> None:
        """Request a window of a target as "f1" (bytes) or "f4"."""
        x0, y0, x1, y1 = window
        shape, dtype = (y1 - y0, x1 - x0, components), np.dtype({"f1": "u1"}.get(kind, kind))
        begin, self._end = self._end, self._end + -(-math.prod(shape) * dtype.itemsize // 16) * 16
        if self._end > self._buffer.size:
            larger = self._context.buffer(reserve=2 * self._end)
            self._context.copy_buffer(larger, self._buffer, begin)
            self._buffer = larger
        viewport = (x0, y0, x1 - x0, y1 - y0)
        target.read_into(
            self._buffer, viewport=viewport, components=components, dtype=kind, alignment=1, write_offset=begin
        )
        self._asked.append((begin, shape, dtype))

    def forget(self) -> None:
        """Drop requests that an interrupted frame has left."""
        self._asked, self._end = [], 0

    def fetch(self) -> list[NDArray[Any]]:
        """Return the pixels (h, w, components) of all requests since the last fetch, in their order."""
        data = self._buffer.read(self._end) if self._end else b""
        out = [
            np.frombuffer(data, dtype, math.prod(shape), begin).reshape(shape) for begin, shape, dtype in self._asked
        ]
        self.forget()
        return out


def put(program: Any, values: Mapping[str, Any]) -> None:
    """Set the uniforms that a program has: numbers, vectors, row-major matrices, lists of matrices, bytes."""
    for name, value in values.items():
        uniform = program.get(name, None)
        if uniform is None:
            continue
        if isinstance(value, int | float):
            uniform.value = value
        elif isinstance(value, bytes):
            uniform.write(value)
        else:
            array = np.asarray(value, dtype=np.float32)
            square = array.ndim >= 2 and array.shape[-1] == array.shape[-2]
            uniform.write(np.ascontiguousarray(array.swapaxes(-1, -2) if square else array).tobytes())


@cache
def albedo_table(palette: Palette) -> NDArray[np.float32]:
    """Return linear colour and roughness (M, 4) of every material, in the order of their numbers."""
    rows = [[*linear(palette.colors[name]), MATERIAL_ROUGHNESS.get(name, 0.85)] for name in MATERIAL_COLORS]
    return np.array([*rows, [0.5, 0.5, 0.5, MATERIAL_ROUGHNESS["paint"]]], dtype=np.float32)


def pattern_tables(palette: Palette) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return two tables (M, 4) with the linear colours of the patterns, in the order of the materials' numbers.

    The fourth value of the first table is the size, metres. That of the second table combines motif and turn; 0 means
    no pattern.
    """
    first, second = np.zeros((2, len(_MATERIAL_NUMBERS), 4), dtype=np.float32)
    for name, pattern in palette.patterns.items():
        first[_MATERIAL_NUMBERS[name]] = [*linear(pattern.first), pattern.size_m]
        second[_MATERIAL_NUMBERS[name]] = [*linear(pattern.second), pattern.motif + pattern.turn]
    return first, second


def noise_tile(size: int = 256) -> bytes:
    """Return (size, size, 4) bytes of four tileable noises, each a sum of octaves stretched to the whole range."""
    rng = np.random.default_rng(11)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    layers = []
    for power in (1.3, 1.0, 1.1, 1.6):
        weight = np.where(frequency > 0, 1 / np.maximum(frequency, 1e-9) ** power, 0)
        field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((size, size))) * weight).real
        ranks = field.ravel().argsort().argsort() / (size * size - 1)
        # Halfway between a uniform distribution and the bell shape of a sum of octaves.
        layers.append(0.5 * ranks.reshape(field.shape) + 0.5 * np.clip(0.5 + 0.18 * field / field.std(), 0, 1))
    return (np.stack(layers, -1) * 255).astype(np.uint8).tobytes()


def projection(K: Array, window: Window, jitter: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Return the matrix (4, 4) from the camera frame to clip space for a window of the image.

    Image rows count upwards in clip space, so that the target's first row is the image's.

    Args:
        K: (3, 3) camera matrix.
        window: x0, y0, x1, y1 in image pixels.
        jitter: Shift as a share of a pixel.
    """
    x0, y0, x1, y1 = window
    width, height = x1 - x0, y1 - y0
    out = np.zeros((4, 4))
    out[0, 0], out[0, 1], out[0, 2] = (
        2 * K[0, 0] / width,
        2 * K[0, 1] / width,
        2 * (K[0, 2] - x0 + jitter[0]) / width - 1,
    )
    out[1, 1], out[1, 2] = 2 * K[1, 1] / height, 2 * (K[1, 2] - y0 + jitter[1]) / height - 1
    out[2, 2], out[2, 3] = (
        (CONTEXT_LIMITS.far_m + CONTEXT_LIMITS.near_m) / (CONTEXT_LIMITS.far_m - CONTEXT_LIMITS.near_m),
        -2 * CONTEXT_LIMITS.far_m * CONTEXT_LIMITS.near_m / (CONTEXT_LIMITS.far_m - CONTEXT_LIMITS.near_m),
    )
    out[3, 2] = 1
    return out


def light_projection(direction: Array, center: Array, radius: float) -> tuple[Array, Array]:
    """Return two matrices of a light from `direction` around `center`.

    The first goes from world axes to clip space, the second to texture coordinates and depth.
    """
    d = direction / np.linalg.norm(direction)
    side = np.cross(d, [0.0, 1.0, 0.0] if abs(d[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    R = np.stack([side, np.cross(d, side), -d])
    reach = 2 * radius + 60
    clip = np.eye(4)
    clip[:2, :3], clip[2, :3] = R[:2] / radius, R[2] / reach
    clip[:3, 3] = -clip[:3, :3] @ center
    texture = np.eye(4)
    texture[[0, 1, 2], [0, 1, 2]], texture[:3, 3] = 0.5, 0.5
    return clip, texture @ clip
