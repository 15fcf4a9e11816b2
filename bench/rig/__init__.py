"""A rig: a TOML file becomes connected devices with signals, slots, limits and interlocks.

`load_rig` reads and checks a rig file, `Rig` connects it. `bench.rig.maintenance` has the locks, the safe state and
the check-up of a rig outside of runs.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
