"""A device of a twin: it measures signals of the laboratory with noise, and takes a set-point if it has one."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from bench.devices import Identity, Signal
from bench.specimen import (
    DONE,
    END,
    GLANCE,
    IDENTITY,
    MEASURE,
    OFF,
    OUTPUT,
    REFUSED,
    SET,
    NoiseTable,
    TwinSettings,
    number_text,
    rounded,
)
from sim_devices.instruments.emulated import EmulatedInstrument
from sim_devices.wire.text import AttendedLine
from sim_devices.world import World


class EmulatedTwin(EmulatedInstrument, AttendedLine):
    """A device of a twin, which serves its own line: a request and an answer a line of text.

    Parameters
    ----------
    settings : TwinSettings
        Its signals and its set-point.
    meters : mapping of str to (callable, NoiseTable)
        By signal: what gives its true value, and how it is read.
    act : callable
        Takes what its output delivers from now on; nan when it is off.
    """

    end = END

    def __init__(
        self,
        name: str,
        world: World,
        settings: TwinSettings,
        meters: Mapping[str, tuple[Callable[[], float], NoiseTable]],
        rng: np.random.Generator,
        act: Callable[[float], None],
    ) -> None:
        super().__init__(name, world, rng)
        self._settings = settings
        self._meters = dict(meters)
        self._act = act
        self._identity = Identity("bench", "twin", name, "emulated")
        self._output = math.nan

    @property
    def signals(self) -> tuple[Signal, ...]:
        """What it measures."""
        return tuple(each.signal for each in self._settings.signals)

    def measure(self) -> dict[str, float]:
        """Take a reading; values by signal name."""
        with self._request():
            return {name: self._read(name, quick=False) for name in self._meters}

    def safe(self) -> None:
        """Switch the output off."""
        with self._request():
            self._switch(math.nan)

    def power_cycle(self) -> None:
        """Switch the device off and on: its output is off."""
        with self.world.at_present():
            self._switch(math.nan)

    def answer(self, message: str) -> str:
        """Carry a request out; return the answer."""
        request = message.strip()
        if request in (MEASURE, GLANCE):
            return " ".join(number_text(self._read(name, quick=request == GLANCE)) for name in self._meters)
        if request == IDENTITY:
            identity = self._identity
            return ",".join((identity.maker, identity.model, identity.serial_number, identity.firmware))
        if self._settings.setpoint is not None:
            if request == OUTPUT:
                return repr(self._output)
            if request == OFF:
                self._switch(math.nan)
                return DONE
            word, _, number = request.partition(" ")
            low, high = self._settings.setpoint.limits
            try:
                if word == SET and low <= float(number) <= high:
                    self._switch(float(number))
                    return DONE
            except ValueError:
                return REFUSED
        return REFUSED

    def _switch(self, output: float) -> None:
        self._output = output
        self._act(output)

    def _read(self, name: str, *, quick: bool) -> float:
        true, noise = self._meters[name]
        return rounded(true() + self._draw(noise.quick if quick else noise.reading), noise.resolution)
