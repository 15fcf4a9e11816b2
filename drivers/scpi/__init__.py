"""Supplies, meters and other text instruments that a rig file describes (`bench.devices.CommandTable`)."""

from drivers.scpi.devices import SCPIActuator, SCPISensor, SCPIVoltageSupply

__all__ = ["SCPIActuator", "SCPISensor", "SCPIVoltageSupply"]
