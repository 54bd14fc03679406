"""Libraries that can compute the parts of the network instead of torch; each is an optional extra.

All libraries read ONNX. Their results differ from torch's in the last digits of float32; bfloat16 and int8 are less
accurate.
"""

import contextlib
import importlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, Final

import torch

from skope.cpu_count import usable_processors
from skope.detector.device import has_bfloat16
from skope.detector.network_settings import INPUT_NAME
from skope.errors import UserError, first_line
from skope.types import Floats32

if TYPE_CHECKING:
    from skope.detector.backends.network_parts import NetworkPart, RunNetwork

_COMPILED_SIZES: Final = 4
"""Number of image sizes with cached graphs. A graph for 1280x720 takes `road33` 1.5 s and 0.3 GB, `road33-lite` 0.5 s
and 0.1 GB."""


class UnusableError(UserError):
    """Error for a runtime that is missing, too old or broken."""

    def __init__(self, message: str, *, missing: bool) -> None:
        super().__init__(message)
        self.missing = missing


class Runtime(ABC):
    """Library that computes ONNX models on the CPU."""

    backend: ClassVar[str]
    """Name for `--backend` and of the extra that installs it."""
    formats: ClassVar[tuple[str, ...]]
    """Supported number formats, fastest first."""
    module: ClassVar[str]
    oldest: ClassVar[tuple[int, int]]
    """Earliest version that is known to compute the parts correctly."""

    def __init__(self) -> None:
        """Raise UnusableError, with a one-line message, if the library or `onnx` does not work."""
        self._import("onnx")
        self._library = self._import(self.module)
        self.version = str(self._library.__version__).partition("-")[0]
        if tuple(int(part) for part in self.version.split(".")[:2] if part.isdecimal()) < self.oldest:
            least = ".".join(map(str, self.oldest))
            raise self._unusable(f"{self.module} {self.version} is too old, {least} is the oldest that will do")

    def _import(self, module: str) -> ModuleType:
        try:
            return importlib.import_module(module)
        except ModuleNotFoundError as error:
            if error.name == module:
                raise self._unusable(f"{module} is not installed", missing=True) from None
            raise self._unusable(f"{module} is broken ({error})") from None
        except Exception as error:  # a compiled module may raise any exception
            raise self._unusable(f"{module} is broken ({first_line(error)})") from None

    def _unusable(self, why: str, *, missing: bool = False) -> UnusableError:
        line = f"--backend {self.backend}: {why}: pip install 'skope[{self.backend}]'"
        return UnusableError(line, missing=missing)

    def compile(self, part: "NetworkPart", number: str) -> "RunNetwork":
        """Return a function that computes a part with products in a number format, one of `formats`.

        This method and the returned function raise UnusableError, with a one-line message, if the library fails.
        """
        with self._blamed():
            run = self._compiled(part, number)

        def guarded(x: Floats32) -> list[Floats32]:
            with self._blamed():
                return run(x)

        return guarded

    @contextlib.contextmanager
    def _blamed(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # any exception of the library, for an unsupported operation
            why = f"{self.module} {self.version} cannot compute the network ({first_line(error)})"
            raise self._unusable(why) from None

    @abstractmethod
    def _compiled(self, part: "NetworkPart", number: str) -> "RunNetwork": ...


@lru_cache
def _openvino_core(library: ModuleType) -> Any:
    """Return the core of this process, which is kept until the process exits.

    Each core of OpenVINO installs an alternative signal stack and puts the previous one back when it is deleted. Two
    cores that are deleted in a different order leave a stack without memory, and the next signal, Ctrl-C for example,
    crashes the process (seen with 2026.4).
    """
    return library.Core()


class OpenVino(Runtime):
    """OpenVINO; sums of products, and all parts that are not in int8, use bfloat16 if permitted."""

    backend = "openvino"
    formats = ("int8", "bfloat16", "float32")
    module = "openvino"
    oldest = (2025, 0)

    def _compiled(self, part: "NetworkPart", number: str) -> "RunNetwork":
        core = _openvino_core(self._library)
        hints = {
            "INFERENCE_PRECISION_HINT": "bf16" if number != "float32" and has_bfloat16(torch.device("cpu")) else "f32",
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_NUM_THREADS": usable_processors(),
        }
        model = core.read_model(part.to_onnx())

        @lru_cache(maxsize=_COMPILED_SIZES)
        def compiled(shape: tuple[int, ...] | None) -> Any:
            fitting = model.clone()
            if shape:
                fitting.reshape({INPUT_NAME: list(shape)})
            return core.compile_model(fitting, "CPU", hints)

        def run(x: Floats32) -> list[Floats32]:
            # Compiled for a fixed size, the pyramid is a fifth faster than for any size, but rounds differently. If the
            # first size were compiled separately, the detections in an image would depend on earlier images.
            graph = compiled(x.shape if part.steady else None)
            return list(graph(x, share_inputs=True, share_outputs=True).to_tuple())

        return run


class OnnxRuntime(Runtime):
    """ONNX Runtime. Its int8 was slower than float32 (version 1.31), and it has no bfloat16 on CPUs."""

    backend = "onnx"
    formats = ("float32",)
    module = "onnxruntime"
    oldest = (1, 20)

    def _compiled(self, part: "NetworkPart", number: str) -> "RunNetwork":
        options = self._library.SessionOptions()
        options.intra_op_num_threads = usable_processors()
        model = _without_shapes(part.to_onnx())
        session = self._library.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        return lambda x: list(session.run(None, {INPUT_NAME: x}))


def _without_shapes(model: bytes) -> bytes:
    """Return an ONNX model without the exporter's shapes, which are wrong for layers with several input maps."""
    import onnx

    parsed = onnx.load_from_string(model)
    parsed.graph.ClearField("value_info")
    return bytes(parsed.SerializeToString())


RUNTIME_CLASSES: Final[dict[str, type[Runtime]]] = {runtime.backend: runtime for runtime in (OpenVino, OnnxRuntime)}
