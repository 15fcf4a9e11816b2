"""The faults of a line: what becomes of the bytes between the wire server of an instrument and its clients.

A faulty server stands in the place of the instrument's own, in process and where it is served to other processes.
What is late is sent later as if by itself, so that both kinds of transport deliver it at its instant of laboratory
time. Bytes keep their order: what follows a late answer is at least as late.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import partial
from typing import ClassVar, Protocol

import numpy as np

from bench.base import Clock
from sim_devices.faults.fault import Fault, Quantity
from sim_devices.wire import Answering, Connection, Stream, TcpServer, WireServer

_MOST_QUEUED = 4096  # bytes that a hanging instrument takes; a real one has a buffer, too


class Cable(Enum):
    """The state of a line."""

    WHOLE = "whole"
    UNPLUGGED = "unplugged"
    """What is sent either way is lost; connections stay, as with a cable that was pulled."""
    CUTTING = "cut at the next answer"
    CUT = "cut"
    """As unplugged; TCP connections are ended, and new ones refused."""
    HANGING = "hanging"
    """Nothing is served; what was asked is answered, late, once the line is whole again."""


_DEAD = (Cable.UNPLUGGED, Cable.CUT)


class Schedule(Protocol):
    """What a line has to know of the faults that are still to come."""

    def catch_up(self) -> None:
        """Let what is due by the clock's present time happen."""

    def next_change(self) -> float:
        """Return the laboratory time (s) of the next fault that begins or ends; infinity if there is none."""


@dataclass
class _Disturbance:
    """What happens to some of the answers."""

    seconds: float
    probability: float
    left: float
    done: int = 0


DROP, CORRUPT, READDRESS, DOUBLE, DELAY = "drop", "corrupt", "readdress", "double", "delay"
HALVE, GARBAGE, COMMA, SECOND_CLIENT, ECHO = "halve", "garbage", "comma", "second-client", "echo"

_SUMMARIES = {
    DROP: "answers of {} are lost; it has acted all the same",
    CORRUPT: "a bit of answers of {} is wrong; it has acted all the same",
    READDRESS: "answers of {} come as from another address",
    DOUBLE: "answers of {} come twice",
    DELAY: "answers of {} come late",
    HALVE: "answers of {} come in two pieces",
    GARBAGE: "random bytes come before answers of {}",
    COMMA: "answers of {} have a comma in the place of each decimal point",
    ECHO: "the adapter of {} hands back what is sent before the answer",
    SECOND_CLIENT: "another program uses the line of {}: an answer to it comes first, or in the place of one",
}
_MOST_GARBAGE = 8  # bytes
_COUNT = Quantity(0, "", 0, 1e9, "number of answers; 0 for all of the duration, or one where there is none")
_PROBABILITY = Quantity(1.0, "", 1e-6, 1.0, "probability with which an answer is disturbed")
_SECONDS = {
    DELAY: Quantity(0.25, "s", 0.0, 3600.0, "time by which an answer is late"),
    HALVE: Quantity(0.02, "s", 0.0, 3600.0, "time between the two pieces"),
}


@dataclass(frozen=True, kw_only=True)
class AnswerFault(Fault):
    """A disturbance of answers.

    Attributes
    ----------
    disturbed : callable
        Returns how many answers it has met so far.
    """

    disturbed: Callable[[], int]

    def chosen(self, name: str, values: Mapping[str, float], duration: float | None) -> dict[str, float]:
        """Return the values with which it begins; one answer where there is no count, probability or duration."""
        chosen = super().chosen(name, values, duration)
        if duration is None and not chosen["count"] and chosen["probability"] == 1.0:
            chosen["count"] = 1.0
        return chosen


