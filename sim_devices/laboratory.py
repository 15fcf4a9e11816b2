"""Base of the emulated laboratories: the lines of their instruments, and events at a given time."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from types import MappingProxyType
from typing import TypeVar

from bench.clock import Clock
from bench.errors import ConfigurationError
from sim_devices import protocol_emulated
from sim_devices.wire import WireServer
from sim_devices.wire.modbus_tcp import ModbusTcpInstrument

T = TypeVar("T")


class EmulatedLaboratory:
    """A `bench.rig.Laboratory` whose instruments are served on lines, and where nothing is done by hand.

    Parameters
    ----------
    title : str
        Its name in messages.
    servers : mapping of str to server
        The instruments by the name of their port: the wire servers of serial ones, and those on TCP.
    """

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
