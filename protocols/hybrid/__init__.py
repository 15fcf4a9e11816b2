"""Operator scripts of the thermo-piezoelectric hybrid, and the slots that they ask for."""

from bench.devices import Signal, TECAmplifier, VoltageSupply
from bench.protocol import Views

SENSORS = ("response", "base", "tip")
"""Slots of the deflection (m) and of the temperatures of base and tip (°C)."""
THERMAL = {"coarse": TECAmplifier, "response": Signal, "base": Signal, "tip": Signal}
"""The thermal part, whose current heats if positive, and the sensors."""
FINE = {"fine": VoltageSupply, "response": Signal}
"""The piezo part, and the deflection."""
WITNESS = {"witness": Signal}
"""The deflection by a sensor beside the loop, where the rig has one, m."""

HEATING = Views((("tip", "response"),), plane=False, over_time=("coarse", "tip", "response"))
BOTH_LOOPS = Views((("fine", "response"), ("tip", "response")), plane=False)
FINE_OVER_TIME = Views(over_time=("response", "fine"))
"""What is worth seeing of the thermal part, of both, and of the piezo part in fractions of a second."""
