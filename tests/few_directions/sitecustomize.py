"""Has a Python that finds this folder in PYTHONPATH light scenery from few directions, and so all that it starts.

Nothing is imported before it is wanted: many programs that tests start draw nothing.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Final

SAMPLES: Final = 4
_LIGHT: Final = "skope.gen.render.gl.light"


class _FewDirections(MetaPathFinder):
    """Changes the module of the scenery's light as soon as it has been executed."""

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        spec = PathFinder.find_spec(name, path, target) if name == _LIGHT else None
        if spec is None or spec.loader is None:
            return None
        execute = spec.loader.exec_module

        def execute_and_change(module: ModuleType) -> None:
            execute(module)
            module.LIGHT_SAMPLING = replace(module.LIGHT_SAMPLING, samples=SAMPLES)  # type: ignore[attr-defined]

        spec.loader.exec_module = execute_and_change  # type: ignore[method-assign]
        return spec


sys.meta_path.insert(0, _FewDirections())
