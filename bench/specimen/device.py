"""The messages between a twin's device and its driver: lines of text, with all digits of each number.

================  ==============================================================================================
`identity?`       answered by maker, model, serial number and firmware, with commas between them
`measure?`        a reading: the values of all signals, with spaces between them
`glance?`         a quick reading
`set VALUE`       takes a set-point and switches the output on; answered by `done`
`off`             switches the output off; answered by `done`
`output?`         the set-point, or `nan` if the output is off
================  ==============================================================================================

A request that makes no sense, or a set-point beyond the limits, is answered by `refused`. Numbers have one width: the
time of a line does not depend on what is read.
"""

from __future__ import annotations

from pydantic import Field

from bench.devices import DriverSettings
from bench.specimen.tables import SetpointTable, SignalTable

IDENTITY, MEASURE, GLANCE, SET, OFF, OUTPUT = "identity?", "measure?", "glance?", "set", "off", "output?"
DONE, REFUSED = "done", "refused"
END = b"\n"


def number_text(value: float) -> str:
    """Return a number with all its digits, in 25 characters."""
    return f"{value:+25.16e}"


class TwinSettings(DriverSettings):
    """Rig-file settings of a device of a twin."""

    port: str = Field(min_length=1, description="line, as emulated://NAME, or as a served laboratory names it")
    baudrate: int = Field(default=100_000_000, gt=0, description="speed of the line, Bd")
    timeout: float = Field(default=0.1, gt=0, le=10, description="wait for an answer, s")
    signals: tuple[SignalTable, ...] = Field(description="what it measures")
    setpoint: SetpointTable | None = Field(default=None, description="what is set; none of a sensor")
    reading_time: float = Field(default=0.0, ge=0, le=60, description="how long a reading takes, s")
    quick_time: float = Field(default=0.0, ge=0, le=60, description="how long a quick reading takes, s")
    setpoint_time: float = Field(default=0.0, ge=0, le=60, description="how long a set-point takes, s")
