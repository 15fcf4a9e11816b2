"""A high-voltage amplifier for a piezoelectric load."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from sim_devices.noise import normals
from sim_devices.world import World


class PiezoLoad(Protocol):
    """The load of a high-voltage amplifier."""

    def lead(self, start: float, target: float, steps: int, time_constant: float) -> None:
        """Go with a voltage from `start` to `target` (V) as a lag of first order does (s), in so many even steps."""


class PiezoAmplifier:
    """A high-voltage amplifier of fixed gain with an enable input, two monitors and a status output.

    The output goes to a new value as a lag of first order does. The monitors show it exactly. The load, which
    holds a voltage until the next, gets it in even steps of `STEP` or less, each at the instant at which the
    output passes the middle of the step, so that it is half a step off at most, and arrives. It never goes back on
    its way, also when the next set-point comes before it arrives. The output is clipped at ±`SATURATION`, and goes
    to 0 V while the amplifier is off.

    Assumptions: the protection stays tripped until the enable input is taken away; the status output changes at
    once.

    Parameters
    ----------
    load : PiezoLoad
        The driven load, 0 V at first.
    gain : float
        Gain in V/V.
    offset_volts : float
        Input in V at which the output is 0 V.
    settling_time : float
        Time constant of the output in s.
    volts_per_volt, amperes_per_volt : float
        Output voltage and current per volt of their monitors.
    scale_error : float
        Relative deviation of gain and voltage monitor of one instance, rms; drawn once.
    noise_volts : float
        White noise of either monitor in V rms, drawn for every conversion; zero or positive.
    rng : numpy.random.Generator
        Source of the noise and of the errors of scale.
    """

    SATURATION = 45.0
    STEP = 0.125
    STATUS = 5.0
    CAPACITANCE = 20e-9  # of the load, F, for the current

    def __init__(
        self,
        world: World,
        load: PiezoLoad,
        *,
        gain: float = 20.0,
        offset_volts: float = 0.0,
        settling_time: float = 0.2e-3,
        volts_per_volt: float = 20.0,
        amperes_per_volt: float = 0.01,
        scale_error: float = 1e-3,
        noise_volts: float = 0.2e-3,
        rng: np.random.Generator,
    ) -> None:
        self._world = world
        self._load = load
        self._gain = gain * (1 + scale_error * rng.standard_normal())
        self._offset = offset_volts
        self._time_constant = settling_time
        self._volts_per_volt = volts_per_volt * (1 + scale_error * rng.standard_normal())
        self._amperes_per_volt = amperes_per_volt
        self._noise = noise_volts
        self._normals = normals(rng)
        self._input = offset_volts
        self._saturation = self.SATURATION
        self._enabled = False
        self._tripped = False
        self._start = self._target = 0.0
        self._since = world.time

    @property
    def on(self) -> bool:
        """Whether the output follows the input."""
        return self._enabled and not self._tripped

    @property
    def voltage(self) -> float:
        """Voltage of the output in V, where the world stands."""
        elapsed = self._world.time - self._since
        return self._target + (self._start - self._target) * math.exp(-elapsed / self._time_constant)

    def drive(self, volts: float, enable: bool) -> None:
        """Apply the inputs: the set-point in V, and whether the amplifier is enabled."""
        if volts == self._input and enable == self._enabled:
            return
        self._input = volts
        self._enabled = enable
        self._tripped = self._tripped and enable
        self._follow()

    def trip(self) -> None:
        """Switch the amplifier off by its protection, until the enable input is taken away."""
        with self._world.lock:
            self._world.advance()
            self._tripped = self._enabled
            self._follow()

    def clip(self, volts: float) -> None:
        """Clip the output at ±`volts` from now on."""
        with self._world.at_present():
            self._saturation = volts
            self._follow()

    def voltage_monitor(self) -> float:
        """Return the voltage in V of the voltage monitor at this instant."""
        return self.voltage / self._volts_per_volt + self._noise * next(self._normals)

    def current_monitor(self) -> float:
        """Return the voltage in V of the current monitor at this instant."""
        amperes = self.CAPACITANCE * (self._target - self.voltage) / self._time_constant
        return amperes / self._amperes_per_volt + self._noise * next(self._normals)

    def status(self) -> float:
        """Return the voltage in V of the status output: high while the amplifier is on."""
        return self.STATUS if self.on else 0.0

    def _follow(self) -> None:
        target = self._gain * (self._input - self._offset) if self.on else 0.0
        if not -self._saturation <= target <= self._saturation:
            target = math.copysign(self._saturation, target)
        if target == self._target:
            return
        self._start = self.voltage
        self._target = target
        self._since = self._world.time
        steps = math.ceil(abs(target - self._start) / self.STEP)
        self._load.lead(self._start, target, steps, self._time_constant)
