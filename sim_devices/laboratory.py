"""Base of the emulated laboratories: the lines of their instruments, and their faults."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from bench.base import Clock, ConfigurationError, VirtualClock
from bench.rig import JOIN, LaboratorySettings, ScheduledFault
from sim_devices import protocol_emulated
from sim_devices.faults.calendar import Calendar
from sim_devices.faults.fault import Fault, FaultEvent, Quantity
from sim_devices.faults.instrument import instrument_faults
from sim_devices.faults.line import AnswerFault, Cable, FaultyLine, FaultySerial, FaultyTcpServer
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.wire import TcpServer, WireServer
from sim_devices.world import World

_HOUR = 3600.0
_STREAM = 0xFA17
"""Beside the seed, so that no plant and no instrument draws the same numbers."""


@dataclass(frozen=True)
class TrueValue:
    """One quantity of a plant or of an output, without noise and without the errors of an instrument.

    Attributes
    ----------
    value : float
        Its value at the clock's present time; 1 and 0 of a switch.
    unit : str
        Its unit; empty of a switch or a share.
    is_output : bool
        Whether an instrument sets it, so that each change of it is logged.
    behind : str
        The output that has to be on for this one to drive anything; empty if it does by itself.
    """

    value: float
    unit: str = ""
    is_output: bool = False
    behind: str = ""


def tec_faults(tec: EmulatedTEC) -> dict[str, Fault]:
    """Return the faults of a laboratory that a TEC controller protects itself from (5216G, error numbers)."""
    return {
        "tec-over-current": Fault("the TEC controller trips: error 100", partial(tec.trip, 100)),
        "tec-over-temperature": Fault("the TEC controller trips: error 138", partial(tec.trip, 138)),
    }


class EmulatedLaboratory:
    """A `bench.rig.connected.Laboratory` whose instruments are served on lines, and where nothing is done by hand.

    Parameters
    ----------
    title : str
        Its name in messages.
    servers : mapping of str to server
        The instruments by the name of their port: the wire servers of serial ones, and those on TCP.
    world : World, optional
        The time of plant and instruments.
    instruments : mapping of str to object
        The emulated instruments behind the servers, by the same names. One that has `power_cycle` can be restarted,
        one that has `freeze` and `thaw` can be frozen.
    faults : mapping of str to Fault
        What can go wrong in plant, sensors and instruments; the faults of the lines are added.
    seed : int
        Seed of the disturbed answers, and of faults at a rate that have no seed of their own.

    Attributes
    ----------
    kernels : tuple of str
        Packages of the compiled loops of its plant and instruments, see `bench.base.kernels_of`. They are ready
        when it is made: a driver must not wait for an answer while its instrument compiles.
    faults : mapping of str to Fault
        What can go wrong, by name: `FAULT`, or `INSTRUMENT.FAULT`.
    lines : mapping of str to FaultyLine
        The lines of the instruments, by the name of their port.
    events : list of FaultEvent
        The faults that have happened.
    """

    Settings: ClassVar[type[LaboratorySettings]] = LaboratorySettings
    kernels: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        title: str,
        servers: Mapping[str, WireServer | TcpServer],
        clock: Clock,
        *,
        world: World | None = None,
        instruments: Mapping[str, object] = MappingProxyType({}),
        faults: Mapping[str, Fault] = MappingProxyType({}),
        seed: int = 0,
    ) -> None:
        if self.kernels:
            # Here, as numba is slow to load.
            from bench.base import kernels_of

            for kernel in kernels_of(self.kernels):
                kernel.prepare()
        self.world = world
        self.instruments = instruments
        self.events: list[FaultEvent] = []
        self._title = title
        self._clock = clock
        self._seed = seed
        self._opened = ExitStack()
        self._calendar = Calendar()
        self._is_entered = False
        self._ends: dict[str, Callable[[], None]] = {}
        self.lines: dict[str, FaultyLine] = {}
        self._servers: dict[str, FaultySerial | FaultyTcpServer] = {}
        every = dict(faults)
        if isinstance(clock, VirtualClock):
            # Others have a time of day of their own.
            forward = Quantity(3600.0, "s", -1e9, 1e9, "by which it is set forward, or back")
            every["clock-step"] = Fault("the time of day is set", clock.set_time_of_day, {"seconds": forward})
        for number, (name, server) in enumerate(servers.items()):
            # A stream of its own for each line: a fault of one must not change what happens on another.
            rng = np.random.default_rng((seed, _STREAM, number))
            line = FaultyLine(name, server, clock, self, rng, self.end)
            self.lines[name] = line
            self._servers[name] = (
                FaultyTcpServer(server, line) if isinstance(server, TcpServer) else FaultySerial(server, line)
            )
            every |= line.faults() | instrument_faults(name, instruments.get(name), line)
        self._renumbered = self._renumberings()
        self.faults: Mapping[str, Fault] = MappingProxyType(every | self._renumbered)

    @property
    def servers(self) -> Mapping[str, WireServer | TcpServer]:
        """The instruments by the name of their port, with the faults of their lines, to be served elsewhere."""
        return MappingProxyType(self._servers)

    def open(self) -> Mapping[str, str]:
        """Switch the instruments on; return the address of each by name, its own in this process."""
        ports = {}
        for name, server in self._servers.items():
            ports[name] = protocol_emulated.register(name, server, self._clock)
            self._opened.callback(protocol_emulated.unregister, ports[name])
        return ports

    def truth(self) -> dict[str, TrueValue]:
        """Return the state of the plant and of the outputs as they are, by name; the world stands at the present."""
        return {}

    def inject(self, fault: str, values: Mapping[str, float] | None = None, duration: float | None = None) -> None:
        """Make a fault happen now.

        Parameters
        ----------
        fault : str
            Its name.
        values : mapping of str to float, optional
            What is chosen of it.
        duration : float, optional
            Laboratory time after which it ends, s; for ever if not given.

        Raises
        ------
        ConfigurationError
            If there is no such fault, or it does not take these values or a duration.
        """
        chosen = self._fault(fault).chosen(fault, values or {}, duration)
        self._present()
        self._begin(fault, chosen, duration)

    def end(self, fault: str) -> None:
        """End a fault that goes on; one that does not is left alone.

        Raises ConfigurationError if there is no such fault.
        """
        known, now = self._fault(fault), self._present()
        if fault not in self._ends:
            return
        self._ends.pop(fault)()
        values = {"disturbed": float(known.disturbed())} if isinstance(known, AnswerFault) else {}
        if known.undo is not None:
            known.undo()
        self.events.append(FaultEvent(now, fault, "ends", values))

    def mend(self, instrument: str) -> None:
        """End all faults of the line of an instrument."""
        self._present()
        own = self.lines[instrument].faults()
        shared = [each for each in self._renumbered if instrument in each.partition(".")[0].split(JOIN)]
        for fault in [each for each in self._ends if each in own or each in shared]:
            self.end(fault)

    def schedule(self, faults: Sequence[ScheduledFault]) -> None:
        """Let faults happen, their instants counted from now.

        Raises ConfigurationError if there is no such fault, or one does not take its values or its duration; none
        is scheduled then.
        """
        for number, each in enumerate(faults, 1):
            try:
                self._fault(each.fault).chosen(each.fault, each.values, each.duration)
            except ConfigurationError as error:
                raise ConfigurationError(f"fault {number} of the schedule: {error}") from None
        for line in self.lines.values():
            line.watch()
        begun = self._present()
        for number, each in enumerate(faults):
            if each.at is not None:
                self.at(begun + each.at, partial(self._happen, each))
            else:
                rng = np.random.default_rng((self._seed, _STREAM, number) if each.seed is None else each.seed)
                self._add_next(each, rng, begun, begun)

    def at(self, instant: float, act: Callable[[], None]) -> Callable[[], None]:
        """Do something at an instant (s of laboratory time), when the world stands there; return what prevents it."""
        if not self._is_entered:
            self._is_entered = True
            # Not before it is needed: the world asks for deadlines with each sample of a fast loop.
            if self.world is not None:
                self.world.add(self._calendar)
        return self._calendar.add(instant, act)

    def catch_up(self) -> None:
        """Let the faults that are due by the clock's present time happen."""
        if self.world is not None:
            if self._calendar.deadline() <= self._clock.now():
                self.world.advance()
        else:
            while self._calendar.deadline() <= self._clock.now():
                self._calendar.expire()

    def next_change(self) -> float:
        """Return the laboratory time (s) of the next fault that begins or ends; infinity if there is none."""
        return self._calendar.deadline()

    def _renumberings(self) -> dict[str, Fault]:
        """Return by `A+B.renumber` how each two serial lines that follow one another change places."""
        serial = [(name, server) for name, server in self._servers.items() if isinstance(server, FaultySerial)]
        return {
            f"{a}{JOIN}{b}.renumber": Fault(
                f"the ports of {a} and {b} are lost, and come back with each other's number",
                partial(self._exchange_ports, {a: first, b: second}),
                {"seconds": Quantity(2.0, "s", 0.0, 3600.0, "time for which both are away")},
                partial(self._exchange_ports, {a: first, b: second}, 0.0),
            )
            for (a, first), (b, second) in pairwise(serial)
        }

    def _exchange_ports(self, ports: Mapping[str, FaultySerial], seconds: float) -> None:
        """Let two ports, by name, lead to each other's instrument, after a time for which both are away, s."""
        first, second = ports.values()
        first.exchange_with(second)
        for name in ports:
            line = self.lines[name]
            line.break_off(Cable.UNPLUGGED)
            self.at(self._present() + seconds, partial(line.mend_from, Cable.UNPLUGGED))

    def _fault(self, name: str) -> Fault:
        if name not in self.faults:
            known = ", ".join(self.faults) or "none"
            raise ConfigurationError(f"the {self._title} has no fault {name!r}; it has: {known}")
        return self.faults[name]

    def _present(self) -> float:
        """Bring the world to the present and return the time, s; within what is due, that is its instant."""
        if self.world is None:
            return self._clock.now()
        self.world.catch_up()
        return self.world.time

    def _happen(self, each: ScheduledFault) -> None:
        self._begin(each.fault, self.faults[each.fault].chosen(each.fault, each.values, each.duration), each.duration)

    def _add_next(self, each: ScheduledFault, rng: np.random.Generator, begun: float, last: float) -> None:
        """Enter the next instant of a fault that comes at a rate: after a time that is distributed exponentially."""
        assert each.rate is not None
        instant = last + float(rng.exponential(_HOUR / each.rate))
        if each.until is not None and instant > begun + each.until:
            return

        def happen() -> None:
            self._happen(each)
            self._add_next(each, rng, begun, instant)

        self.at(instant, happen)

    def _begin(self, name: str, chosen: Mapping[str, float], duration: float | None) -> None:
        fault = self.faults[name]
        if name in self._ends:
            self.end(name)
        if fault.undo is not None:
            take_out = _nothing
            if duration is not None:
                take_out = self.at(self._present() + duration, partial(self.end, name))
            self._ends[name] = take_out
        if duration is not None:
            for line in self.lines.values():
                line.watch()
        self.events.append(FaultEvent(self._present(), name, "begins", chosen))
        fault.begin(**chosen)

    def operate(self, task: str, value: float) -> None:  # noqa: ARG002
        """Refuse a task.

        Raises `ConfigurationError` always.
        """
        raise ConfigurationError(f"the {self._title} cannot carry out {task!r}; nothing is done by hand there")

    def close(self) -> None:
        """Switch the instruments off; those of another laboratory stay as they are."""
        self._opened.close()


def _nothing() -> None:
    pass
