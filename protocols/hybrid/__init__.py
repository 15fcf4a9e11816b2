"""Operator scripts of the thermo-piezoelectric hybrid, and the signals that they record."""

CURRENT, VOLTAGE = "tec_setpoint", "piezo_setpoint"
DEFLECTION = "displacement_position"
BASE, TIP = "base_temperature", "tip_temperature"
WITNESS = "witness_position"
"""The deflection by a sensor beside the loop, where the rig has one, m."""
