"""What nerfstudio and torch import and no fit uses, left out of processes that only fit: nearly half of their start."""

from __future__ import annotations

import gc
import importlib
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import LazyLoader
from types import ModuleType
from typing import Any

UNUSED = frozenset({"torchvision.datasets", "torchvision.models", "torchvision.ops"})
"""torchvision imports all that it has."""
COMPILER = "torch._dynamo"


class _Lazily(LazyLoader):
    """Loads a module when an attribute of it is used. Until then it has no file: `inspect` asks all modules for theirs,
    in the middle of imports that some of them need."""

    def exec_module(self, module: ModuleType) -> None:
        super().exec_module(module)
        unloaded = type(module)

        class Unloaded(unloaded):
            def __getattribute__(self, name: str) -> Any:
                if name == "__file__":
                    raise AttributeError(name)
                return unloaded.__getattribute__(self, name)

        module.__class__ = Unloaded


class _OnFirstUse:
    """Finds the modules of `UNUSED` such that they are loaded when somebody uses them after all."""

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name not in UNUSED:
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = _Lazily(spec.loader)
        return spec


class _Compiler(ModuleType):
    """torch's compiler, loaded when somebody compiles: optimizers merely ask it to leave them alone."""

    def graph_break(self) -> None:
        """Nothing is being compiled."""

    def disable(self, function: Callable, *_: Any, **__: Any) -> Callable:
        """Nothing will be compiled in `function`."""
        return function

    def __getattr__(self, name: str) -> Any:
        if name == "__file__":  # `inspect` asks all modules
            raise AttributeError(name)
        if sys.modules.get(COMPILER) is self:
            del sys.modules[COMPILER]
        return getattr(importlib.import_module(COMPILER), name)


@contextmanager
def few_imports() -> Iterator[None]:
    """A block that imports nerfstudio for the first time in this process; modules that are loaded already stay so."""
    if _OnFirstUse in sys.meta_path:
        yield
        return
    sys.meta_path.insert(0, _OnFirstUse)
    gc.disable()  # what modules are made of stays: looking for garbage among it takes a seventh of the time
    import torch
    from nerfstudio.utils import misc

    if COMPILER not in sys.modules:
        sys.modules[COMPILER] = torch._dynamo = _Compiler(COMPILER)
    # Nerfstudio has this on Windows. It compiles a function that we do not call.
    misc.torch_compile = lambda *_, **__: lambda function: function
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
