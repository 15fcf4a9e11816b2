"""Base of the emulated laboratories: the lines of their instruments, and events at a given time."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import TypeVar

from bench.clock import Clock
from bench.errors import ConfigurationError
from sim_devices import protocol_emulated
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.wire import WireServer
from sim_devices.wire.modbus_tcp import ModbusTcpInstrument
from sim_devices.world import World

T = TypeVar("T")


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
    """

    value: float
    unit: str = ""
    is_output: bool = False


@dataclass(frozen=True)
class Fault:
    """Something that can go wrong at any time.

    Attributes
    ----------
    summary : str
        What happens, in one line.
    inject : callable
        Make it happen; takes `values` by name.
    values : mapping of str to float
        What can be chosen, with its defaults, in the units that the summary says.
    """

    summary: str
    inject: Callable[..., None]
    values: Mapping[str, float] = field(default_factory=dict)


def tec_faults(tec: EmulatedTEC) -> dict[str, Fault]:
    """Return the faults of a laboratory that a TEC controller protects itself from (5216G, error numbers)."""
    return {
        "tec-over-current": Fault("the TEC controller trips: error 100", partial(tec.trip, 100)),
        "tec-over-temperature": Fault("the TEC controller trips: error 138", partial(tec.trip, 138)),
    }


class EmulatedLaboratory:
    """A `bench.rig.Laboratory` whose instruments are served on lines, and where nothing is done by hand.

    Parameters
    ----------
    title : str
        Its name in messages.
    servers : mapping of str to server
        The instruments by the name of their port: the wire servers of serial ones, and those on TCP.

    Attributes
    ----------
    world : World or None
        The time of plant and instruments; None if there is no plant.
    instruments : mapping of str to object
        The emulated instruments behind the servers, by the same names; one that has `power_cycle` can be restarted.
    faults : mapping of str to Fault
        What can go wrong, by name.
    """

    world: World | None = None
    instruments: Mapping[str, object] = MappingProxyType({})
    faults: Mapping[str, Fault] = MappingProxyType({})

    def __init__(self, title: str, servers: Mapping[str, WireServer | ModbusTcpInstrument], clock: Clock) -> None:
        self._title = title
        self._servers = servers
        self._clock = clock
        self._opened = ExitStack()

    @property
    def servers(self) -> Mapping[str, WireServer | ModbusTcpInstrument]:
        """The instruments by the name of their port, to be served elsewhere."""
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

    def inject(self, fault: str, values: Mapping[str, float] | None = None) -> None:
        """Make a fault happen.

        Raises ConfigurationError if there is no such fault, or it does not take these values.
        """
        if fault not in self.faults:
            known = ", ".join(self.faults) or "none"
            raise ConfigurationError(f"the {self._title} has no fault {fault!r}; it has: {known}")
        known_values = self.faults[fault].values
        for name in values or {}:
            if name not in known_values:
                raise ConfigurationError(
                    f"fault {fault} takes no value {name!r}; it takes: {', '.join(known_values) or 'none'}"
                )
        if self.world is not None:
            self.world.advance()
        self.faults[fault].inject(**{**known_values, **(values or {})})

    def operate(self, task: str, value: float) -> None:  # noqa: ARG002
        """Refuse a task.

        Raises `ConfigurationError` always.
        """
        raise ConfigurationError(f"the {self._title} cannot carry out {task!r}; nothing is done by hand there")

    def close(self) -> None:
        """Switch the instruments off; those of another laboratory stay as they are."""
        self._opened.close()


def compile_loops(plant: T, use: Callable[[T], object]) -> None:
    """Use a copy of a plant once, so that its compiled loops are ready before a driver waits for an answer.

    `use` does all that the instruments do with it, and advances it by a step of its grid at least.
    """
    use(copy.deepcopy(plant))


class Event:
    """Something that happens once, at its time (s); a `Timed` part of the world."""

    def __init__(self, instant: float, happen: Callable[[], None]) -> None:
        self._due = instant
        self._happen = happen

    def deadline(self) -> float:
        """Return when it is due, s; inf once it has happened."""
        return self._due

    def expire(self) -> None:
        """Make it happen."""
        self._due = math.inf
        self._happen()
