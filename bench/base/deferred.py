"""Modules that are imported at their first use, because they are slow to load."""

from __future__ import annotations

import importlib
from typing import Any


class DeferredModule:
    """A module that is imported when one of its names is first looked up.

    numba takes a quarter of a second to load, python-can and pymodbus 30 ms each: a command that only reads rig files
    shall not wait for them. For the type checker the module is imported in the usual way::

        if TYPE_CHECKING:
            from package import _kernels as kernels
        else:
            kernels = DeferredModule("package._kernels")

    Parameters
    ----------
    name : str
        Full name of the module.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:  # noqa: ANN401 - anything that a module holds
        value = getattr(importlib.import_module(self._name), attribute)
        # The next lookup finds it here, as fast as in the module.
        setattr(self, attribute, value)
        return value
