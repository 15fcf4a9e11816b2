"""Letters between a run and a panel in another process: files in the folder of the run.

A run writes the question that it asks; a panel writes the answer, or asks for a pause or the end. Files work where
the folder is: in another session, on another computer, on Windows, and nothing listens on a port.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Strict

from bench.base import Interrupts, json_text, parse_json, wall_time, write_whole
from bench.operator.questions import Question

_NAME = "operator"
_QUESTION, _ANSWER, _REQUEST = "question.json", "answer-{}.json", "request.json"
_INTERVAL = 0.3
"""Wall-clock time between two looks for a request, s."""

_PANEL = "panel"
_PRESENT = 5.0
"""Wall-clock time since a panel was heard within which it counts as present, s."""

PAUSE = "pause"
END = "end"


class _Letter(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class _Asked(_Letter):
    number: int
    text: str
    commands: Annotated[tuple[str, ...], Strict(False)]
    title: str
    parameters: dict[str, str]
    problem: str


class _Answer(_Letter):
    answer: str


class _Request(_Letter):
    do: Literal["pause", "end"]


_Kind = TypeVar("_Kind", bound=_Letter)


class RunMailbox:
    """The run's side: publishes questions, and hears what a panel asks for.

    Use it as a context manager, for as long as the run goes on; it removes what it made.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    interrupts : Interrupts
        Where a request is passed on.
    """

    def __init__(self, folder: Path, interrupts: Interrupts) -> None:
        self._folder = folder / _NAME
        self._interrupts = interrupts
        self._asked = 0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="mailbox", daemon=True)

    def __enter__(self) -> Self:
        # Without it there is no panel; the run goes on.
        with suppress(OSError):
            self._folder.mkdir(exist_ok=True)
        self._remove()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(_INTERVAL * 4)
        self._remove()
        with suppress(OSError):
            self._folder.rmdir()

    @property
    def has_panel(self) -> bool:
        """Whether a panel shows this run."""
        try:
            seen = (self._folder / _PANEL).stat().st_mtime
        except OSError:
            return False
        return wall_time().timestamp() - seen < _PRESENT

    def publish(self, question: Question) -> None:
        """Let a panel see a question, under a number of its own."""
        self._asked += 1
        with suppress(OSError):
            write_whole(self._folder / _QUESTION, json_text({"number": self._asked, **asdict(question)}))

    def answer(self) -> str | None:
        """Return what a panel has answered to the question, None while it has not."""
        letter = _read(self._folder / _ANSWER.format(self._asked), _Answer)
        return None if letter is None else letter.answer

    def withdraw(self) -> None:
        """Take the question back, as it was answered."""
        for name in (_QUESTION, _ANSWER.format(self._asked)):
            with suppress(OSError):
                (self._folder / name).unlink(missing_ok=True)

    def _listen(self) -> None:
        path = self._folder / _REQUEST
        while not self._over.wait(_INTERVAL):
            letter = _read(path, _Request)
            if letter is None:
                continue
            with suppress(OSError):
                path.unlink()
            if letter.do == PAUSE:
                self._interrupts.pause_requested = True
            else:
                self._interrupts.abort_reason = "the operator at a panel"

    def _remove(self) -> None:
        with suppress(OSError):
            for path in self._folder.iterdir():
                path.unlink(missing_ok=True)


class PanelMailbox:
    """The side of a panel.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / _NAME

    @property
    def is_open(self) -> bool:
        """Whether the run goes on and hears a panel."""
        return self._folder.is_dir()

    def show_presence(self) -> None:
        """Let the run know that a panel shows it; to be called at least every second."""
        with suppress(OSError):
            if self.is_open:
                (self._folder / _PANEL).touch()

    def question(self) -> tuple[int, Question] | None:
        """Return the number of the question that is open, and the question; None if there is none."""
        letter = _read(self._folder / _QUESTION, _Asked)
        if letter is None:
            return None
        return letter.number, Question(**letter.model_dump(exclude={"number"}))

    def reply(self, number: int, answer: str) -> None:
        """Answer a question; raises OSError if the folder cannot be written."""
        write_whole(self._folder / _ANSWER.format(number), json_text({"answer": answer}))

    def request(self, do: str) -> None:
        """Ask for a pause or for the end; raises OSError if the folder cannot be written."""
        write_whole(self._folder / _REQUEST, json_text({"do": do}))


def _read(path: Path, kind: type[_Kind]) -> _Kind | None:
    """Return a letter; None if there is none, or something else is in its place."""
    try:
        return kind.model_validate(parse_json(path.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return None
