"""The foundation of all packages: errors, the clock, units, the registry of parts, and worker processes.

It also has the decorators of compiled kernels, strict readers of JSON and TOML, and the display of long computations.
Nothing here knows a device, a model or a run.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
