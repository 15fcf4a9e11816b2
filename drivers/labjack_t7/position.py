"""Position sensors on analog inputs of a LabJack T7: optical detectors and ratiometric linear sensors.

Assumption: a linear magnet sensor such as the SPS-L035-LATS gives 10 to 90 % of its supply of 5 V over its stroke of
35 mm, and stays at 10 or 90 % when the magnet is beyond the end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from bench.base import Clock, DeviceError
from bench.devices import Limits, PositionSensor
from drivers.device import Slope
from drivers.labjack_t7.inputs import T7InputDevice, T7InputSettings
from drivers.labjack_t7.registers import Floats, LabJackT7

_USABLE = 0.95  # share of a detector's length that limits may use
_READOUTS = {"voltage": 1, "currents": 2, "ratiometric": 2}  # inputs that each takes
_SUPPLY = (4.5, 5.5)  # V, of a ratiometric sensor
_OUTPUT = (0.1, 0.9)  # share of the supply that its output takes over the stroke
_END = 5e-4  # share of the stroke next to its ends that may be the magnet beyond them; half a step of the sensor


class T7PositionSettings(T7InputSettings):
    """Rig-file settings of a position sensor on a T7."""

    readout: Literal["voltage", "currents", "ratiometric"] = Field(
        default="voltage",
        description="voltage: one normalised voltage; currents: two amplified photocurrents, 1 and 2; ratiometric: "
        "output and supply of a sensor whose output is a share of its supply",
    )
    volts_per_metre: Slope = Field(
        default=1e5, description="voltage readout: sensitivity in V/m, not 0; 1e5 is 0.1 V/µm"
    )
    zero_volts: float = Field(
        default=0.0, ge=-10.0, le=10.0, description="voltage readout: voltage at position zero in V, -10 to 10"
    )
    psd_length: float = Field(
        default=0.037, gt=0.0, le=1.0, description="currents: length of the detector, m, to 1; Hamamatsu S3270: 0.037"
    )
    metres_per_metre: Slope = Field(
        default=185.0, description="currents: movement of the spot per movement of the tip, not 0; its sign is kept"
    )
    minimum_sum_volts: float = Field(
        default=0.5, gt=0.0, le=20.0, description="currents: sum of voltages below which the light is lost, V, to 20"
    )
    stroke: float = Field(
        default=0.035, gt=0.0, le=1.0, description="ratiometric: stroke of the sensor, m, to 1; SPS-L035-LATS: 0.035"
    )
    zero_position: float = Field(
        default=0.0, ge=0.0, le=1.0, description="ratiometric: position on the stroke that reads zero, m, from 0"
    )
    position_limits: tuple[float, float] = Field(
        default=(-90e-6, 90e-6), description="calibrated range in m, low and high; a reading beyond is an error"
    )

    @model_validator(mode="after")
    def _check_readout(self) -> Self:
        expected = _READOUTS[self.readout]
        if len(self.channels) != expected:
            raise ValueError(
                f"channels: readout {self.readout!r} needs {expected} different, got {list(self.channels)}"
            )
        low, high = self.position_limits
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise ValueError(f"position_limits: expected low < high, got {low:g} and {high:g} m")
        if self.readout == "currents":
            # A spot that leaves the detector reads as at its end, which is no position.
            reach = _USABLE * self.psd_length / 2 / abs(self.metres_per_metre)
            if max(-low, high) > reach:
                raise ValueError(
                    f"position_limits: the detector reaches ±{reach:.4g} m (95 % of its half length over the "
                    f"magnification), got {low:g} and {high:g} m"
                )
        if self.readout == "ratiometric":
            self._check_stroke()
        return self

    def _check_stroke(self) -> None:
        if self.range != 10.0:
            raise ValueError(f"range: a supply of 5 V needs 10 V, got {self.range:g} V")
        if self.zero_position > self.stroke:
            raise ValueError(f"zero_position: {self.zero_position:g} m is beyond the stroke of {self.stroke:g} m")
        low, high = self.position_limits
        first, last = -self.zero_position, self.stroke - self.zero_position
        rounding = 1e-9
        if low < first - rounding or high > last + rounding:
            raise ValueError(
                f"position_limits: the stroke of the sensor is {first:g} to {last:g} m, got {low:g} and {high:g} m"
            )


class T7PositionSensor(T7InputDevice[T7PositionSettings], PositionSensor):
    """A position sensor on one or two analog inputs of a LabJack T7: a detector of light, or a linear sensor.

    `measure` looks at the extremes of the burst too. Two inputs are averaged one after the other, and the position
    comes from the ratio of the means.

    A ratiometric sensor whose magnet is beyond the end of its stroke reads as if it were at the end, so readings
    within 0.05 % of the stroke from its ends are errors. So are lost light, a missing supply, an output that the
    sensor does not give over its stroke, and a position outside of the calibration.
    """

    Settings: ClassVar[type[T7PositionSettings]] = T7PositionSettings

    def __init__(self, name: str, settings: T7PositionSettings, clock: Clock, line: LabJackT7) -> None:
        super().__init__(name, settings, clock, line)
        self._signal = f"{name}_position"
        self._readout, self._position_limits = settings.readout, settings.position_limits
        self._zero_volts, self._volts_per_metre = settings.zero_volts, settings.volts_per_metre

    @property
    def reading_limits(self) -> Mapping[str, Limits]:
        """The calibrated range of the position, m."""
        return {self._signal: Limits(*self._position_limits, "m")}

    def safe(self) -> None:
        """Do nothing: a sensor is safe in any state."""

    def _put(self, values: dict[str, float], voltages: Sequence[float], begin: int) -> None:
        if self._readout == "voltage":
            position = (voltages[begin] - self._zero_volts) / self._volts_per_metre
        elif self._readout == "currents":
            position = self._from_currents(*voltages[begin : begin + 2])
        else:
            position = self._from_ratio(*voltages[begin : begin + 2])
        low, high = self._position_limits
        if not low <= position <= high:
            raise DeviceError(
                self.name,
                f"position {position:.6g} m is outside of its calibrated range {low:g} to {high:g} m; bring the "
                "actuator back or extend the calibration and `position_limits`",
            )
        values[self._signal] = position

    def _converted(self, voltages: Floats) -> Floats:
        settings = self._settings
        if settings.readout == "voltage":
            positions = (voltages - settings.zero_volts) / settings.volts_per_metre
            low, high = settings.position_limits
            if ((low <= positions) & (positions <= high)).all():
                return positions
        return super()._converted(voltages)

    def _from_currents(self, first: float, second: float) -> float:
        settings = self._settings
        total = first + second
        if total < settings.minimum_sum_volts:
            raise DeviceError(
                self.name,
                f"light lost: both currents together give {total:.3g} V, "
                f"less than {settings.minimum_sum_volts:g} V; check the laser and the spot on the detector",
            )
        return settings.psd_length / 2 * (second - first) / total / settings.metres_per_metre

    def _from_ratio(self, output: float, supply: float) -> float:
        settings = self._settings
        output_channel, supply_channel = settings.channels
        if not _SUPPLY[0] <= supply <= _SUPPLY[1]:
            raise DeviceError(
                self.name,
                f"supply voltage of the sensor is {supply:.3g} V at AIN{supply_channel}, expected {_SUPPLY[0]:g} to "
                f"{_SUPPLY[1]:g} V; the supply has failed or is not connected",
            )
        low, high = _OUTPUT
        share = (output / supply - low) / (high - low)
        if not _END <= share <= 1 - _END:
            raise DeviceError(
                self.name,
                f"output of the sensor at AIN{output_channel} is {100 * output / supply:.4g} % of its supply, "
                f"expected {100 * low:g} to {100 * high:g} %; the magnet is at or beyond the end of the stroke, or "
                "a wire is broken",
            )
        return settings.stroke * share - settings.zero_position
