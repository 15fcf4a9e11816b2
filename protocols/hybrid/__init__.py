"""Operator scripts of the thermo-piezoelectric hybrid, and the slots that they ask for."""

from bench.devices import Signal
from bench.roles import TECAmplifier, VoltageSupply

SENSORS = ("response", "base", "tip")
"""Slots of the deflection (m) and of the temperatures of base and tip (°C)."""
THERMAL = {"coarse": TECAmplifier, "response": Signal, "base": Signal, "tip": Signal}
"""The thermal part, whose current heats if positive, and the sensors."""
FINE = {"fine": VoltageSupply, "response": Signal}
"""The piezo part, and the deflection."""
WITNESS = {"witness": Signal}
"""The deflection by a sensor beside the loop, where the rig has one, m."""
