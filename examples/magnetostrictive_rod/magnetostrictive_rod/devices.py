"""The drivers: a coil current source and a strain bridge, each on a serial line; `instruments` lists the messages."""

from __future__ import annotations

from drivers.scpi import SCPIActuator, SCPISensor
from drivers.table import Reading, Setpoint


class CoilSource(
    SCPIActuator,
    baudrate=115200,
    identity_query="ID?",
    identity="Example,coil-source,{any}",
    output={"off": ["OFF"], "query": "ON?"},
):
    """A source of the coil's current, A. `set` completes when the current has arrived; safe is the output off."""

    current = Reading("I?", "A", None, "coil current", precision=4)
    drive = Setpoint(
        "SET {value:.3f}",
        "A",
        (-5.0, 5.0),
        "current set-point",
        query="SET?",
        arrival={"signal": "current", "tolerance": 2e-3, "timeout": 5.0},
    )


class StrainBridge(SCPISensor, baudrate=115200, identity_query="ID?", identity="Example,strain-bridge,{any}"):
    """An amplifier for two strain gauges: the voltages of their bridges, read at once."""

    voltage_a = Reading("V?", "V", None, "bridge voltage, gauge a", reply="{voltage_a} {voltage_b}", precision=6)
    voltage_b = Reading("V?", "V", None, "bridge voltage, gauge b", reply="{voltage_a} {voltage_b}", precision=6)
