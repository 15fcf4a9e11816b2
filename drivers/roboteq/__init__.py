"""Roboteq brushed motor controllers on a CAN bus, as PWM voltage supplies."""

from drivers.roboteq.canopen import ABORT_CODES
from drivers.roboteq.supply import CHANNEL_FLAGS, FAULT_FLAGS, RoboteqSupply

__all__ = ["ABORT_CODES", "CHANNEL_FLAGS", "FAULT_FLAGS", "RoboteqSupply"]
