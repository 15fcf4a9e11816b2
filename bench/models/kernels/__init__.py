"""Compiled loops of the models. Each module is imported at its first use, because numba is slow to load."""

from lazy_loader import attach

__getattr__, __dir__, __all__ = attach(__name__, submodules=["actuator_kernels", "memory_kernels"])
