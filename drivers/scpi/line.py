"""A conversation with a text instrument: each question has its own answer, and the queue of errors is read."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from bench.base import Clock, DeviceConnectionError, DeviceError
from bench.devices import ANY_TEXT, CommandTable, Template, template
from drivers.device import other_answer
from drivers.scpi.transport import TextLineSettings, open_transport
from drivers.serial_line import RESENDS, RepeatingLine

_MOST_ERRORS = 32
"""Errors that are read of a queue at once."""

_MOST_STRAY = 64
"""Late answers that are passed over before the line counts as lost."""

_NO_ERROR = re.compile(r"[-+]?0+(?:\.0*)?(?![0-9.])")
"""The number 0 at the beginning of an answer."""


class LineTable(TextLineSettings, CommandTable):
    """Where a text instrument is, and what it is told and asked."""


class TextLine(RepeatingLine):
    """The line to one text instrument.

    An answer belongs to the question before it: what was received earlier is forgotten before a question is sent.
    After an answer that is missing or makes no sense, a late one may still come. So the line has to be silent for the
    time-out, then the identity is asked for where it is known, and what comes before its answer is passed over.

    Questions are sent three times at most, other messages once.

    Attributes
    ----------
    lost : bool
        Whether the line itself failed, so that it has to be opened again.
    port : Any
        The port, None of VISA.

    Raises
    ------
    DeviceConnectionError
        If the line cannot be opened.
    """

    def __init__(self, device: str, settings: LineTable, clock: Clock) -> None:
        self._device = device
        self._settings = settings
        self._clock = clock
        self._free_at = clock.now()
        self._in_step = True
        self.lost = False
        self._end, self._encoding, self._delay = settings.write_terminator, settings.encoding, settings.delay
        self._transport = open_transport(device, settings, settings.read_terminator.encode(settings.encoding))
        self.port = getattr(self._transport, "port", None)

    def close(self) -> None:
        """Release the line."""
        self._transport.close()

    def tell(self, message: str) -> None:
        """Send a message that has no answer."""
        self._clock.sleep_until(self._free_at)
        try:
            encoded = f"{message}{self._end}".encode(self._encoding)
        except UnicodeEncodeError as error:
            raise DeviceError(
                self._device, f"{message!r} cannot be written in {self._settings.encoding}: {error}"
            ) from None
        with self._noticing_loss():
            self._transport.write(encoded)
        if self._delay:
            self._free_at = self._clock.now() + self._delay

    def ask(
        self, question: str, form: Template, resends: int = RESENDS, *, units: Mapping[str, str] | None = None
    ) -> tuple[str, dict[str, float]]:
        """Return the answer to a question, and the numbers in it by name, in these units if they come with one.

        Raises
        ------
        DeviceConnectionError
            If no answer comes.
        DeviceError
            If the last answer is not of that form, is not clear, or says that the number is infinite or none.
        """
        units = units or {}
        answer: str | None = None
        resends = min(resends, self.resends)
        for attempt in range(1 + resends):
            self.repeats += attempt > 0
            if not self._in_step and not self._catch_up():
                continue
            answer = self._exchange(question)
            self.resends = 0 if answer is None else RESENDS
            numbers = None if answer in (None, question) else form.match(answer, units)
            if answer is not None and numbers is not None:
                return answer, numbers
            self._in_step = False
        with self._noticing_loss():
            self._transport.leave()
        if answer is None:
            raise DeviceConnectionError(
                self._device,
                f"no answer to {question!r} within {self._settings.timeout:g} s at {self._settings.port}, after "
                f"{1 + resends} request{'s' if resends else ''}{other_answer(self._transport.unfinished)}; "
                "check power, cable, address, speed and terminators",
            )
        if answer == question:
            raise DeviceConnectionError(
                self._device,
                f"{self._settings.port} hands back what is sent; set echo = true, and check that it has power",
            )
        advice = form.doubt(answer, units) or "is it out of its range?"
        raise DeviceError(self._device, f"answered {answer!r} to {question!r}, expected {form.text!r}; {advice}")

    def errors(self) -> list[str]:
        """Read the queue of errors until it is empty; return them, oldest first. Empty if there is no such queue."""
        settings = self._settings
        found: list[str] = []
        if not settings.error_query:
            return found
        form = template(ANY_TEXT)
        while len(found) < _MOST_ERRORS:
            answer, _ = self.ask(settings.error_query, form)
            if self._is_no_error(answer):
                return found
            found.append(answer)
        return found

    def _is_no_error(self, answer: str) -> bool:
        if self._settings.no_error:
            return template(self._settings.no_error).match(answer) is not None
        return _NO_ERROR.match(answer) is not None

    @contextmanager
    def _noticing_loss(self) -> Iterator[None]:
        try:
            yield
        except DeviceConnectionError:
            self.lost = True
            raise

    def _exchange(self, question: str) -> str | None:
        with self._noticing_loss():
            self._transport.discard()
        self.tell(question)
        return self._receive()

    def _receive(self) -> str | None:
        with self._noticing_loss():
            answer = self._transport.read()
        return None if answer is None else answer.decode(self._encoding, "backslashreplace").strip()

    @property
    def in_step(self) -> bool:
        """Whether no answer to an earlier question can come any more."""
        return self._in_step

    def _catch_up(self) -> bool:
        """Return whether the line is in step again, so that no late answer can come any more."""
        if not any(self._receive() is None for _ in range(_MOST_STRAY)):
            raise DeviceConnectionError(self._device, f"the line {self._settings.port} does not fall silent")
        return self.find_identity()

    def find_identity(self) -> bool:
        """Ask for the identity where it is known, and pass over what comes before it; return whether it came."""
        form = template(self._settings.identity)
        # An identity that is not known cannot be told from a late answer.
        if self._settings.identity_query and form.text != ANY_TEXT:
            answer = self._exchange(self._settings.identity_query)
            while answer is not None and form.match(answer) is None:
                answer = self._receive()
            if answer is None:
                return False
        self._in_step = True
        return True
