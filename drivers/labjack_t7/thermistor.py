"""A thermistor on analog inputs of a LabJack T7.

Source: Steinhart and Hart 1968, Deep-Sea Research 15.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Self

from pydantic import Field, model_validator

from bench.base import Clock, DeviceError
from bench.devices import Limits, TemperatureSensor
from drivers.labjack_t7.inputs import RAIL, Channel, T7InputDevice, T7InputSettings
from drivers.labjack_t7.registers import LabJackT7

_SHORTED, _OPEN = 0.01, 0.99  # shares of the excitation at a divider beyond which its thermistor is shorted or open
_EXCITATION = 0.2  # share by which an excitation may be off
_KELVIN = 273.15


class T7ThermistorSettings(T7InputSettings):
    """Rig-file settings of a thermistor on a T7.

    The thermistor is between the input of the divider and ground, the reference resistor between that input and
    the excitation.
    """

    channels: tuple[Channel, Channel] = Field(
        default=(0, 1),
        description="analog inputs of the divider and of its excitation, 0 to 13",
    )
    reference_ohms: float = Field(
        default=10e3, gt=0.0, le=1e7, description="reference resistor of the divider in Ω, above 0 to 1e7"
    )
    excitation_volts: float = Field(
        default=2.5, gt=0.0, le=8.0, description="excitation of the divider in V, above 0 to 8; 20 % off is an error"
    )
    steinhart_hart: tuple[float, float, float] = Field(
        default=(1.129148e-3, 2.34125e-4, 8.76741e-8),
        description="A, B and C of 1/T = A + B ln R + C (ln R)³, T in K and R in Ω; the default is a common "
        "thermistor of 10 kΩ at 25 °C",
    )
    temperature_limits: tuple[float, float] = Field(
        default=(-40.0, 125.0), description="range in °C, low and high; a reading beyond is an error"
    )

    @model_validator(mode="after")
    def _check_divider(self) -> Self:
        highest = (1 + _EXCITATION) * self.excitation_volts
        if highest >= RAIL * self.range:
            raise ValueError(
                f"range: an excitation of up to {highest:g} V needs more than ±{self.range:g} V; choose a larger one"
            )
        a, b, c = self.steinhart_hart
        least, most = (math.log(self.reference_ohms * share / (1 - share)) for share in (_SHORTED, _OPEN))
        # The slope of 1/T over ln R has its extremes at the ends and where |ln R| is least.
        slope = min(b + 3 * c * log**2 for log in (least, most, min(max(0.0, least), most)))
        if slope <= 0 or a + b * least + c * least**3 <= 0:
            raise ValueError(
                f"steinhart_hart: the temperature must fall all the way from {math.exp(least):.3g} to "
                f"{math.exp(most):.3g} Ω, which the divider tells apart; got {a:g}, {b:g} and {c:g}"
            )
        low, high = self.temperature_limits
        coldest, hottest = (_celsius(self.steinhart_hart, math.exp(log)) for log in (most, least))
        if not coldest < low < high < hottest:
            raise ValueError(
                f"temperature_limits: expected low < high within {coldest:.4g} to {hottest:.4g} °C, which the "
                f"divider tells from an open and a shorted thermistor; got {low:g} and {high:g} °C"
            )
        return self


class T7Thermistor(T7InputDevice[T7ThermistorSettings], TemperatureSensor):
    """A thermistor in a divider, of which a LabJack T7 measures the voltage and the excitation.

    The temperature comes from the ratio of both by the equation of Steinhart and Hart, so that the excitation
    need not be accurate. Errors are an excitation that has failed, a thermistor that is open or shorted, and a
    temperature outside of its limits.
    """

    Settings: ClassVar[type[T7ThermistorSettings]] = T7ThermistorSettings

    def __init__(self, name: str, settings: T7ThermistorSettings, clock: Clock, line: LabJackT7) -> None:
        super().__init__(name, settings, clock, line)
        self._signal = f"{name}_temperature"
        lowest, highest = ((1 + side * _EXCITATION) * settings.excitation_volts for side in (-1, 1))
        self._excitation = lowest, highest
        self._reference_ohms, self._steinhart_hart = settings.reference_ohms, settings.steinhart_hart
        self._temperature_limits = settings.temperature_limits

    @property
    def reading_limits(self) -> Mapping[str, Limits]:
        """The temperatures that are no error, °C."""
        return {self._signal: Limits(*self._temperature_limits, "°C")}

    def safe(self) -> None:
        """Do nothing: a sensor is safe in any state."""

    def _put(self, values: dict[str, float], voltages: Sequence[float], begin: int) -> None:
        excitation = voltages[begin + 1]
        low, high = self._excitation
        if low <= excitation <= high:
            share = voltages[begin] / excitation
            if _SHORTED < share < _OPEN:
                temperature = _celsius(self._steinhart_hart, self._reference_ohms * share / (1 - share))
                low, high = self._temperature_limits
                if low <= temperature <= high:
                    values[self._signal] = temperature
                else:
                    text = f"temperature {temperature:.4g} °C is outside of"
                    advice = "bring it back, or check the thermistor and `temperature_limits`"
                    self._check_range(text, temperature, self._temperature_limits, "°C", advice)
                return
        raise self._fault(voltages[begin], excitation)

    def _fault(self, divider: float, excitation: float) -> DeviceError:
        """Return what is wrong with the wires."""
        divider_channel, excitation_channel = self._settings.channels
        low, high = self._excitation
        if not low <= excitation <= high:
            return DeviceError(
                self.name,
                f"excitation of the thermistor is {excitation:.3g} V at AIN{excitation_channel}, expected {low:g} to "
                f"{high:g} V; it has failed or is not connected",
            )
        share = divider / excitation
        at = f"the divider at AIN{divider_channel} is at {100 * share:.4g} % of its excitation"
        if share >= _OPEN:
            return DeviceError(self.name, f"thermistor open: {at}; a wire is broken or not connected")
        return DeviceError(self.name, f"thermistor shorted: {at}; check its wires for a short circuit")


def _celsius(steinhart_hart: tuple[float, float, float], ohms: float) -> float:
    """Return the temperature in °C of a thermistor by its resistance in Ω (Steinhart and Hart 1968)."""
    a, b, c = steinhart_hart
    log = math.log(ohms)
    return 1 / (a + b * log + c * log**3) - _KELVIN
