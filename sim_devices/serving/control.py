"""The control socket: JSON lines by which another process looks into served laboratories and disturbs them."""

from __future__ import annotations

import math
import selectors
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from bench.base import ConfigurationError, json_text
from sim_devices.laboratory import TrueValue
from sim_devices.serving import requests
from sim_devices.serving.endpoints import Connection, Listener, socket_address
from sim_devices.serving.lines import Watched
from sim_devices.serving.served import ServedLaboratory, one_of

_LONGEST_LINE = 65_536
_MOST_UNREAD = 1_048_576
_MOST_CONNECTIONS = 32


@dataclass
class _Client:
    connection: Connection
    received: bytearray = field(default_factory=bytearray)
    unread: bytearray = field(default_factory=bytearray)
    waits: tuple[ServedLaboratory, float] | None = None
    is_over: bool = False
    ends_server: bool = False

    @property
    def takes_bytes(self) -> bool:
        """Whether there is room for more requests; one that does not read its answers is not asked for any."""
        return len(self.unread) < _MOST_UNREAD and len(self.received) <= _LONGEST_LINE


class ControlSocket:
    """Serves the requests of `sim_devices.serving.requests`; never waits.

    Parameters
    ----------
    listener : Listener
        Where clients come in.
    laboratories : sequence of ServedLaboratory
        What they look into.
    identity : str
        By which an endpoints file and this server recognise each other.

    Attributes
    ----------
    stop_requested : bool
        Whether the server has to end.
    """

    def __init__(self, listener: Listener, laboratories: Sequence[ServedLaboratory], identity: str) -> None:
        self.stop_requested = False
        self._listener = listener
        self._laboratories = laboratories
        self._identity = identity
        self._clients: list[_Client] = []

    @property
    def address(self) -> str:
        """Where clients connect."""
        return socket_address("tcp", self._listener.address)

    def watched(self) -> Iterator[tuple[Watched, int]]:
        """Yield what to wait on, and for what."""
        yield self._listener, selectors.EVENT_READ
        for client in self._clients:
            wanted = selectors.EVENT_READ * client.takes_bytes | selectors.EVENT_WRITE * bool(client.unread)
            if wanted:
                yield client.connection, wanted

    def seconds_until_due(self) -> float:
        """Return the wall-clock time (s) until a client that waits has to be answered; infinity if none does."""
        waits = [client.waits for client in self._clients if client.waits is not None]
        return min(
            (max(until - each.clock.paced, 0.0) / each.clock.factor for each, until in waits), default=math.inf
        )

    def serve(self, ready: Collection[Watched]) -> None:
        """Answer what has arrived."""
        for client in self._clients:
            if client.connection in ready and client.takes_bytes:
                self._read(client)
            self._serve(client)
            self._write(client)
        for client in [client for client in self._clients if client.is_over]:
            self._clients.remove(client)
            client.connection.close()
            self.stop_requested |= client.ends_server
        if self._listener in ready and (accepted := self._listener.accept()) is not None:
            if len(self._clients) < _MOST_CONNECTIONS:
                self._clients.append(_Client(accepted))
            else:
                accepted.reset()

    def close(self) -> None:
        """Close every connection and stop listening."""
        for client in self._clients:
            self._write(client)
            client.connection.close()
        self._clients.clear()
        self._listener.close()

    @staticmethod
    def _read(client: _Client) -> None:
        data = client.connection.read()
        if data == b"":
            client.is_over = True
        client.received += data or b""

    def _serve(self, client: _Client) -> None:
        while not client.is_over and not self.stop_requested:
            if client.waits is not None:
                laboratory, until = client.waits
                if laboratory.clock.paced < until:
                    return
                client.waits = None
                self._answer(client, self._time(laboratory))
            end = client.received.find(b"\n")
            if end < 0:
                if len(client.received) > _LONGEST_LINE:
                    self._answer(client, {"error": f"a line is too long; allowed are {_LONGEST_LINE} bytes"})
                    self._write(client)
                    client.is_over = True
                return
            line = bytes(client.received[:end])
            del client.received[: end + 1]
            if line.strip():
                self._obey(client, line)

    def _obey(self, client: _Client, line: bytes) -> None:
        try:
            request = requests.parse_request(line)
            if isinstance(request, requests.Wait):
                client.waits = one_of(self._laboratories, request.rig), request.until
                return
            if isinstance(request, requests.EndWithConnection):
                client.ends_server = True
            answer = self._carry_out(request)
        except ConfigurationError as error:
            answer = {"error": str(error)}
        self._answer(client, answer)

    @staticmethod
    def _answer(client: _Client, content: Mapping[str, Any]) -> None:
        client.unread += json_text(content).encode() + b"\n"

    @staticmethod
    def _write(client: _Client) -> None:
        if not client.unread:
            return
        try:
            del client.unread[: client.connection.write(bytes(client.unread))]
        except OSError:
            client.is_over = True

    def _carry_out(self, request: requests.Request) -> dict[str, Any]:
        if isinstance(request, requests.RigRequest):
            return self._of_rig(request, one_of(self._laboratories, request.rig))
        if isinstance(request, requests.Help):
            return self._help()
        if isinstance(request, requests.Stop):
            self.stop_requested = True
        return {}

    def _of_rig(self, request: requests.RigRequest, served: ServedLaboratory) -> dict[str, Any]:
        match request:
            case requests.State():
                return {"time": served.clock.now(), "values": values_to_json(served.truth())}
            case requests.Time():
                return self._time(served)
            case requests.Advance(seconds=seconds):
                if not served.clock.may_skip:
                    raise ConfigurationError("advance: the clock is the wall's; serve with --clock x1, or another xN")
                served.skip(seconds)
                return self._time(served)
            case requests.InjectFault(fault=fault, values=values, duration=duration):
                served.laboratory.inject(fault, values, duration)
            case requests.EndFault(fault=fault):
                served.laboratory.end(fault)
            case requests.Schedule(faults=faults):
                served.laboratory.schedule(faults)
            case requests.Events(since=since):
                events = [event.to_json() for event in served.laboratory.events[since:]]
                return {"time": served.clock.now(), "events": events}
            case requests.Operate(task=task, value=value):
                served.laboratory.operate(task, value)
            case requests.PlugIn(instrument=instrument):
                if instrument not in served.laboratory.lines:
                    known = ", ".join(served.laboratory.lines)
                    raise ConfigurationError(f"rig {served.name} has no instrument {instrument!r}; it has: {known}")
                served.laboratory.mend(instrument)
        return {"time": served.clock.now()}

    def _time(self, served: ServedLaboratory) -> dict[str, Any]:
        clock = served.clock
        return {
            "time": clock.now(),
            "factor": clock.factor,
            "factor_reached": clock.factor_reached,
            "epoch": clock.epoch.isoformat(),
            "server": self._identity,
        }

    def _help(self) -> dict[str, Any]:
        return {
            "requests": {
                name: {
                    "does": " ".join(str(each.__doc__).split()),
                    "keys": {key: value.description for key, value in each.model_fields.items()},
                }
                for name, each in requests.REQUESTS.items()
            },
            "rigs": {
                served.name: {
                    "instruments": [*served.laboratory.lines],
                    "faults": {name: fault.to_json() for name, fault in served.laboratory.faults.items()},
                }
                for served in self._laboratories
            },
        }


def values_to_json(values: Mapping[str, TrueValue]) -> dict[str, dict[str, Any]]:
    """Return true values for JSON; what is no finite number becomes null."""
    return {
        name: {
            "value": float(each.value) if math.isfinite(each.value) else None,
            "unit": each.unit,
            "is_output": each.is_output,
        }
        for name, each in values.items()
    }
