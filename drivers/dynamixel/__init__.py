"""Dynamixel MX-28 on a serial bus: a servo that holds an angle, and a stage that winds a wire on a drum."""

from drivers.dynamixel.devices import DynamixelDrum, DynamixelMX28
from drivers.dynamixel.mx28 import HARDWARE_ERRORS
from drivers.dynamixel.protocol2 import STATUS_ERRORS

__all__ = ["HARDWARE_ERRORS", "STATUS_ERRORS", "DynamixelDrum", "DynamixelMX28"]
