"""Controllers: readings in, the next set-point out. They touch no device and no clock.

They invert a hysteresis model, open loop and closed loop, for targets and for references that move.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
