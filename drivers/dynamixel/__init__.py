"""Dynamixel MX-28 on a serial bus: a servo that holds an angle, and a stage that winds a wire on a drum."""

from drivers.dynamixel.drum import DynamixelDrum
from drivers.dynamixel.mx28 import HARDWARE_ERRORS
from drivers.dynamixel.protocol2 import STATUS_ERRORS
from drivers.dynamixel.servo import DynamixelMX28

__all__ = ["HARDWARE_ERRORS", "STATUS_ERRORS", "DynamixelDrum", "DynamixelMX28"]
