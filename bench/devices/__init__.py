"""Devices and the roles that they play.

`Device`, `Sensor` and `Actuator` say what every instrument promises. The roles, such as `TECAmplifier` or `LoadCell`,
add what one kind of instrument promises beyond that. Settling rules and text instruments are here as well.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
