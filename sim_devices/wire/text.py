"""Lines of text, as a text instrument sends and takes them."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from sim_devices.instruments.emulated import Pluggable
from sim_devices.instruments.scpi import INPUT_OVERRUN, LONGEST_MESSAGE, EmulatedTextInstrument
from sim_devices.wire import WireServer


class LineServer(WireServer):
    """An emulated instrument that is asked and told by lines of ASCII; a subclass says what it answers.

    Attributes
    ----------
    end : bytes
        End of a line, of both directions.
    """

    protocol = "lines of text"
    is_text = True
    end: ClassVar[bytes] = b"\n"
    _received = b""

    @abstractmethod
    def answer(self, message: str) -> str | None:
        """Obey a message, and return its answer, or None if it has none."""

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the instrument sends."""
        *lines, rest = (self._received + data).split(self.end)
        self._received = rest if len(rest) <= LONGEST_MESSAGE else b""
        answers = [self.answer(line.decode("ascii", "replace")) for line in lines]
        return b"".join(answer.encode("ascii", "replace") + self.end for answer in answers if answer is not None)


class AttendedLine(Pluggable, LineServer):
    """An instrument that serves its own line of text, and keeps silent while it is unplugged."""

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the instrument sends."""
        with self.world.lock:
            if not self.answering:
                self._received = b""
                return b""
            self.attend()
            return super().receive(data)


class TextServer(WireServer):
    """The line of an emulated text instrument, with the terminators and the encoding of its table."""

    protocol = "lines of text"
    is_text = True

    def __init__(self, instrument: EmulatedTextInstrument) -> None:
        self._instrument = instrument
        table = instrument.table
        self._encoding = table.encoding
        self._end_of_message = table.write_terminator.encode(self._encoding)
        self._end_of_answer = table.read_terminator.encode(self._encoding)
        self._received = b""

    def receive(self, data: bytes) -> bytes:
        """Take bytes from the host, in pieces of any size; return what the instrument sends."""
        instrument = self._instrument
        with instrument.world.lock:
            if not self._received and data.find(self._end_of_message) == len(data) - len(self._end_of_message) >= 0:
                # The usual case: a host that sends one message and waits.
                if not instrument.answering:
                    return b""
                instrument.attend()
                return self._serve(data[: -len(self._end_of_message)])
            *messages, rest = (self._received + data).split(self._end_of_message)
            if not instrument.answering:
                self._received = b""
                return b""
            instrument.attend()
            if len(rest) > LONGEST_MESSAGE:
                instrument.report(INPUT_OVERRUN)
                rest = b""
            self._received = rest
            return b"".join(self._serve(message) for message in messages)

    def _serve(self, message: bytes) -> bytes:
        if len(message) > LONGEST_MESSAGE:
            self._instrument.report(INPUT_OVERRUN)
            return b""
        answer = self._instrument.obey(message.decode(self._encoding, "replace"))
        if answer is None:
            return b""
        return answer.encode(self._encoding, "replace") + self._end_of_answer
