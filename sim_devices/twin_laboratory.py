"""The emulated laboratory of a twin: its devices around the specimen that was identified."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from types import MappingProxyType
from typing import ClassVar, Protocol

import numpy as np
from pydantic import Field, InstanceOf

from bench.base import Clock, ConfigurationError
from bench.devices import DriverSettings
from bench.rig import EMULATED, LaboratorySettings
from bench.specimen import BoardTable, NoiseTable, Specimen, TwinSettings, TwinTable, rounded
from sim_devices.instruments.controller_board import ControllerBoard
from sim_devices.instruments.twin import EmulatedTwin
from sim_devices.laboratory import EmulatedLaboratory, TrueValue
from sim_devices.wire import WireServer
from sim_devices.world import World

_TOLERANCE = 0.05
"""Share by which what is set by hand may differ from what it was in the runs of the twin."""
_BLOCK = 4096
_ON_TIME = 5e-7
"""Time before which a step of the grid counts as complete, s."""


class TwinLaboratorySettings(TwinTable):
    """What `[emulation]` says of a twin."""

    devices: dict[str, InstanceOf[DriverSettings]] = Field(
        default_factory=dict, description="the devices of the rig file, which the bench fills in"
    )


class Actuated(Protocol):
    """A specimen with its actuator, as a plant."""

    @property
    def drive(self) -> float:
        """The drive, input units."""
        ...

    @property
    def response(self) -> float:
        """The response, output units."""
        ...

    def set(self, value: float) -> None:
        """Take a set-point, input units."""

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass."""


