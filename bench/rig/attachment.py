"""A laboratory that another process serves by `bench rig emulate`: its endpoints file, control socket and clock."""

from __future__ import annotations

import json
import math
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, Self

from pydantic import ConfigDict, Field, ValidationError

from bench.base import (
    CheckedTable,
    Clock,
    ConfigurationError,
    DeviceConnectionError,
    ScaledClock,
    parse_json,
    problems,
)
from bench.rig.fault_schedule import ScheduledFault

_NAME = "the served laboratory"
_TIMEOUT = 30.0
"""Wall-clock time (s) for an answer of the control socket; a server under load is slow."""
_LONGEST_NAP = 0.2
"""Wall-clock time (s) that a sleep waits at once, so that an interruption is noticed soon."""


class _Table(CheckedTable):
    model_config = ConfigDict(extra="ignore")


class Endpoint(_Table):
    """Where an instrument is served."""

    port: str = Field(description="address for the client: /dev/pts/3, socket://HOST:PORT or tcp://HOST:PORT")
    protocol: str = Field(description="what is spoken there")
    devices: tuple[str, ...] = Field(description="devices of the rig file on it")


class ServedRig(_Table):
    """The instruments of one rig."""

    rig: str = Field(description="name of the rig")
    instruments: dict[str, Endpoint] = Field(description="endpoint by the name of the instrument")


class Endpoints(_Table):
    """What `bench rig emulate --json` writes; one rig stands at the top, several under `rigs`."""

    factor: float = Field(gt=0, description="laboratory seconds per wall-clock second")
    control: str = Field(description="address of the control socket: tcp://HOST:PORT or unix:PATH")
    server: str = Field(description="by which server and file recognise each other")
    rig: str | None = None
    instruments: dict[str, Endpoint] | None = None
    rigs: tuple[ServedRig, ...] = ()

    @property
    def served(self) -> dict[str, ServedRig]:
        """The rigs by name."""
        if self.rig is not None and self.instruments is not None:
            return {self.rig: ServedRig(rig=self.rig, instruments=self.instruments)}
        return {each.rig: each for each in self.rigs}


def read_endpoints(path: Path) -> Endpoints:
    """Read an endpoints file.

    Raises ConfigurationError if it cannot be read, or is not one.
    """
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ConfigurationError(f"{path} is not an endpoints file of `bench rig emulate --json`: {error}") from None
    try:
        return Endpoints.model_validate(content)
    except ValidationError as error:
        first = next(problems(error, Endpoints))
        raise ConfigurationError(f"{path} is not an endpoints file of `bench rig emulate --json`: {first}") from None


class ControlClient:
    """A connection to the control socket of `bench rig emulate`; docs/reference/emulate.md has the requests.

    Parameters
    ----------
    address : str
        `tcp://HOST:PORT` or `unix:PATH`.
    rig : str, optional
        Which rig is meant, where several are served.

    Raises
    ------
    DeviceConnectionError
        If nothing answers there.
    """

    def __init__(self, address: str, rig: str | None = None) -> None:
        self._address = address
        self._rig = {} if rig is None else {"rig": rig}
        scheme, _, rest = address.partition(":")
        try:
            if scheme == "unix":
                self._socket = socket.socket(socket.AF_UNIX)
                self._socket.settimeout(_TIMEOUT)
                self._socket.connect(rest)
            else:
                host, _, port = rest.removeprefix("//").rpartition(":")
                self._socket = socket.create_connection((host.strip("[]"), int(port)), timeout=_TIMEOUT)
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except (OSError, ValueError) as error:
            raise DeviceConnectionError(_NAME, f"nothing answers at {address}: {error}") from None
        self._answers = self._socket.makefile("rb")

    def request(self, do: str, **keys: Any) -> dict[str, Any]:  # noqa: ANN401 - anything that JSON can hold
        """Send a request and return its answer.

        Raises
        ------
        ConfigurationError
            If the server refuses it.
        DeviceConnectionError
            If the server is gone.
        """
        try:
            self._socket.sendall(json.dumps({"do": do, **keys}).encode() + b"\n")
            line = self._answers.readline()
            answer: dict[str, Any] = parse_json(line)
        except (OSError, ValueError) as error:
            raise DeviceConnectionError(_NAME, f"no longer answers at {self._address}: {error}") from None
        if "error" in answer:
            raise ConfigurationError(f"{_NAME}: {answer['error']}")
        return answer

    def time(self) -> float:
        """Return the laboratory time, s."""
        return float(self.request("time", **self._rig)["time"])

    def state(self) -> dict[str, float | None]:
        """Return the true state of plant and outputs by name; `request("state")` has the units as well."""
        return {name: each["value"] for name, each in self.request("state", **self._rig)["values"].items()}

    def advance(self, seconds: float) -> None:
        """Let laboratory time pass at once, s; only on a clock xN."""
        self.request("advance", seconds=seconds, **self._rig)

    def wait(self, until: float) -> float:
        """Wait until a laboratory time (s) has come; return the time then."""
        return float(self.request("wait", until=until, **self._rig)["time"])

    def fault(self, name: str, *, duration: float | None = None, **values: float) -> None:
        """Make a fault such as `tec.unplug` happen, for a time (s) or without an end; `values` can be chosen."""
        self.request("fault", fault=name, values=values, duration=duration, **self._rig)

    def end_fault(self, name: str) -> None:
        """End a fault that goes on."""
        self.request("end-fault", fault=name, **self._rig)

    def schedule(self, faults: Sequence[ScheduledFault]) -> None:
        """Let faults happen at instants that count from now."""
        entries = [each.model_dump(exclude_none=True) for each in faults]
        self.request("schedule", faults=entries, **self._rig)

    def events(self) -> list[dict[str, Any]]:
        """Return the faults that have happened: `time`, `fault`, `what` (begins, ends) and `values` of each."""
        return list(self.request("events", **self._rig)["events"])

    def operate(self, task: str, value: float) -> None:
        """Do by hand what a protocol's prompt asks for."""
        self.request("operate", task=task, value=value, **self._rig)

    def plug_in(self, instrument: str) -> None:
        """End all faults of the line of an instrument."""
        self.request("plug-in", instrument=instrument, **self._rig)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._answers.close()
        self._socket.close()


