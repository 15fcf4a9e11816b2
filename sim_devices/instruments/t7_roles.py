"""The roles that an emulated LabJack T7 plays when it is called directly, without a wire.

They stand beside the drivers of `drivers`, with the same defaults, for loops of many kHz on the virtual clock.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Literal

from bench.devices import Identity, Limits, Status
from bench.errors import DeviceError
from bench.roles import PositionSensor, Switch, TemperatureSensor, VoltageSupply
from sim_devices.instruments.emulated import EmulatedDevice
from sim_devices.instruments.labjack_t7 import ALL_DIO, Burst, EmulatedT7
from sim_devices.transducers.thermistor import STEINHART_HART
from sim_devices.wire.modbus import RegisterError

RANGE = 10.0
"""Input range, V."""

RESOLUTION_INDEX, SAMPLES, SAMPLE_RATE = 4, 10, 1000.0
"""Resolution index, conversions in one measurement, and conversions in a second, Hz."""

METRES_PER_RATIO = 0.037 / 2 / 185.0
"""Deflection per current ratio of a two-current detector: its half length over the optical lever, m."""

LEAST_SUM = 0.5
"""Sum of both voltages of such a detector below which the light counts as lost, V."""

STROKE = 0.035
"""Stroke of a ratiometric sensor, m."""

REFERENCE_OHMS, EXCITATION = 10e3, 2.5
"""Reference resistor of a thermistor, Ω, and its excitation, V."""

TEMPERATURES = (-40.0, 125.0)
"""Range of a thermistor, °C."""

VOLTS_PER_VOLT, AMPERES_PER_VOLT = 20.0, 0.01
"""Output voltage and current of an amplifier per volt of their monitors."""

VOLTAGE_LIMITS = Limits(-40.0, 40.0, "V")
"""Set-points of an amplifier."""

_STATUS_AGE = 0.1  # s, after which `set` of an amplifier reads its status again
_KELVIN = 273.15


class _T7Device(EmulatedDevice):
    """A device on an emulated T7.

    Raises
    ------
    RegisterError
        If the instrument refuses a setting.
    """

    def __init__(self, name: str, instrument: EmulatedT7) -> None:
        super().__init__(name, instrument.world)
        self._instrument = instrument

    @property
    def identity(self) -> Identity:
        """Identity of the instrument."""
        return self._instrument.identity


class _T7Reader(_T7Device):
    """A device that measures by analog inputs of a T7; they are set up here.

    Parameters
    ----------
    channels : sequence of int
        Inputs, 0 to 13.
    """

    def __init__(self, name: str, instrument: EmulatedT7, channels: Sequence[int]) -> None:
        super().__init__(name, instrument)
        self._channels = tuple(channels)
        instrument.set_inputs_up(self._channels, RANGE, RESOLUTION_INDEX, SAMPLES, SAMPLE_RATE)

    def measure(self) -> dict[str, float]:
        """Measure every signal, as means of conversions."""
        try:
            bursts = [self._instrument.burst(channel) for channel in self._channels]
        except RegisterError as refusal:
            raise DeviceError(self.name, f"the instrument refuses to measure: {refusal}") from refusal
        return self._values(bursts)

    def glance(self) -> dict[str, float]:
        """Measure every signal by one conversion each."""
        readings = map(self._instrument.convert, self._channels)
        return self._values([Burst(volts, volts, volts) for volts in readings])

    def safe(self) -> None:
        """Do nothing: a sensor is safe in any state."""

    @abstractmethod
    def _values(self, readings: Sequence[Burst]) -> dict[str, float]:
        """Return the values of the signals from the voltages at the inputs."""


class EmulatedPositionSensor(_T7Reader, PositionSensor):
    """The role of a position sensor.

    Parameters
    ----------
    readout : {"voltage", "currents", "ratiometric"}
        One normalised voltage, two amplified photocurrents, or an output that is a share of its supply.
    channels : sequence of int
        Inputs, 0 to 13: one for a voltage, those of the currents 1 and 2 for currents, those of output and supply
        for a ratiometric sensor.
    volts_per_metre : float
        Calibration of a voltage.
    zero_position : float
        Where on the stroke of a ratiometric sensor the position reads zero, m.
    position_limits : tuple of float
        Calibrated range in m.

    Raises
    ------
    ValueError
        If the number of channels does not fit the readout.
    """

    def __init__(
        self,
        name: str,
        instrument: EmulatedT7,
        *,
        readout: Literal["voltage", "currents", "ratiometric"] = "voltage",
        channels: Sequence[int] = (0,),
        volts_per_metre: float = 1e5,
        zero_position: float = 0.0,
        position_limits: tuple[float, float] = (-90e-6, 90e-6),
    ) -> None:
        expected = 1 if readout == "voltage" else 2
        if len(channels) != expected:
            raise ValueError(f"channels: {readout} needs {expected}, got {len(channels)}")
        super().__init__(name, instrument, channels)
        self._readout = readout
        self._volts_per_metre = volts_per_metre
        self._zero_position = zero_position
        self._limits = position_limits

    def _values(self, readings: Sequence[Burst]) -> dict[str, float]:
        for channel, reading in zip(self._channels, readings, strict=True):
            if max(reading.maximum, -reading.minimum) >= 0.999 * RANGE:
                raise DeviceError(self.name, f"AIN{channel} is over its range of ±{RANGE:g} V")
        volts = [reading.average for reading in readings]
        if self._readout == "voltage":
            position = volts[0] / self._volts_per_metre
        elif self._readout == "ratiometric":
            position = self._along_the_stroke(*volts)
        else:
            first, second = volts
            if first + second < LEAST_SUM:
                raise DeviceError(self.name, f"light lost: the currents add up to {first + second:.3g} V")
            position = METRES_PER_RATIO * (second - first) / (first + second)
        low, high = self._limits
        if not low <= position <= high:
            raise DeviceError(self.name, f"position {position:g} m is outside of {low:g} to {high:g} m")
        return {f"{self.name}_position": position}

    def _along_the_stroke(self, output: float, supply: float) -> float:
        if not 4.5 <= supply <= 5.5:
            raise DeviceError(self.name, f"supply voltage of the sensor is {supply:.3g} V")
        # At 10 and 90 % of the supply the magnet may be anywhere beyond the end.
        share = (output / supply - 0.1) / 0.8
        if not 0.0005 <= share <= 0.9995:
            raise DeviceError(self.name, f"output of the sensor is {output / supply:.4g} of its supply")
        return STROKE * share - self._zero_position


class EmulatedTemperatureSensor(_T7Reader, TemperatureSensor):
    """The role of a temperature sensor; an excitation that is 20 % off is an error.

    Parameters
    ----------
    channels : tuple of int
        Inputs of a thermistor's divider and of its excitation, 0 to 13.
    """

    def __init__(self, name: str, instrument: EmulatedT7, *, channels: tuple[int, int] = (0, 1)) -> None:
        super().__init__(name, instrument, channels)

    def _values(self, readings: Sequence[Burst]) -> dict[str, float]:
        divider, excitation = (reading.average for reading in readings)
        if not 0.8 <= excitation / EXCITATION <= 1.2:
            raise DeviceError(self.name, f"excitation of the thermistor is {excitation:.3g} V")
        share = divider / excitation
        if not 0.01 < share < 0.99:
            raise DeviceError(self.name, f"thermistor {'open' if share > 0.5 else 'shorted'}")
        a, b, c = STEINHART_HART
        log = math.log(REFERENCE_OHMS * share / (1 - share))
        temperature = 1 / (a + b * log + c * log**3) - _KELVIN
        low, high = TEMPERATURES
        if not low <= temperature <= high:
            raise DeviceError(self.name, f"temperature {temperature:.4g} °C is outside of {low:g} to {high:g} °C")
        return {f"{self.name}_temperature": temperature}


class EmulatedSwitch(_T7Device, Switch):
    """The role of a switch, played by a digital line.

    Parameters
    ----------
    name, instrument
        See `_T7Device`; the line is switched off and put under the watchdog here.
    line : int
        Number of the line, 0 to 22.
    active_high : bool
        Whether a high level is on.
    watchdog : int
        Silence in s after which the instrument switches the line off, 1 or more; a shorter time that is set
        already for something else stays.
    """

    def __init__(
        self, name: str, instrument: EmulatedT7, *, line: int, active_high: bool = True, watchdog: int = 5
    ) -> None:
        super().__init__(name, instrument)
        self._line = line
        self._active_high = active_high
        self._drive(False)
        self._guard(watchdog)

    def set(self, value: float) -> Status:
        """Switch on (1) or off (0)."""
        self.check(value)
        self._setpoint = float(value)
        self._drive(value == 1.0)
        return Status.completed(self.name, self._clock)

    def measure(self) -> dict[str, float]:
        """Read back whether the line is on."""
        level = int(self._instrument.read_value("DIO_STATE")) >> self._line & 1
        on = bool(level) == self._active_high
        if self._setpoint == 1.0 and not on:
            self._setpoint = 0.0
            raise DeviceError(self.name, f"DIO{self._line} is off although it was switched on: the watchdog ran out")
        return {f"{self.name}_state": float(on)}

    def safe(self) -> None:
        """Switch off."""
        self._setpoint = 0.0
        self._drive(False)

    def _drive(self, on: bool) -> None:
        self._instrument.write_value(f"DIO{self._line}", on == self._active_high)

    def _guard(self, seconds: int) -> None:
        """Have the watchdog switch the line off, and leave its other settings as they are."""

        def read(setting: str) -> int:
            return int(self._instrument.read_value(f"WATCHDOG_{setting}_DEFAULT"))

        bit = 1 << self._line
        inhibit = read("DIO_INHIBIT") if read("ENABLE") and read("DIO_ENABLE") else ALL_DIO
        if ~inhibit & ~bit & ALL_DIO or (read("ENABLE") and (read("DAC0_ENABLE") or read("DAC1_ENABLE"))):
            seconds = min(seconds, read("TIMEOUT_S"))
        state, direction = read("DIO_STATE"), read("DIO_DIRECTION")
        for setting, value in (
            ("ENABLE", 0),
            ("TIMEOUT_S", seconds),
            ("DIO_ENABLE", 1),
            ("DIO_STATE", state & ~bit if self._active_high else state | bit),
            ("DIO_DIRECTION", direction | bit),
            ("DIO_INHIBIT", inhibit & ~bit),
            ("ENABLE", 1),
        ):
            self._instrument.write_value(f"WATCHDOG_{setting}_DEFAULT", value)


class EmulatedHighVoltageSupply(_T7Reader, VoltageSupply):
    """The role of a voltage supply, played by a T7 and the amplifier behind it.

    Parameters
    ----------
    name, instrument
        See `_T7Reader`; the line is switched off and put under the watchdog here.
    line, watchdog
        Line of the enable input, as those of `EmulatedSwitch`.
    channels : tuple of int
        Inputs of the amplifier's voltage monitor, current monitor and status output, 0 to 13.
    analog_output : str
        Output of the set-point: dac0, dac1, or tdac0 to tdac22.
    gain, offset_volts : float
        The amplifier, as those of `PiezoAmplifier`.
    """

    def __init__(
        self,
        name: str,
        instrument: EmulatedT7,
        *,
        line: int,
        channels: tuple[int, int, int] = (0, 1, 2),
        analog_output: str = "tdac0",
        watchdog: int = 5,
        gain: float = 20.0,
        offset_volts: float = 0.0,
    ) -> None:
        super().__init__(name, instrument, channels)
        self._register = analog_output.upper()
        self._gain = gain
        self._offset = offset_volts
        self._enabled = False
        self._looked = -math.inf
        self._sent = Status.completed(name, instrument.world.clock)
        self._send(0.0)
        self._enable = EmulatedSwitch(name, instrument, line=line, watchdog=watchdog)

    @property
    def limits(self) -> Limits:
        """The voltages that are allowed."""
        return VOLTAGE_LIMITS

    @property
    def output(self) -> str:
        """A constant voltage."""
        return "dc"

    def set(self, value: float) -> Status:
        """Send a voltage in V, and switch the amplifier on if it is off, at 0 V."""
        self.check(value)
        if not self._enabled:
            self._switch_on()
        elif self._clock.now() - self._looked >= _STATUS_AGE:
            self.glance()
        self._setpoint = float(value)
        self._send(value)
        return self._sent

    def safe(self) -> None:
        """Send 0 V and switch the enable line off."""
        self._setpoint = 0.0
        self._switch_off()

    def _send(self, volts: float) -> None:
        self._instrument.write_value(self._register, self._offset + volts / self._gain)

    def _switch_on(self) -> None:
        self._setpoint = 0.0
        self._send(0.0)
        self._enable.set(1.0)
        self._enabled = True
        self.glance()

    def _switch_off(self) -> None:
        self._enabled = False
        self._send(0.0)
        self._enable.safe()

    def _values(self, readings: Sequence[Burst]) -> dict[str, float]:
        voltage, current, status = (reading.average for reading in readings)
        self._looked = self._clock.now()
        on = status >= 2.0
        if on and not self._enabled:
            raise DeviceError(self.name, "the amplifier reports that it is on although it was switched off")
        if self._enabled and not on:
            self._setpoint = 0.0
            try:
                self._enable.measure()
                cause = "its enable line is on: its own protection has tripped"
            except DeviceError:
                cause = "its enable line is off: the watchdog has run out"
            self._switch_off()
            raise DeviceError(self.name, f"the amplifier went off by itself, while {cause}")
        return {
            f"{self.name}_voltage": VOLTS_PER_VOLT * voltage,
            f"{self.name}_current": AMPERES_PER_VOLT * current,
        }