class SpecimenPlant:
    """A specimen on its grid of time, however calls divide the time; see `bench.specimen.specimen`.

    A set-point acts from the instant at which it comes, as the mean over the step of the grid in which it does. An
    actuator that follows at once has it at the end of that step.

    Parameters
    ----------
    specimen : Specimen
        The specimen at rest.
    initial : float
        Set-point at the beginning.
    """

    def __init__(self, specimen: Specimen, initial: float) -> None:
        self.specimen = specimen
        actuator = specimen.dynamics.actuator
        self._step, self._delay = specimen.dynamics.step, actuator.delay
        self._at_once = actuator.order == 0
        self._time = 0.0
        self._taken = 0
        self._level = initial
        self._coming: list[tuple[float, float]] = []

    @property
    def drive(self) -> float:
        """The drive, input units."""
        return self.specimen.drive

    @property
    def response(self) -> float:
        """The response, output units."""
        return self.specimen.response

    def set(self, value: float) -> None:
        """Take a set-point."""
        self._coming.append((self._time + self._delay, value))

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass."""
        self._time += dt
        whole = math.floor((self._time + _ON_TIME) / self._step)
        while self._taken < whole:
            count = min(whole - self._taken, _BLOCK)
            self.specimen.advance(self._setpoints(count))
            self._taken += count

    def _setpoints(self, count: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """Return the mean set-point of each of the next steps."""
        begin = self._taken * self._step
        end = begin + count * self._step
        setpoints = np.full(count, self._level)
        while self._coming and self._coming[0][0] < end:
            instant, value = self._coming.pop(0)
            place = max((instant - begin) / self._step, 0.0)
            first = int(place)
            share = 1.0 if self._at_once else 1.0 - (place - first)
            setpoints[first] += share * (value - self._level)
            setpoints[first + 1 :] = value
            self._level = value
        return setpoints


class TwinLaboratory(EmulatedLaboratory):
    """A laboratory with the devices of a rig, whose specimen behaves as was identified; see the module."""

    Settings: ClassVar[type[LaboratorySettings]] = TwinLaboratorySettings
    title: ClassVar[str] = "twin"

    def __init__(self, settings: TwinLaboratorySettings, clock: Clock, seed: int) -> None:
        specimen_stream, session_stream, reading_stream = np.random.default_rng(seed).spawn(3)
        drive, response = settings.drive, settings.response
        self._settings = settings
        self._session = settings.session_offset * float(session_stream.standard_normal())
        self._at_rest = (drive.rest - drive.offset) / drive.gain
        self.plant = self.make_specimen(settings, specimen_stream)
        world = World(self.plant, clock)
        self._outputs = dict.fromkeys(settings.devices, math.nan)
        pairs = np.array(response.conversion).reshape(-1, 2)
        self._conversion = (pairs[:, 0], pairs[:, 1]) if pairs.size else None
        twins = {name: each for name, each in settings.devices.items() if isinstance(each, TwinSettings)}
        instruments = {}
        for (name, table), rng in zip(twins.items(), reading_stream.spawn(len(twins)), strict=True):
            meters = {}
            for signal in table.signals:
                noise = settings.signals.get(signal.name, NoiseTable())
                meters[signal.name] = (self._source(signal.name, noise), noise)
            instruments[table.port.removeprefix(EMULATED)] = EmulatedTwin(
                name, world, table, meters, rng, partial(self._act, name)
            )
        servers: dict[str, WireServer] = {**instruments}
        known: dict[str, object] = {**instruments}
        if settings.board is not None:
            port, board = self._board(settings.board, world, reading_stream)
            servers[port] = known[port] = board
        super().__init__(self.title, servers, clock, world=world, instruments=MappingProxyType(known), seed=seed)

    def make_specimen(self, settings: TwinLaboratorySettings, rng: np.random.Generator) -> Actuated:
        """Return the specimen at rest."""
        specimen = Specimen(settings.operator, settings.dynamics, settings.drive.rest, rng)
        return SpecimenPlant(specimen, self._at_rest)

    def truth(self) -> dict[str, TrueValue]:
        """Return drive and response of the specimen as they are, and what the devices set."""
        units = {
            signal.name: signal.unit
            for each in self._settings.devices.values()
            if isinstance(each, TwinSettings)
            for signal in each.signals
        }
        drive, response = self._settings.drive.signal, self._settings.response.signal
        outputs = {
            f"{name}_output": TrueValue(float(not math.isnan(value)), is_output=True)
            for name, value in self._outputs.items()
        }
        return {
            drive: TrueValue(self.plant.drive, units.get(drive, "")),
            response: TrueValue(self._response(), units.get(response, "")),
            **outputs,
        }

    def operate(self, task: str, value: float) -> None:
        """Do by hand what a prompt asks for, if it was so in the runs of the twin.

        Raises ConfigurationError for another task or value: of those nothing is known.
        """
        tasks = self._settings.tasks
        if task not in tasks:
            known = ", ".join(tasks) or "none"
            raise ConfigurationError(f"the twin knows nothing of {task!r}; in its runs was done by hand: {known}")
        level = self._settings.signals[tasks[task]].level
        if abs(value - level) > _TOLERANCE * max(abs(value), abs(level)):
            raise ConfigurationError(
                f"the twin cannot tell what the specimen does at {task} = {value:g}, as its runs were made at "
                f"{level:.4g}; make a twin from runs at that value"
            )

    def _board(self, table: BoardTable, world: World, rng: np.random.Generator) -> tuple[str, ControllerBoard]:
        """Return the board that moves the drive, and the name of its port."""
        device = self._settings.devices.get(table.device)
        port = getattr(device, "port", "")
        if not port.startswith(EMULATED):
            raise ConfigurationError(f"emulation.board.device = {table.device!r}: there is no such emulated device")
        drive, response = self._settings.drive.signal, self._settings.response.signal

        def read() -> tuple[float, float]:
            values = []
            for signal in (drive, response):
                noise = self._settings.signals.get(signal, NoiseTable())
                values.append(self._source(signal, noise)() + noise.quick * float(rng.standard_normal()))
            if self._conversion is not None:
                outputs, shown = self._conversion
                values[1] = float(np.interp(values[1], shown, outputs))
            return values[0], values[1]

        return port.removeprefix(EMULATED), ControllerBoard(world, table.firmware, read, self.plant.set)

    def _act(self, device: str, value: float) -> None:
        """Take what a device sets from now on; nan for one that is off."""
        self._outputs[device] = value
        if device == self._settings.drive.device and self._settings.board is None:
            steps = self._settings.drive.resolution
            self.plant.set(self._at_rest if math.isnan(value) else rounded(value, steps))

    def _source(self, signal: str, noise: NoiseTable) -> Callable[[], float]:
        """Return what gives the true value of a signal."""
        if signal == self._settings.response.signal:
            return self._response
        if signal == self._settings.drive.signal:
            return lambda: self.plant.drive
        return partial(self._standing, noise)

    def _standing(self, noise: NoiseTable) -> float:
        value = self._outputs.get(noise.follows, math.nan)
        return noise.level if math.isnan(value) else value

    def _response(self) -> float:
        value = self.plant.response + self._session
        if self._conversion is None:
            return value
        outputs, values = self._conversion
        # Beyond the ends as between the last two.
        place = int(np.clip(np.searchsorted(outputs, value), 1, outputs.size - 1))
        slope = (values[place] - values[place - 1]) / (outputs[place] - outputs[place - 1])
        return float(values[place - 1] + slope * (value - outputs[place - 1]))