class AttachedClock(Clock):
    """The clock of a served laboratory, read and waited on by its control socket.

    A sleep ends when the laboratory has come so far: a server that is slowed down by a busy machine slows its client
    down as well. If the server is gone, time passes on as fast as it did, so that a run can still be ended.

    Any thread may use it.

    Parameters
    ----------
    connect : callable
        Opens a connection to the control socket; each thread has one of its own.
    """

    def __init__(self, connect: Callable[[], ControlClient], rig: str) -> None:
        super().__init__()
        self._connect = connect
        self._of_thread = threading.local()
        self._opened: list[ControlClient] = []
        answer = self._control.request("time", rig=rig)
        self.epoch = datetime.fromisoformat(answer["epoch"])
        self.factor = float(answer["factor"])
        self._last = float(answer["time"])
        self._alone: tuple[float, ScaledClock] | None = None

    def close(self) -> None:
        """Close the connections of all threads."""
        for control in self._opened:
            control.close()

    @property
    def is_alone(self) -> bool:
        """Whether the server is gone, and its instruments with it."""
        return self._alone is not None

    @property
    def _control(self) -> ControlClient:
        control: ControlClient | None = getattr(self._of_thread, "control", None)
        if control is None:
            control = self._of_thread.control = self._connect()
            self._opened.append(control)
        return control

    def now(self) -> float:
        """Return the laboratory time of the server, s."""
        if self._alone is None:
            try:
                self._last = self._control.time()
                return self._last
            except DeviceConnectionError:
                self._go_on_alone()
        return self._time_alone()

    def sleep(self, seconds: float) -> None:
        """Wait until the server's time is so much later, s; ends early when `interrupted`.

        Raises `ValueError` if `seconds` is not finite.
        """
        if not math.isfinite(seconds):
            raise ValueError(f"seconds: expected a finite number, got {seconds}")
        self._wait_until(self.now() + seconds)

    def sleep_until(self, instant: float) -> None:
        """Wait until the server's time is `instant`, s; ends early when `interrupted`.

        The server is not asked for the time before: it is no earlier than it was last.

        Raises `ValueError` if the instant is not finite.
        """
        if not math.isfinite(instant):
            raise ValueError(f"instant: expected a finite number, got {instant}")
        self._wait_until(instant)

    def _wait_until(self, end: float) -> None:
        while (now := self._last) < end and not self.interrupted():
            until = min(end, now + _LONGEST_NAP * self.factor)
            if self._alone is None:
                try:
                    self._last = self._control.wait(until)
                    continue
                except DeviceConnectionError:
                    self._go_on_alone()
            self._alone_clock().sleep(until - now)
            self._last = self._time_alone()

    def _go_on_alone(self) -> None:
        self._alone = (self._last, ScaledClock(self.factor))

    def _alone_clock(self) -> ScaledClock:
        assert self._alone is not None
        return self._alone[1]

    def _time_alone(self) -> float:
        assert self._alone is not None
        begin, clock = self._alone
        return begin + clock.now()


@dataclass(frozen=True)
class Attachment:
    """A rig file's way to a served laboratory; a `bench.rig.file.Laboratory`.

    Attributes
    ----------
    clock : AttachedClock
        The clock of the laboratory.
    """

    clock: AttachedClock
    _control: ControlClient
    _ports: Mapping[str, str]
    _opened: ExitStack

    def open(self) -> Mapping[str, str]:
        """Return the port of each instrument by name."""
        return self._ports

    def operate(self, task: str, value: float) -> None:
        """Do by hand what a protocol's prompt asks for.

        Raises ConfigurationError if the laboratory cannot.
        """
        self._control.operate(task, value)

    def schedule(self, faults: Sequence[ScheduledFault]) -> None:
        """Let faults happen in the served laboratory; `bench.rig.fault_schedule.FaultyLaboratory`."""
        self._control.schedule(faults)

    def close(self) -> None:
        """Leave the laboratory; it goes on."""
        self._opened.close()


def attach(path: Path, rig: str) -> Attachment:
    """Connect to the laboratory of a rig that is served.

    Parameters
    ----------
    path : Path
        Endpoints file of `bench rig emulate --json`.
    rig : str
        Name of the rig.

    Raises
    ------
    ConfigurationError
        If the file is not one, serves other rigs, or its server is gone.
    """
    endpoints = read_endpoints(path)
    if rig not in endpoints.served:
        raise ConfigurationError(f"{path} serves {', '.join(endpoints.served) or 'no rig'}, not {rig}")
    with ExitStack() as opened:
        try:
            control = ControlClient(endpoints.control, rig)
            opened.callback(control.close)
            server = control.request("time", rig=rig)["server"]
            clock = AttachedClock(partial(ControlClient, endpoints.control, rig), rig)
            opened.callback(clock.close)
        except (DeviceConnectionError, KeyError):
            server = None
        if server != endpoints.server:
            raise ConfigurationError(
                f"{path} is out of date: its server does not answer at {endpoints.control}; "
                "start bench rig emulate again"
            )
        ports = {name: endpoint.port for name, endpoint in endpoints.served[rig].instruments.items()}
        return Attachment(clock, control, ports, opened.pop_all())
