"""What bench and worker process say to each other, one pickle after another."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from typing import IO, Any


@dataclass(frozen=True)
class Welcome:
    """Command line and width of the terminal, for a worker process. Its tasks follow as `bytes`: pickled calls."""

    command: list[str]
    width: int


@dataclass(frozen=True)
class Result:
    """The value that a task returned, or the exception that it raised, pickled."""

    content: bytes
    is_error: bool


@dataclass(frozen=True)
class Progress:
    """How far a task is; see `bench.base.workers.task.report`."""

    completed: int
    total: int | None
    text: str


@dataclass(frozen=True)
class Words:
    """What a task printed."""

    text: str


Message = Result | Progress | Words


def send(pipe: IO[bytes], message: Message | Welcome | bytes) -> None:
    """Write a message."""
    pickle.dump(message, pipe)
    pipe.flush()


def receive(pipe: IO[bytes]) -> Any:  # noqa: ANN401 - a Message, or what the bench says
    """Return the next message.

    Raises EOFError if the other end is gone.
    """
    try:
        return pickle.load(pipe)  # noqa: S301 - a pipe to our own process
    except (pickle.UnpicklingError, OSError, ValueError) as error:
        raise EOFError(str(error)) from None
