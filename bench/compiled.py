"""Decorators of compiled loops. Imported with such loops only, because numba is slow to load.

Around each function numba compiles a wrapper for calls from Python and one for calls from C, which may take as long
as the function itself. Nothing here is called from C, and nearly half of the functions by other compiled ones only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba.core.registry import CPUDispatcher

Function = TypeVar("Function", bound=Callable[..., object])


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
    result: Function = compiled
    return result
