"""Decorators of compiled loops. Imported with such loops only, because numba is slow to load.

Around each function numba compiles a wrapper for calls from Python and one for calls from C, which may take as long
as the function itself. Nothing here is called from C, and nearly half of the functions by other compiled ones only.

What is compiled is kept on disk. numba compiles a function again if its own file has changed. As what it calls, and
constants, of other files are part of its machine code, a change of these files counts here, too.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from numba.core.registry import CPUDispatcher

Function = TypeVar("Function", bound=Callable[..., object])

_IMPORT = re.compile(r"^(?:from +([\w.]+) +)?import +(?:\(([^)]*)\)|(.*))", re.MULTILINE)
_FOREIGN = {*sys.stdlib_module_names, "numba", "numpy"}


def kernel(function: Function) -> Function:
    """Compile a function that Python calls."""
    return _compiled(CPUDispatcher, function)


def reordered(function: Function) -> Function:
    """Compile a function that Python calls; its sums may be taken in another order, several terms at a time."""
    return _compiled(CPUDispatcher, function, fastmath={"reassoc", "contract"})


def inner(function: Function) -> Function:
    """Compile a function that only compiled functions call; called from Python it raises TypeError."""
    return _compiled(_Inner, function, no_cpython_wrapper=True)


def inlined(function: Function) -> Function:
    """Compile a function as `inner` does, as a part of each function that calls it."""
    return _compiled(_Inner, function, no_cpython_wrapper=True, forceinline=True)


class _Inner(CPUDispatcher):
    """Stands for a function without the wrapper that a call from Python would jump to."""

    def __call__(self, *_: object, **__: object) -> object:
        raise TypeError(f"{self.py_func.__qualname__} is called by compiled functions only")


def _compiled(dispatcher: Any, function: Function, **options: object) -> Function:  # noqa: ANN401 - either class
    compiled = dispatcher(function, targetoptions={"nopython": True, "no_cfunc_wrapper": True, **options})
    compiled.enable_caching()
    kept = compiled._cache._cache_file
    kept._source_stamp = (kept._source_stamp, _stamps(function.__module__))
    result: Function = compiled
    return result


@lru_cache
def _stamps(module: str) -> tuple[tuple[str, int, int], ...]:
    """Return name, time (ns) and size of the files that a module of compiled functions takes something from."""
    found: dict[str, tuple[str, int, int]] = {}
    left = [module]
    while left:
        name = left.pop()
        if name in found or (file := _file_of(name)) is None:
            continue
        stat = file.stat()
        found[name] = (name, stat.st_mtime_ns, stat.st_size)
        # What other files import is compiled in as values only.
        if name == module or name.endswith("_kernels"):
            left += _imported(file.read_text(encoding="utf-8"))
    return tuple(sorted(found.values()))


def _imported(text: str) -> Iterator[str]:
    """Yield the names of modules that a text may import at its top; some are none."""
    for source, inside, rest in _IMPORT.findall(text):
        names = [each.split()[0] for each in (inside or rest).split(",") if each.split()]
        yield from [source, *(f"{source}.{name}" for name in names)] if source else names


def _file_of(name: str) -> Path | None:
    if name.partition(".")[0] in _FOREIGN:
        return None
    try:
        spec = find_spec(name)
    except ModuleNotFoundError:
        # The attribute of a module, not a module of a package.
        return None
    return None if spec is None or spec.origin is None or not spec.has_location else Path(spec.origin)
