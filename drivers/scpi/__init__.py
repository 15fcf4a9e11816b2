"""Supplies, meters and other text instruments that a rig file describes (`bench.command_table`), without Python."""

from drivers.scpi.devices import SCPIActuator, SCPISensor, SCPIVoltageSupply

__all__ = ["SCPIActuator", "SCPISensor", "SCPIVoltageSupply"]