class FaultyLine:
    """The line of one instrument, over all its connections.

    Parameters
    ----------
    name : str
        Name of the instrument.
    server : Answering
        Its server, for what depends on the protocol.
    schedule : Schedule
        The faults that are still to come.
    rng : numpy.random.Generator
        Which answers are disturbed, and how.
    ended : callable
        Called with the name of a disturbance of answers when it has reached its count, to end it.

    Attributes
    ----------
    cable : Cable
        The state of the line.
    is_watched : bool
        Whether anything is, or will be, wrong: until then bytes pass as they are.
    server : Answering
        The server at its end.
    streams : list of FaultyStream
        The serial line, or the connections that are open.
    """

    def __init__(
        self,
        name: str,
        server: Answering,
        clock: Clock,
        schedule: Schedule,
        rng: np.random.Generator,
        ended: Callable[[str], None],
    ) -> None:
        self.cable = Cable.WHOLE
        self.clock = clock
        self.schedule = schedule
        self.is_watched = False
        self._name = name
        self.server = server
        self._rng = rng
        self._ended = ended
        self._disturbances: dict[str, _Disturbance] = {}
        self._former = b""
        """Answer before the last one."""
        self._last = b""
        self.streams: list[FaultyStream] = []

    def faults(self) -> dict[str, Fault]:
        """Return what can go wrong on the line, by `INSTRUMENT.FAULT`."""
        name = self._name
        states = {
            "unplug": (Cable.UNPLUGGED, "what is sent to {} and by it is lost; it keeps working"),
            "cut": (Cable.CUTTING, "the next answer of {} ends in its middle, and the line is dead; TCP is reset"),
            "hang": (Cable.HANGING, "{} serves nothing; what it was asked it answers late, at the end"),
        }
        found = {
            f"{name}.{kind}": Fault(
                summary.format(name), partial(self.break_off, cable), undo=partial(self.mend_from, cable)
            )
            for kind, (cable, summary) in states.items()
        }
        for kind, summary in _SUMMARIES.items():
            if not self._is_possible(kind):
                continue
            values = {"count": _COUNT, "probability": _PROBABILITY}
            if kind in _SECONDS:
                values["seconds"] = _SECONDS[kind]
            found[f"{name}.{kind}"] = AnswerFault(
                summary=summary.format(name),
                begin=partial(self.disturb, kind),
                values=values,
                undo=partial(self.leave_alone, kind),
                disturbed=partial(self.disturbed, kind),
                # A line of text has no check sum, and does not say which question it answers.
                lies=kind in (CORRUPT, SECOND_CLIENT) and self.server.is_text,
            )
        return found

    def _is_possible(self, kind: str) -> bool:
        if kind in (GARBAGE, SECOND_CLIENT, ECHO):
            # TCP has a check of its own, and a connection for each client.
            return not isinstance(self.server, TcpServer)
        return {READDRESS: self.server.has_addresses, COMMA: self.server.is_text}.get(kind, True)

    def watch(self) -> None:
        """Look at all bytes from now on."""
        self.is_watched = True
        for stream in self.streams:
            stream.step_between()

    def break_off(self, cable: Cable) -> None:
        """Bring the line into another state; what is on its way is lost unless it only hangs."""
        self.watch()
        self.cable = cable
        if cable in _DEAD:
            self._lose(ends=cable is Cable.CUT)

    def mend(self) -> None:
        """Make the line whole; answers that a hanging one owes are given now."""
        self.cable = Cable.WHOLE

    def mend_from(self, cable: Cable) -> None:
        """Make the line whole if it is in this state; it may be in another one that began later."""
        if self.cable is cable or (cable is Cable.CUTTING and self.cable is Cable.CUT):
            self.mend()

    def disturb(self, kind: str, count: float, probability: float, seconds: float = 0.0) -> None:
        """Disturb answers: `count` of them (0 for no limit), each with a probability."""
        self.watch()
        self._disturbances[kind] = _Disturbance(seconds, probability, count or math.inf)

    def leave_alone(self, kind: str) -> None:
        """End a disturbance."""
        self._disturbances.pop(kind, None)

    def disturbed(self, kind: str) -> int:
        """Return how many answers a disturbance has met so far."""
        return self._disturbances[kind].done if kind in self._disturbances else 0

    def restart(self) -> None:
        """Lose what is on its way, and connections on TCP: the instrument has lost its power."""
        self._lose(ends=True)
        self.watch()

    def _lose(self, *, ends: bool) -> None:
        for stream in [*self.streams]:
            stream.lose()
            if ends and isinstance(stream, FaultyConnection):
                stream.close()

    def send(self, request: bytes, answer: bytes) -> list[tuple[float, bytes]]:
        """Return what the client gets of the answer to a request: pieces, each with its delay, s."""
        if self.cable in _DEAD:
            return []
        begin = self.server.answer_begins(answer)
        adapter, answer = answer[:begin], answer[begin:]
        sent = [(0.0, adapter)] if adapter else []
        if not answer:
            return sent
        if self.cable is Cable.CUTTING:
            self.cable = Cable.CUT
            return [*sent, (0.0, answer[: len(answer) // 2])]
        hit = [(kind, seconds) for kind in _SUMMARIES if (seconds := self._meets(kind)) is not None]
        kinds = dict(hit)
        self._former, self._last = self._last, answer
        if ECHO in kinds:
            sent.insert(0, (0.0, request))
        if DROP in kinds:
            return sent
        before = b""
        if GARBAGE in kinds:
            before = self._rng.bytes(int(self._rng.integers(1, _MOST_GARBAGE + 1)))
        if SECOND_CLIENT in kinds:
            before += self._former
            if self._rng.random() < 0.5:
                return [*sent, (0.0, before)]
        if COMMA in kinds:
            answer = answer.replace(b".", b",")
        if READDRESS in kinds:
            answer = self.server.readdressed(answer)
        if CORRUPT in kinds:
            answer = self.server.corrupted(answer, self._rng)
        delay, answer = kinds.get(DELAY, 0.0), before + answer
        pieces = [(delay, answer)]
        if HALVE in kinds:
            half = len(answer) // 2
            pieces = [(delay, answer[:half]), (delay + kinds[HALVE], answer[half:])]
        return sent + pieces * (2 if DOUBLE in kinds else 1)

    def _meets(self, kind: str) -> float | None:
        """Return the seconds of a disturbance that meets this answer, None if it does not."""
        each = self._disturbances.get(kind)
        if each is None or (each.probability < 1.0 and self._rng.random() >= each.probability):
            return None
        each.done += 1
        each.left -= 1
        if each.left <= 0:
            self._ended(f"{self._name}.{kind}")
        return each.seconds


class FaultyStream:
    """A serial line, or one connection on TCP, with the faults of its line.

    Parameters
    ----------
    stream : Stream
        The instrument's end.
    """

    _PASSED: ClassVar[tuple[str, ...]] = ("receive", "unsolicited", "next_unsolicited")

    def __init__(self, stream: Stream, line: FaultyLine) -> None:
        self._inner = stream
        self._line = line
        self._asked = b""
        self._leaving: deque[tuple[float, bytes]] = deque()
        if not line.is_watched:
            self._step_aside()

    def _step_aside(self) -> None:
        """Let bytes pass without a look at them: what is called is the instrument's own."""
        vars(self).update({name: getattr(self._inner, name) for name in self._PASSED})

    def step_between(self) -> None:
        """Undo `_step_aside`; may be called again."""
        for name in self._PASSED:
            vars(self).pop(name, None)

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the client, in pieces of any size; return what it gets at once.

        Raises what the instrument's end raises.
        """
        line = self._line
        line.schedule.catch_up()
        if line.cable is Cable.HANGING:
            self._asked = (self._asked + data)[:_MOST_QUEUED]
        elif line.cable not in _DEAD:
            # What it has not looked at while it hung comes first.
            asked, self._asked = self._asked, b""
            self._send(asked + data)
        return self._due()

    def unsolicited(self) -> bytes:
        """Return what the client gets without a request, up to the clock's present time."""
        line = self._line
        line.schedule.catch_up()
        if line.cable is not Cable.HANGING:
            by_itself = self._inner.unsolicited()
            if by_itself and line.cable not in _DEAD:
                self._put(0.0, by_itself)
            if self._asked:
                asked, self._asked = self._asked, b""
                self._send(asked)
        return self._due()

    def next_unsolicited(self) -> float:
        """Return when the client next gets something without a request, or a fault begins or ends, s."""
        due = min(self._inner.next_unsolicited(), self._line.schedule.next_change())
        return min(due, self._leaving[0][0]) if self._leaving else due

    def lose(self) -> None:
        """Lose what is on its way."""
        self._asked = b""
        self._leaving.clear()

    def _send(self, request: bytes) -> None:
        answer = self._inner.receive(request)
        if answer:
            for delay, piece in self._line.send(request, answer):
                self._put(delay, piece)

    def _put(self, delay: float, data: bytes) -> None:
        instant = self._line.clock.now() + delay
        if self._leaving:
            instant = max(instant, self._leaving[-1][0])
        self._leaving.append((instant, data))

    def _due(self) -> bytes:
        leaving, now = self._leaving, self._line.clock.now()
        found = b""
        while leaving and leaving[0][0] <= now:
            found += leaving.popleft()[1]
        return found


class FaultySerial(FaultyStream, WireServer):
    """The serial side of an instrument, with the faults of its line."""

    def __init__(self, server: WireServer, line: FaultyLine) -> None:
        super().__init__(server, line)
        self.protocol = server.protocol
        self.hears_others = server.hears_others
        line.streams.append(self)

    def exchange_with(self, other: FaultySerial) -> None:
        """Lead to the instrument of another line, whose port then leads to this one's."""
        self._inner, other._inner = other._inner, self._inner
        self.hears_others, other.hears_others = other.hears_others, self.hears_others
        self._line.server, other._line.server = other._line.server, self._line.server


class FaultyConnection(FaultyStream):
    """A connection of an instrument on TCP, with the faults of its line.

    Each call but `close` raises `ConnectionResetError` once the instrument has ended it and what it sent is read.
    """

    _PASSED = ("receive",)

    def __init__(self, connection: Connection, line: FaultyLine) -> None:
        super().__init__(connection, line)
        self._connection = connection
        line.streams.append(self)

    @property
    def is_open(self) -> bool:
        """Whether the instrument has not ended it."""
        return self._connection.is_open

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the client, in pieces of any size; return what it gets at once."""
        self._check()
        return super().receive(data)

    def unsolicited(self) -> bytes:
        """Return what comes late, up to the clock's present time."""
        self._check()
        return super().unsolicited() if self._line.is_watched else self._inner.unsolicited()

    def next_unsolicited(self) -> float:
        """Return when the client next gets something late, or a fault begins or ends, s."""
        return super().next_unsolicited() if self._line.is_watched else self._inner.next_unsolicited()

    def close(self) -> None:
        """End it; may be called again."""
        self._connection.close()
        if self in self._line.streams:
            self._line.streams.remove(self)

    def _check(self) -> None:
        if self._line.is_watched:
            self._line.schedule.catch_up()
        if not (self._connection.is_open or self._leaving):
            raise ConnectionResetError("the instrument ended the connection")

    def _send(self, request: bytes) -> None:
        super()._send(request)
        if self._line.cable is Cable.CUT:
            self.close()


class FaultyTcpServer(TcpServer):
    """An instrument on TCP, with the faults of its line."""

    def __init__(self, server: TcpServer, line: FaultyLine) -> None:
        self._server = server
        self._line = line
        self.protocol = server.protocol

    def connect(self) -> FaultyConnection:
        """Open a connection.

        Raises `ConnectionRefusedError` if the line is cut, or as many as the instrument accepts are open.
        """
        self._line.schedule.catch_up()
        if self._line.cable is Cable.CUT:
            raise ConnectionRefusedError("connection refused: the line is cut")
        return FaultyConnection(self._server.connect(), self._line)
