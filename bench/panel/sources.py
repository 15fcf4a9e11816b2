"""What a panel shows and where its lines go: a rig under the operator's hands, or a run in progress."""

from __future__ import annotations

import io
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from bench.base import BenchError, ConfigurationError, DataError, Interrupts, PlainConsole, format_duration
from bench.execution import Run, RunResult, carry_out
from bench.operator import END, PAUSE, SYNTAX, Desk, Leave, PanelMailbox, Shown, parse_command
from bench.protocol import ByHand, Messages, ProtocolParameters, protocol
from bench.record import Record
from bench.rig import is_in_use, rig_of_content

_TICKS = 240
"""Newest ticks of a run that are shown."""


@dataclass(frozen=True)
class View:
    """What a panel shows at one moment.

    Attributes
    ----------
    title : str
        What it is.
    state : str
        One line: how far it is, or what is asked.
    shown : Shown or None
        The rig; None before it is connected.
    ticks : sequence of (float, mapping)
        The newest readings: laboratory time in s, values by signal.
    lines : sequence of str
        What happened, oldest first.
    help : str
        What may be typed.
    over : bool
        Whether it is over.
    closes : bool
        Whether the panel closes then by itself.
    """

    title: str
    state: str
    shown: Shown | None
    ticks: Sequence[tuple[float, Mapping[str, float]]]
    lines: Sequence[str]
    help: str
    over: bool = False
    closes: bool = False


class Source(Protocol):
    """What a panel shows.

    Attributes
    ----------
    keys : tuple of str
        Lines that have a key of their own.
    """

    keys: tuple[str, ...]

    def view(self) -> View:
        """Return what there is to see now."""

    def submit(self, line: str) -> str:
        """Take a line of the operator; return what is wrong with it, empty if it was taken."""

    def leave(self) -> bool:
        """Take that the operator leaves; return whether the panel may close at once."""


@dataclass
class HandsOnRig:
    """A rig that a thread of this process carries out commands on.

    Parameters
    ----------
    rig : str
        Its name or file.
    desk : Desk
        Where commands go to and readings come from.
    work : callable
        Connects the rig, carries the commands out, and leaves every device in its safe state.
    """

    rig: str
    desk: Desk
    work: Callable[[], Any]
    keys: tuple[str, ...] = ("hold", "safe")
    error: BenchError | None = None
    result: Any = None
    _thread: threading.Thread = field(init=False)

    def __post_init__(self) -> None:
        self._thread = threading.Thread(target=self._carry_out, name="by-hand")
        self._thread.start()

    def view(self) -> View:
        """Return the newest readings."""
        over = not self._thread.is_alive()
        state = "connecting …" if self.desk.shown is None else "by hand; every limit and interlock of a run holds"
        if over:
            state = f"over: {self._outcome()}"
        elif self.desk.ticks:
            state = f"t {format_duration(self.desk.ticks[-1][0])}  {state}"
        help_ = "; ".join(SYNTAX.values())
        ticks, lines = tuple(self.desk.ticks), tuple(self.desk.lines)
        # Nobody has to read why, if the operator or the system has asked for it.
        closes = over and self.error is None and self.result.outcome.status != "failed"
        return View(f"panel of {self.rig}", state, self.desk.shown, ticks, lines, help_, over, closes)

    def submit(self, line: str) -> str:
        """Have a command carried out."""
        try:
            self.desk.send(parse_command(line, None if self.desk.shown is None else self.desk.shown.limits))
        except ConfigurationError as error:
            return str(error)
        return ""

    def leave(self) -> bool:
        """Have every device made safe."""
        if self._thread.is_alive():
            self.desk.send(Leave())
            return False
        return True

    def wait(self) -> None:
        """Wait until every device is in its safe state."""
        self._thread.join()

    def is_connected(self) -> bool:
        """Wait until the rig is connected; return False if it cannot be."""
        while self.desk.shown is None and self._thread.is_alive():
            self._thread.join(0.1)
        return self.desk.shown is not None

    def _outcome(self) -> str:
        if self.error is not None:
            return f"{self.error}"
        outcome = self.result.outcome
        safe = "all outputs are safe" if outcome.is_safe else "NOT ALL OUTPUTS ARE SAFE"
        return f"{outcome.status}{f': {outcome.reason}' if outcome.reason else ''}; {safe}"

    def _carry_out(self) -> None:
        try:
            self.result = self.work()
        except BenchError as error:
            self.error = error


