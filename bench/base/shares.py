"""How far a long computation is: said where it computes, shown by who has started it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeAlias

Listener: TypeAlias = Callable[[str, float], None]
"""Takes what is being done, such as `fitting`, and the share of it that is done, 0 to 1."""

_listener: ContextVar[Listener | None] = ContextVar("listener", default=None)


@contextmanager
def shares_to(listener: Listener) -> Iterator[None]:
    """Give the shares that are said within this block to a listener, in the thread that computes.

    What the listener says itself goes to the one before.
    """
    before = _listener.get()

    def told(what: str, share: float) -> None:
        token = _listener.set(before)
        try:
            listener(what, share)
        finally:
            _listener.reset(token)

    token = _listener.set(told)
    try:
        yield
    finally:
        _listener.reset(token)


def say_share(what: str, share: float) -> None:
    """Say which share of a computation is done, 0 to 1; nothing happens if nobody listens."""
    listener = _listener.get()
    if listener is not None:
        listener(what, min(max(share, 0.0), 1.0))
