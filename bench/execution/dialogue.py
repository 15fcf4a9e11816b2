"""The dialogue with the operator at a pause or a prompt: at the terminal, at a panel, or at both."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import Mapping
from functools import partial

from rich.console import Console

from bench.base import Stopwatch, format_duration, print_plain
from bench.execution.terminal import ProgressDisplay
from bench.operator import ABORT, AT_A_PROMPT, MEANINGS, NOBODY, RESUME, STEP, Question, RunMailbox

_INTERVAL = 0.1
"""Wall-clock time between two looks for an answer, s."""

_REDRAW = 1.0
"""Wall-clock time between two redraws of the line that says for how long, s."""


class _Lines:
    """Lines from the standard input, read in a thread of its own when they are asked for."""

    def __init__(self) -> None:
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None

    def ask(self) -> None:
        """Read one line, unless that of an earlier question was not typed yet."""
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._read, name="read-operator", daemon=True)
            self._thread.start()

    def take(self, seconds: float) -> str | None:
        """Return a line, empty at the end of the input; None if there is none within so many seconds."""
        try:
            return self._lines.get(timeout=seconds)
        except queue.Empty:
            return None

    def _read(self) -> None:
        try:
            self._lines.put(sys.stdin.readline())
        # The terminal is gone.
        except (OSError, ValueError):
            self._lines.put("")


class Dialogue:
    """Asks the operator; the first answer counts.

    Parameters
    ----------
    console : Console
        Console of the terminal.
    display : ProgressDisplay
        The bar, which stands still meanwhile.
    mailbox : RunMailbox, optional
        Where a panel may answer.
    at_terminal : bool
        Whether an operator can answer at the terminal.
    """

    def __init__(
        self, console: Console, display: ProgressDisplay, mailbox: RunMailbox | None, *, at_terminal: bool
    ) -> None:
        self._console = console
        self._display = display
        self._mailbox = mailbox
        self._lines = _Lines() if at_terminal else None
        self._since: Stopwatch | None = None
        self._before: Question | None = None

    def ask(self, question: Question) -> str:
        """Ask, and return the answer as the engine takes it."""
        if self._lines is None and not (self._mailbox is not None and self._mailbox.has_panel):
            return NOBODY
        if self._since is None:
            self._since, self._before = Stopwatch(), None
        self._display.stand_still(question.title)
        if self._mailbox is not None:
            self._mailbox.publish(question)
        try:
            answer = self._answer(question)
        finally:
            self._display.ask_again = None
            self._before = question
            if self._mailbox is not None:
                self._mailbox.withdraw()
        if answer in (RESUME, STEP):
            self._since = None
            self._display.go_on()
        return answer

    def _answer(self, question: Question) -> str:
        with self._display.lock:
            self._introduce(question)
            self._prompt(question)
            self._display.ask_again = partial(self._prompt, question)
        drawn = Stopwatch()
        while not self._display.is_over:
            if self._mailbox is not None and (answer := self._mailbox.answer()) is not None:
                try:
                    answer = question.answer(answer)
                except ValueError:
                    return ABORT
                self._say(f"answered at a panel: {answer}")
                return answer
            line = self._line()
            if line == "":
                return ABORT
            if line is not None:
                try:
                    return question.answer(line)
                except ValueError as error:
                    self._say(str(error))
                    self._prompt(question)
            elif drawn.seconds() > _REDRAW:
                drawn = Stopwatch()
                self._redraw(self._status(question))
        return ABORT

    def _introduce(self, question: Question) -> None:
        before = self._before
        if before is None or question.problem or question.text != before.text:
            self._say(question.problem or question.text)
        if before is not None:
            # The same pause: only what is new.
            self._offer(
                {name: text for name, text in question.parameters.items() if text != before.parameters.get(name)}
            )
            return
        self._console.bell()
        if question.commands == AT_A_PROMPT:
            self._say("r resumes, a ends the run in the safe state (then Enter)")
            return
        for shown, command in zip(question.shown, question.commands, strict=True):
            self._say(f"  {shown:<12} {MEANINGS[command]}")
        self._offer(question.parameters)

    def _offer(self, parameters: Mapping[str, str]) -> None:
        for name, text in parameters.items():
            self._say(f"  set {name}=…  now {text}")

    def _say(self, text: str) -> None:
        with self._display.lock:
            print_plain(self._console, text)

    def _line(self) -> str | None:
        if self._lines is None:
            threading.Event().wait(_INTERVAL)
            return None
        return self._lines.take(_INTERVAL)

    def _prompt(self, question: Question) -> None:
        with self._display.lock:
            self._say(self._status(question))
            if self._lines is not None:
                self._lines.ask()
                self._console.print("> ", end="")

    def _status(self, question: Question) -> str:
        seconds = 0.0 if self._since is None else self._since.seconds()
        return f"{question.title} for {format_duration(seconds)}  {self._display.latest}"[: self._console.width - 1]

    def _redraw(self, status: str) -> None:
        """Write the line above that of the cursor again; what is typed stays."""
        if not self._console.is_terminal or self._console.legacy_windows:
            return
        with self._display.lock:
            self._console.file.write(f"\x1b7\x1b[1A\r\x1b[2K{status}\x1b8")
            self._console.file.flush()