class _Log(io.StringIO):
    """Takes what a run prints for the log of the panel."""

    def __init__(self, desk: Desk) -> None:
        super().__init__()
        self._desk = desk

    def write(self, text: str) -> int:
        for line in text.splitlines():
            if line.strip():
                self._desk.say(line.rstrip())
        return len(text)


def carry_out_by_hand(desk: Desk, interrupts: Interrupts, **asked: Any) -> RunResult:  # noqa: ANN401 - of `Run`
    """Connect a rig, carry the commands of a desk out as a run, and leave every device in its safe state.

    `asked` are fields of a `Run`. Raises what `bench.execution.carry_out` does before anything moves.
    """

    @protocol(needs=())
    def by_hand(parameters: ProtocolParameters) -> Messages:  # noqa: ARG001 - of this form
        """Let an operator move the rig by hand."""
        yield ByHand(desk=desk)

    run = Run(protocol=by_hand, settings={}, recording=False, rehearse=False, **asked)
    return carry_out(run, PlainConsole(file=_Log(desk), width=200), interrupts)


class RunInProgress:
    """A run of another process, by its journal; its questions are answered by its mailbox.

    Parameters
    ----------
    folder : Path
        Folder of the run, or its journal.

    Raises
    ------
    DataError
        If there is no journal, or it is damaged.
    """

    keys: tuple[str, ...] = (PAUSE,)

    def __init__(self, folder: Path) -> None:
        self._folder = folder if folder.is_dir() else folder.parent
        self._mailbox = PanelMailbox(self._folder)
        with Record(self._folder) as record:
            meta = record.meta
            self._signals = record.signals
        self._title = f"{meta['run']}: {meta['protocol']} on {meta['rig']}"
        self._shown = self._shown_of(meta)
        self._help = f"{PAUSE}; {END}; quit (the run goes on)"

    def view(self) -> View:
        """Read what the journal has by now."""
        self._mailbox.show_presence()
        with Record(self._folder) as record:
            rows = record.newest_ticks(_TICKS)
            events = record.events()
            status = record.status
        names = [signal.name for signal in self._signals]
        ticks = [(row[0], dict(zip(names, row[1:], strict=True))) for row in rows]
        lines = [f"{format_duration(each.t):>10}  {each.kind}: {each.text}" for each in events[-200:]]
        if status == "unfinished" and not is_in_use(self._folder):
            status = "unfinished: its process is gone"
        over = status != "unfinished"
        state, help_ = status if over else "running", self._help
        question = self._mailbox.question()
        if question is not None:
            asked = question[1]
            state = f"{asked.title}: {asked.problem or asked.text}"
            help_ = "; ".join(
                [*asked.shown, *(f"set {name}=… now {text}" for name, text in asked.parameters.items())]
            )
        if ticks:
            state = f"t {format_duration(ticks[-1][0])}  {state}"
        return View(self._title, state, self._shown, ticks, lines, help_, over)

    def submit(self, line: str) -> str:
        """Answer the question that is open, or ask for a pause or the end."""
        question = self._mailbox.question()
        try:
            if question is not None:
                number, asked = question
                self._mailbox.reply(number, asked.answer(line))
            elif not self._mailbox.is_open:
                return "the run does not go on, or is on the virtual clock"
            elif (word := line.strip().lower()) in (PAUSE, END):
                self._mailbox.request(word)
            else:
                return f"{line!r}: expected {self._help}"
        except (ValueError, OSError) as error:
            return str(error)
        return ""

    def leave(self) -> bool:
        """Close the panel; the run goes on."""
        return True

    def _shown_of(self, meta: Mapping[str, Any]) -> Shown:
        """Return the rig of the run, as far as it can be read here."""
        limits: dict[str, Any] = {}
        interlocks: tuple[Any, ...] = ()
        try:
            file = rig_of_content(meta["rig"], meta["rig_file"], meta["rig_content"])
            interlocks = tuple(file.interlocks)
        # One of another laboratory, whose drivers are not installed here.
        except (ConfigurationError, DataError, KeyError):
            pass
        return Shown(str(meta["rig"]), self._signals, limits, interlocks)
