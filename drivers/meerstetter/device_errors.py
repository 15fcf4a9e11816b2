"""Error numbers of the Meerstetter TEC controllers: what they mean and what to do.

Source: Meerstetter 5216 (TEC-family user manual: error numbers).
"""

from __future__ import annotations

from collections.abc import Mapping

_CALL_MAKER = "ask Meerstetter if it comes again after a power cycle"
_SET_UP = "load a parameter file for this firmware with the maker's service software"
_WIRING = "check the Peltier element and its cables for a short circuit or an insulation defect"
_OBJECT_SENSOR = "check the object sensor, its cable and the sensor set-up"
_SINK_SENSOR = "check the sink sensor, its cable and the sensor set-up"
_THRESHOLD = "check the load, or raise the error threshold with the maker's service software"

DEVICE_ERRORS: Mapping[int, tuple[str, str]] = {
    **dict.fromkeys(range(1, 11), ("processor malfunction", _CALL_MAKER)),
    11: ("emergency stop", "find out who stopped it and why"),
    12: ("operator panel timed out", "check the operator panel"),
    **dict.fromkeys((20, 21, 25, 26, 27, 28, 29), ("malfunction of the parameter system", _CALL_MAKER)),
    22: ("the parameter set in the flash is corrupt", _SET_UP),
    23: ("the parameter set does not fit the firmware", _SET_UP),
    24: ("the firmware does not know the hardware", _CALL_MAKER),
    30: ("supply voltage too low", "check the power supply, its cable and its current limit"),
    31: ("supply voltage too high", "check the power supply"),
    32: ("internal medium voltage too low", "check the power supply"),
    33: ("internal medium voltage too high", "check the power supply"),
    36: ("internal 3.3 V too low", _CALL_MAKER),
    37: ("internal 3.3 V too high", _CALL_MAKER),
    **dict.fromkeys((50, 51, 52), ("flash failure", _CALL_MAKER)),
    53: ("the serial send buffer overflowed", "ask the device less often"),
    60: ("the device is too hot", "improve its cooling or lower the current"),
    61: ("factory test hardware does not answer", _CALL_MAKER),
    100: ("over-current, positive at OUT+", _WIRING),
    101: ("over-current, negative at OUT+", _WIRING),
    102: ("over-current, positive at OUT−", _WIRING),
    103: ("over-current, negative at OUT−", _WIRING),
    104: ("over-voltage at OUT+", "check that the Peltier element is connected"),
    105: ("over-voltage at OUT−", "check that the Peltier element is connected"),
    106: ("the currents of OUT+ and OUT− differ", _WIRING),
    107: ("over-current, fast switch-off", _WIRING),
    108: (
        "the output stage is in saturation",
        "lower the current or the voltage limitation, or raise the supply voltage",
    ),
    109: ("the currents of OUT+ and OUT− are too unequal", _WIRING),
    110: ("the allowed output power is reached", "lower the current limitation"),
    111: ("the resistance of the load is too low", "lower the current limitation or the supply voltage"),
    **dict.fromkeys(range(120, 124), ("the current measurement has an offset", _CALL_MAKER)),
    **dict.fromkeys((130, 131, 132), ("object temperature circuit failure", _CALL_MAKER)),
    133: ("the object sensor reads below its range", _OBJECT_SENSOR),
    134: ("the object sensor reads above its range, as without a sensor", _OBJECT_SENSOR),
    137: ("the object temperature is below its error threshold", _THRESHOLD),
    138: ("the object temperature is above its error threshold", _THRESHOLD),
    139: ("the object temperature changes too fast", _OBJECT_SENSOR),
    140: ("the sink sensor reads below its range", _SINK_SENSOR),
    141: ("the sink sensor reads above its range, as without a sensor", _SINK_SENSOR),
    142: ("the sink temperature is below its error threshold", _THRESHOLD),
    143: ("the sink temperature is above its error threshold", "check fan and water of the heat sink"),
    144: ("the sink temperature changes too fast", _SINK_SENSOR),
    **dict.fromkeys(range(150, 154), ("object temperature circuit failure", _CALL_MAKER)),
    **dict.fromkeys(range(160, 166), ("the connection of the boards fails", "check the board connection")),
    **dict.fromkeys(range(170, 174), ("auto tuning failed", "tune again with the maker's service software")),
    175: ("the fan does not reach its speed", "check the fan"),
    176: ("the fan is blocked", "check the fan"),
    **dict.fromkeys((180, 181), ("the lookup table is wrong", "check the lookup table")),
    182: ("the temperature was not stable in time", "check the PID set-up and the load"),
    183: (
        "communication watchdog: the host was silent for too long and the output went off",
        "find out why the host stopped, or allow it more time with the key watchdog",
    ),
    184: ("the display format is wrong", "check the display set-up"),
}
"""What the error numbers mean and what to do (Meerstetter 5216, error numbers)."""

UNKNOWN_ERROR = ("unknown to this driver", "look it up in the manual of the device")
