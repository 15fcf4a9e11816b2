"""A high-voltage amplifier for a piezo, controlled and monitored by a LabJack T7.

Sources: LabJack T-series datasheet 15.0 for the analog outputs; LJTick-DAC datasheet for the outputs TDAC; LabJack,
Direct Modbus TCP, Protocol Details, for function 76 and the 1040 bytes of a packet.

Assumption: a T7 takes several writes of an LJTick-DAC in one packet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from typing import ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from bench.base import Clock, DeviceError
from bench.devices import Device, Limits, Status, VoltageSupply
from drivers.device import STATUS_AGE, Slope, attempt
from drivers.labjack_t7.inputs import RAIL, Channel, T7InputDevice, T7InputSettings
from drivers.labjack_t7.lines import LINES, T7LineDevice, T7LineSettings
from drivers.labjack_t7.registers import DAC, TDAC, Floats, LabJackT7, Target

_DAC_REACH = (0.0, 5.0)  # V, datasheet 15.0
_TDAC_REACH = (-10.0, 10.0)  # V, datasheet of the LJTick-DAC
_STATUS_ON = 2.0  # V, from which on a status output is high, the level of TTL
_LOOKS, _LOOK_INTERVAL = 50, 0.01  # how often, and every how many s, a change of the status is looked for
_LONGEST_WAIT = 100_000.0  # µs
_DISCHARGED = 1.0  # V, below which an output counts as 0 V


class T7HighVoltageSettings(T7InputSettings, T7LineSettings):
    """Rig-file settings of a T7 that drives a high-voltage amplifier of fixed gain."""

    channels: tuple[Channel, Channel, Channel] = Field(
        default=(0, 1, 2),
        description="analog inputs of the amplifier's voltage monitor, current monitor and status output (5 V while "
        "it is on), 0 to 13",
    )
    line: int = Field(
        ge=0, lt=LINES, description="digital line of the amplifier's enable input, 0 to 22, FIO0-7 are 0-7"
    )
    analog_output: str = Field(
        default="tdac0",
        pattern=r"^(dac[01]|tdac(1?\d|2[0-2]))$",
        description="output of the set-point: dac0 or dac1 (0 to 5 V), or tdac0 to tdac22 (LJTick-DAC, -10 to 10 V)",
    )
    gain: Slope = Field(default=20.0, description="gain of the amplifier in V/V, not 0")
    offset_volts: float = Field(
        default=0.0, ge=-10.0, le=10.0, description="input of the amplifier in V at which it gives 0 V, -10 to 10"
    )
    volts_per_volt: Slope = Field(default=20.0, description="output voltage per volt of the voltage monitor, not 0")
    amperes_per_volt: Slope = Field(default=0.01, description="output current in A per volt of its monitor, not 0")
    voltage_limits: tuple[float, float] = Field(
        default=(-40.0, 40.0), description="lowest and highest set-point in V, with 0 V between or at them"
    )

    @model_validator(mode="after")
    def _check_amplifier(self) -> Self:
        if self.range != 10.0:
            raise ValueError(f"range: a status output of 5 V needs 10 V, got {self.range:g} V")
        low, high = self.voltage_limits
        if not (low <= 0 <= high and low < high):
            raise ValueError(f"voltage_limits: expected low ≤ 0 ≤ high and low < high, got {low:g} and {high:g} V")
        first, last = _TDAC_REACH if self.analog_output.startswith("t") else _DAC_REACH
        for volts in self.voltage_limits:
            sent = self.sent(volts)
            if not first <= sent <= last:
                raise ValueError(
                    f"voltage_limits: {volts:g} V takes {sent:g} V at {self.analog_output}, which gives {first:g} to "
                    f"{last:g} V"
                )
        if max(-low, high) >= abs(self.volts_per_volt) * RAIL * self.range:
            raise ValueError(f"volts_per_volt: the voltage monitor would be over its range of ±{self.range:g} V")
        if self.analog_output.startswith("t") and self.line // 2 == int(self.analog_output[4:]) // 2:
            raise ValueError(f"line: DIO{self.line} is taken by the LJTick-DAC of {self.analog_output}")
        return self

    def sent(self, volts: float) -> float:
        """Return the voltage in V at the analog output that makes the amplifier give `volts`."""
        return self.offset_volts + volts / self.gain


class T7HighVoltageSupply(T7InputDevice[T7HighVoltageSettings], T7LineDevice[T7HighVoltageSettings], VoltageSupply):
    """A high-voltage amplifier of fixed gain, controlled and monitored by a LabJack T7.

    An analog output gives the set-point, a digital line enables the amplifier, and three analog inputs read its
    voltage monitor, its current monitor and its status output. The watchdog of the instrument drives the enable
    line only: it cannot drive an LJTick-DAC, which cannot be read back either, so the voltage monitor confirms 0 V.
    An LJTick-DAC has 14 bits over ±10 V, DAC0 and DAC1 have 12 over 5 V, so a gain that uses the whole range gives
    the finest steps.

    `connect` switches the amplifier off, and raises `DeviceError` if it does not go off. `safe` takes three requests
    or more. `set` takes one request; the first one, and the first after the output went off, four or more, and one
    whose last look at the status, by any call, was 0.1 s ago or more takes one more.

    Give the enable input a strong pull-down or an interlock of its own: the line is pulled high from power-up of the
    instrument until `connect`.

    When the amplifier went off by itself, the next `measure` or `glance` says so once, and so does the next `set`
    that looks at the status. The set-point is 0 then and the enable line off; `set` switches on again. Readings also
    raise `DeviceError` while the amplifier is on although it was switched off.
    """

    Settings: ClassVar[type[T7HighVoltageSettings]] = T7HighVoltageSettings

    def __init__(self, name: str, settings: T7HighVoltageSettings, clock: Clock, line: LabJackT7) -> None:
        super().__init__(name, settings, clock, line)
        self._limits = Limits(*settings.voltage_limits, "V")
        self._low, self._high = settings.voltage_limits
        kind, number = settings.analog_output.split("dac")
        self._register = (TDAC if kind else DAC).of(int(number))
        self._target = Target.of(self._register)
        self._offset, self._gain = settings.offset_volts, settings.gain
        self._enabled = False
        self._looked = -math.inf
        self._sent = Status.completed(name, clock)

    def _start(self) -> None:
        super()._start()
        self._switch_off()
        self._output.guard(self._settings.watchdog)

    @property
    def limits(self) -> Limits:
        """The voltages that are allowed."""
        return self._limits

    @property
    def output(self) -> str:
        """What the set-point is: a constant voltage."""
        return "dc"

    def set(self, value: float) -> Status:
        """Send a voltage in V, and switch the amplifier on if it is off, at 0 V.

        The status is complete at once: an amplifier settles within the time of the reply. An amplifier that does
        not go on or went off by itself is a `DeviceError`.
        """
        if not self._low <= value <= self._high:
            self.check(value)
        if not self._enabled:
            self._switch_on()
        elif self._clock.now() - self._looked >= STATUS_AGE:
            self.glance()
        self._send(value)
        self._setpoint = float(value)
        return self._sent

    def glance(self) -> dict[str, float]:
        """Measure voltage and current by one conversion of each input, and look that no other program took over."""
        return self._values(*self._check(self._line.read_packet(self._packet)))

    def can_play(self, sensor: Device, period: float) -> bool:
        """Return whether `play` takes a sensor and a period: one on the same connection, and whole µs of a wait."""
        return (
            isinstance(sensor, T7InputDevice)
            and sensor.is_on(self._line)
            and 1.0 <= 1e6 * period <= _LONGEST_WAIT
            and math.isclose(round(1e6 * period), 1e6 * period, rel_tol=1e-6)
            and self._line.most_played(sensor.conversions) * period < self._settings.timeout
        )

    def play(self, setpoints: Floats, period: float, sensor: Device) -> Floats:
        """Read a sensor on the same T7 and send a voltage, sample after sample, at the pace of the instrument.

        One request holds up to 51 samples of a sensor with one input: per sample a read of AIN#, a write of the
        output, and a wait of the period, so that the host takes part once in a block only.

        A real T7 takes longer than the period, as conversions and writes come on top of the wait. The datasheet of
        the LJTick-DAC gives about 1 ms for an update of its output over I2C, most of it for the communication with
        the host, which a block needs once only; how long the update itself takes it does not say. So 20 kHz is for
        an emulated T7, and the pace of a real one has to be measured before a model is made of such samples.

        Raises what `set` and the `glance` of the sensor raise; readings of the block are lost then.
        """
        low, high = self._settings.voltage_limits
        if not (allowed := (low <= setpoints) & (setpoints <= high)).all():
            self.check(float(setpoints[~allowed][0]))
        if not self._enabled:
            self._switch_on()
        elif self._clock.now() - self._looked >= STATUS_AGE:
            self.glance()
        assert isinstance(sensor, T7InputDevice)
        spans = sensor.conversions
        most, wait = self._line.most_played(spans), round(1e6 * period)
        start = self._clock.now()
        sent = self._offset + setpoints / self._gain
        rows = []
        for first in range(0, len(sent), most):
            self._clock.sleep_until(start + first * period)
            self._setpoint = float(setpoints[min(first + most, len(sent)) - 1])
            rows.append(self._line.play(spans, self._register, sent[first : first + most], wait))
        return sensor.converted(np.concatenate(rows))

    def _make_safe(self) -> None:
        """Send 0 V, switch the enable line off, and see that the amplifier is off and its output at 0 V."""
        self._setpoint = 0.0
        self._switch_off()

    def _send(self, volts: float) -> None:
        self._line.send(self._target, self._offset + volts / self._gain)

    def _switch_on(self) -> None:
        self._setpoint = 0.0
        try:
            self._send(0.0)
            self._output.switch(True)
            for _ in range(_LOOKS):
                if self._look()[2]:
                    self._enabled = True
                    return
                self._clock.sleep(_LOOK_INTERVAL)
            raise DeviceError(
                self.name,
                f"the amplifier does not report that it is on {_LOOKS * _LOOK_INTERVAL:g} s after {self._output}, "
                "its enable line, was switched on; check its power, its own protection and interlocks, and the wire "
                f"from its status output to AIN{self._settings.channels[2]}",
            )
        except BaseException:
            with suppress(DeviceError):
                self._switch_off()
            raise

    def _switch_off(self) -> None:
        """Try every step, also after one that fails, and raise the first error."""
        self._enabled = False
        failures = attempt(partial(self._send, 0.0), partial(self._output.switch, False), self._check_off)
        if failures:
            raise failures[0]

    def _check_off(self) -> None:
        for _ in range(_LOOKS):
            voltage, _, on = self._look()
            if not on and abs(voltage) < _DISCHARGED:
                return
            self._clock.sleep(_LOOK_INTERVAL)
        if on:
            raise self._still_on()
        raise DeviceError(
            self.name,
            f"the output is at {voltage:.3g} V although it was switched off; keep away from it and switch the "
            "amplifier off by hand",
        )

    def _look(self) -> tuple[float, float, bool]:
        """Get voltage in V, current in A, and whether the amplifier reports that it is on, by one conversion."""
        return self._monitored(*self._check(self._read()))

    def _monitored(self, voltage: float, current: float, status: float) -> tuple[float, float, bool]:
        self._looked = self._clock.now()
        settings = self._settings
        return settings.volts_per_volt * voltage, settings.amperes_per_volt * current, status >= _STATUS_ON

    def _put(self, values: dict[str, float], voltages: Sequence[float], begin: int) -> None:
        voltage, current, on = self._monitored(*voltages[begin : begin + 3])
        if on and not self._enabled:
            raise self._still_on()
        if self._enabled and not on:
            raise self._went_off()
        values[f"{self.name}_voltage"], values[f"{self.name}_current"] = voltage, current

    def _still_on(self) -> DeviceError:
        return DeviceError(
            self.name,
            f"the amplifier reports that it is on although {self._output}, its enable line, was switched off; check "
            "the wiring, and that no other program uses the line",
        )

    def _went_off(self) -> DeviceError:
        """Bring everything into the safe state, and return the error with its probable cause."""
        self._setpoint = 0.0
        if self._output.is_on:
            cause = (
                f"{self._output}, its enable line, is on: its own protection has tripped, an interlock is open, or "
                "it has lost its power"
            )
        else:
            cause = (
                f"{self._output}, its enable line, is off: the watchdog of the instrument has run out, as no host "
                f"communicated with it for {self._output.watchdog} s, or another program switched the line"
            )
        try:
            self._switch_off()
        except DeviceError as error:
            cause += f"; that it is safe could not be confirmed ({error})"
        return DeviceError(
            self.name,
            f"the amplifier went off by itself, while {cause}; the set-point is 0 V now: remove the cause, then set "
            "it again",
        )
