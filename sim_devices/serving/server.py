"""The loop that serves laboratories: one process, one thread."""

from __future__ import annotations

import selectors
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress

from sim_devices.serving.control import ControlSocket
from sim_devices.serving.lines import Watched
from sim_devices.serving.served import ServedLaboratory
from sim_devices.serving.state_log import StateLog

_LONGEST_WAIT = 0.2  # s of wall-clock time, so that a signal is noticed soon
_SHORTEST_WAIT = 1e-3  # what a selector can wait; a shorter one is none


class Server:
    """Serves laboratories until it is told to stop.

    Parameters
    ----------
    laboratories : sequence of ServedLaboratory
        What is served.
    control : ControlSocket
        How others look into it.
    log : StateLog, optional
        Where true values are written.
    """

    def __init__(
        self, laboratories: Sequence[ServedLaboratory], control: ControlSocket, log: StateLog | None = None
    ) -> None:
        self._laboratories = laboratories
        self._control = control
        self._log = log
        self._selector = selectors.DefaultSelector()
        self._registered: dict[Watched, int] = {}

    def run(self, ended: Callable[[], bool]) -> None:
        """Serve until `ended()` or a request to stop."""
        for served in self._laboratories:
            served.clock.start()
        with self._selector:
            while not (ended() or self._control.stop_requested):
                self._turn()

    def _turn(self) -> None:
        """Wait until there is something to do, and do it."""
        self._register()
        wait = min((_LONGEST_WAIT, self._control.seconds_until_due(), *self._seconds_until_due()))
        ready = {key.fileobj for key, _ in self._selector.select(wait if wait >= _SHORTEST_WAIT else 0.0)}
        for served in self._laboratories:
            served.serve(ready)  # type: ignore[arg-type]  # what was registered
        self._control.serve(ready)  # type: ignore[arg-type]
        if self._log is not None:
            for served in self._laboratories:
                self._log.look_at(served)

    def _seconds_until_due(self) -> Iterator[float]:
        return (served.seconds_until_due() for served in self._laboratories)

    def _register(self) -> None:
        """Tell the selector what to wait on from now on."""
        wanted = dict(self._control.watched())
        for served in self._laboratories:
            for line in served.lines.values():
                wanted.update(line.watched())
        # Those that are gone first, as a new one may have the same descriptor.
        for end in [end for end in self._registered if end not in wanted]:
            del self._registered[end]
            with suppress(OSError, KeyError, ValueError):
                self._selector.unregister(end)
        for end, events in wanted.items():
            if end not in self._registered:
                self._selector.register(end, events)
            elif self._registered[end] != events:
                self._selector.modify(end, events)
            self._registered[end] = events
