"""One served laboratory: its clock, its plant and the lines of its instruments."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

from bench.base import ConfigurationError
from bench.rig import EMULATED, JOIN, RigFile
from sim_devices.faults.line import Cable
from sim_devices.laboratory import EmulatedLaboratory, TrueValue
from sim_devices.serving.clock import LONGEST_STEP, ServedClock
from sim_devices.serving.endpoints import HAS_PSEUDO_TERMINALS, Listener, PseudoTerminal
from sim_devices.serving.lines import Line, Watched
from sim_devices.wire import TcpServer, WireServer
from sim_devices.wire.shared import joined


@dataclass(frozen=True)
class Serving:
    """How instruments are served.

    Attributes
    ----------
    host : str
        Address of this machine on which TCP ports listen.
    tcp : bool
        Whether serial instruments are on TCP ports as well, as raw bytes; always so where there are no
        pseudo-terminals.
    ports : mapping of str to int
        TCP ports by `RIG.NAME` of an instrument; the system chooses the others.
    baud_time : bool
        Whether bytes on serial lines take the time of the line's speed.
    """

    host: str
    tcp: bool
    ports: Mapping[str, int]
    baud_time: bool


class ServedLaboratory:
    """The laboratory of a rig and the lines that lead to its instruments.

    Parameters
    ----------
    file : RigFile
        The rig.
    laboratory : EmulatedLaboratory
        Its laboratory, on `clock`; nothing of it is open.
    clock : ServedClock
        Its clock.

    Raises
    ------
    ConfigurationError
        If a port is taken.
    """

    def __init__(self, file: RigFile, laboratory: EmulatedLaboratory, clock: ServedClock, serving: Serving) -> None:
        self.name = file.name
        self.laboratory = laboratory
        self.clock = clock
        servers = servers_by_line(file, laboratory)
        self._devices = {
            name: [entry.name for entry in file.devices if getattr(entry.settings, "port", "") == EMULATED + name]
            for name in servers
        }
        speeds = {
            getattr(entry.settings, "port", ""): float(speed)
            for entry in file.devices
            if (speed := getattr(entry.settings, "baudrate", None)) is not None
        }
        self.lines: dict[str, Line] = {}
        self._protocols: dict[str, str] = {}
        with ExitStack() as opened:
            for name, server in servers.items():
                speed = speeds.get(EMULATED + name, math.inf) if serving.baud_time else math.inf
                self.lines[name] = self._open(name, server, speed, serving)
                opened.callback(self.lines[name].close)
            self._opened = opened.pop_all()

    def warm_up(self) -> None:
        """Let 0.1 s pass, so that everything compiled is loaded before the first client waits for an answer."""
        self.skip(LONGEST_STEP)
        self.truth()

    def close(self) -> None:
        """Close every line."""
        self._opened.close()

    def endpoints(self) -> dict[str, dict[str, Any]]:
        """Return where each instrument is, by name: `port`, `protocol` and the `devices` of the rig on it."""
        return {
            name: {"port": line.address, "protocol": self._protocols[name], "devices": self._devices[name]}
            for name, line in self.lines.items()
        }

    def serve(self, ready: Collection[Watched]) -> None:
        """Bring clock and plant on, and serve each line once; never waits."""
        self.clock.follow()
        self._advance()
        for line in self.lines.values():
            line.serve(ready)

    def skip(self, seconds: float) -> None:
        """Let laboratory time pass without the wall clock, in steps, s."""
        end = self.clock.paced + seconds
        while (left := end - self.clock.paced) > LONGEST_STEP:
            self.clock.skip(LONGEST_STEP)
            self._advance()
        self.clock.skip(max(left, 0.0))
        self._advance()

    def seconds_until_due(self) -> float:
        """Return the wall-clock time (s) until something has to be done, or the clock should follow."""
        due = min((line.next_due() for line in self.lines.values()), default=math.inf)
        return max(min(due - self.clock.paced, 0.5 * LONGEST_STEP), 0.0) / self.clock.factor

    def truth(self) -> dict[str, TrueValue]:
        """Return the true state at the clock's present time."""
        self._advance()
        return self.laboratory.truth()

    def _advance(self) -> None:
        if self.laboratory.world is not None:
            self.laboratory.world.advance()

    def _open(self, name: str, server: WireServer | TcpServer, speed: float, serving: Serving) -> Line:
        port = serving.ports.get(f"{self.name}.{name}")
        self._protocols[name] = server.protocol
        on_tcp = not isinstance(server, WireServer) or serving.tcp or not HAS_PSEUDO_TERMINALS or port is not None
        try:
            end = Listener((serving.host, port or 0)) if on_tcp else PseudoTerminal()
        except OSError as error:
            where = f"port {port} of {serving.host}" if port else serving.host if on_tcp else "a pseudo-terminal"
            raise ConfigurationError(f"{self.name}: {name} cannot be served at {where}: {error.strerror}") from None
        faults = self.laboratory.lines.get(name)
        return Line(name, server, end, self.clock, speed, lambda: faults is not None and faults.cable is Cable.CUT)


def servers_by_line(file: RigFile, laboratory: EmulatedLaboratory) -> dict[str, WireServer | TcpServer]:
    """Return what is at the end of each line of a rig; instruments that share one are at `a+b` only.

    Raises ConfigurationError if an instrument of a shared line is not there, or has no serial line.
    """
    servers = dict(laboratory.servers)
    ports = dict.fromkeys(str(getattr(entry.settings, "port", "")) for entry in file.devices)
    shared = [port.removeprefix(EMULATED) for port in ports if port.startswith(EMULATED) and JOIN in port]
    for name in shared:
        try:
            servers[name] = joined(name, laboratory.servers)
        except ValueError as error:
            raise ConfigurationError(f"{file.path}: {error}") from None
        for each in name.split(JOIN):
            servers.pop(each, None)
    return servers


def one_of(laboratories: Sequence[ServedLaboratory], rig: str | None) -> ServedLaboratory:
    """Return the laboratory of a rig, or the only one.

    Raises ConfigurationError if there is no such rig, or none is named and there are several.
    """
    known = ", ".join(each.name for each in laboratories)
    if rig is None:
        if len(laboratories) > 1:
            raise ConfigurationError(f"rig is missing; there are: {known}")
        return laboratories[0]
    for each in laboratories:
        if each.name == rig:
            return each
    raise ConfigurationError(f"rig {rig!r} is not served; there are: {known}")
