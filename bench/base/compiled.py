"""Decorators of compiled loops. Imported with such loops only, because numba is slow to load.

Around each function numba compiles a wrapper for calls from Python and one for calls from C, which may take as long
as the function itself. Nothing here is called from C, and nearly half of the functions by other compiled ones only.

What is compiled is kept on disk. numba compiles a function again if its own file has changed. As what it calls, and
constants, of other files are part of its machine code, a change of these files counts here, too.

The annotations of a kernel are the types that it is compiled for, so that it can be compiled before its first call,
see `kernels_of`. An array is contiguous, has one dimension and can be written; `Annotated` says what is otherwise: a
number of dimensions, `read-only`, or the dtype of a record, before the number of dimensions of an array of records.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numba import typeof
from numba.core.registry import CPUDispatcher
from numpy.typing import NDArray

Function = TypeVar("Function", bound=Callable[..., object])

Table = Annotated[NDArray[np.float64], 2]
Cube = Annotated[NDArray[np.float64], 3]
IntegerTable = Annotated[NDArray[np.int64], 2]
Fixed = Annotated[NDArray[np.float64], "read-only"]

_IMPORT = re.compile(r"^(?:from +([\w.]+) +)?import +(?:\(([^)]*)\)|(.*))", re.MULTILINE)
_FOREIGN = {*sys.stdlib_module_names, "numba", "numpy"}


def kernel(function: Function) -> Function:
    """Compile a function that Python calls."""
    return _compiled(Kernel, function)


def reordered(function: Function) -> Function:
    """Compile a function that Python calls; its sums may be taken in another order, several terms at a time."""
    return _compiled(Kernel, function, fastmath={"reassoc", "contract"})


def inner(function: Function) -> Function:
    """Compile a function that only compiled functions call; called from Python it raises TypeError."""
    return _compiled(_Inner, function, no_cpython_wrapper=True)


def inlined(function: Function) -> Function:
    """Compile a function as `inner` does, as a part of each function that calls it."""
    return _compiled(_Inner, function, no_cpython_wrapper=True, forceinline=True)


class Kernel(CPUDispatcher):
    """A compiled function that Python calls."""

    @cached_property
    def signature(self) -> tuple[Any, ...]:
        """Types of numba that the annotations of its arguments stand for."""
        hints = get_type_hints(self.py_func, include_extras=True)
        hints.pop("return", None)
        return tuple(typeof(_example(hint)) for hint in hints.values())  # type: ignore[no-untyped-call]

    def prepare(self) -> Callable[..., Any]:
        """Compile it for its signature, or load it; return its plain function, without numba's look at arguments."""
        function: Callable[..., Any] = self.compile(self.signature)
        return function


def kernels_of(packages: Iterable[str]) -> list[Kernel]:
    """Import the modules `…_kernels` of packages; return their kernels.

    Parameters
    ----------
    packages : iterable of str
        Names of packages, of which all such modules are meant, and of single modules.
    """
    found = []
    for name in packages:
        package = importlib.import_module(name)
        folders = [Path(folder) for folder in getattr(package, "__path__", ())]
        files = sorted(file.relative_to(folder) for folder in folders for file in folder.rglob("*_kernels.py"))
        names = [".".join((name, *file.with_suffix("").parts)) for file in files]
        modules = [importlib.import_module(each) for each in names] if folders else [package]
        found += [part for module in modules for part in vars(module).values() if isinstance(part, Kernel)]
    return list(dict.fromkeys(found))


def _example(hint: Any) -> Any:  # noqa: ANN401 - any annotation
    """Return a value of the type that an annotation stands for."""
    if get_origin(hint) is Annotated:
        array, detail, *dimensions = get_args(hint)
        if isinstance(detail, np.dtype):
            records = np.zeros(1, detail)
            return records if dimensions else records[0]
        example = np.zeros((1,) * detail if isinstance(detail, int) else 1, _dtype(array))
        example.flags.writeable = detail != "read-only"
        return example
    if get_origin(hint) is tuple:
        return tuple(map(_example, get_args(hint)))
    if get_origin(hint) is np.ndarray:
        return np.zeros(1, _dtype(hint))
    if issubclass(hint, tuple):
        return hint(*map(_example, get_type_hints(hint, include_extras=True).values()))
    return hint()


def _dtype(array: Any) -> Any:  # noqa: ANN401 - NDArray[scalar type]
    return get_args(get_args(array)[1])[0]


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
        # A package hands on what its modules define.
        parts = [getattr(sys.modules.get(source), name, None) for name in names if source]
        yield from (home for part in parts if isinstance(home := getattr(part, "__module__", None), str))


def _file_of(name: str) -> Path | None:
    if name.partition(".")[0] in _FOREIGN:
        return None
    try:
        spec = find_spec(name)
    except ModuleNotFoundError:
        # The attribute of a module, not a module of a package.
        return None
    return None if spec is None or spec.origin is None or not spec.has_location else Path(spec.origin)
