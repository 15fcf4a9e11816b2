"""Makes a rig safe when its guardian has died or hangs: `python -m bench.execution.guardian.rescuer`.

A guardian starts it before it opens a line, so that it has loaded what it needs by the time that it is needed. It
opens no line as long as the guardian's signs of life come through a pipe, its standard input. If the bench dies as
well, it tells those whom the run had to tell.
"""

from __future__ import annotations

import io
import json
import os
import queue
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.base import ENDING, BenchError, Stopwatch, WallClock, parse_json, write_whole
from bench.execution.guardian.parent import SIGKILL, ParentProcess
from bench.execution.guardian.start import start_module
from bench.execution.notify import Notifier
from bench.record import Event
from bench.rig import SAFE, load_rig, opened, rescue

SILENCE = 3.0
"""Silence of a guardian after which it counts as dead, s; it gives a sign of life twice a second."""

TRY_FOR = 600.0
"""Time for which a device that is not safe is tried again, s."""

_SLICE = 0.25
"""Longest single wait for a sign of life, s."""

_INTERVAL = 0.25
"""Shortest time between two signs of life, s."""

_REPORT_AFTER = 3.0
"""Time after which it is reported what has become of each device so far, s."""

_DIES = 1.0
"""Time within which a process that was killed has ended, s."""

_TAKEN = 10.0
"""Time within which a bench that lives has taken the last report, s, also on a busy machine."""

_GONE = "the bench and its guardian are gone: they were killed, crashed or hang"

_ALIVE, _RELEASED = b".\n", b"!\n"
"""Signs of a guardian: it lives; it needs no rescuer. Its only other line is JSON and names those who are told."""


class Rescuer:
    """A rescuer, as its guardian sees it.

    Parameters
    ----------
    content : mapping
        `rig`, `overrides` and `attach` as for `RemoteStation`, and `report`, the path of the file in which it says
        that it is ready, and later what has become of each device; `process`, the number of the bench; `guardian` if
        that is not this process, 0 for none.
    """

    def __init__(self, content: dict[str, Any]) -> None:
        self._process = start_module("bench.execution.guardian.rescuer", stdin=subprocess.PIPE)
        assert self._process.stdin is not None
        self._pipe = self._process.stdin.fileno()
        self._last = float("-inf")
        self._write(json.dumps({"guardian": os.getpid(), **content}).encode() + b"\n")
        if sys.platform != "win32":
            os.set_blocking(self._pipe, False)

    def live(self, now: float) -> None:
        """Give a sign of life at a time of the guardian's clock, s."""
        if now - self._last >= _INTERVAL:
            self._last = now
            self._write(_ALIVE)

    def will_tell(self, whom: Mapping[str, Any]) -> None:
        """Say who is to be told if the bench dies, too: `targets` and `facts` as for `Notifier`, and `t`, s."""
        self._write(json.dumps(whom).encode() + b"\n")

    def release(self) -> None:
        """Let it end without an action, as nothing is left to be made safe."""
        self._write(_RELEASED)
        self.leave()

    def leave(self) -> None:
        """Give no sign of life any more: it makes the devices safe unless it was released."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()
        # It ends by itself.
        self._process.returncode = 0

    def _write(self, content: bytes) -> None:
        # One that does not read or has died must not hinder the guardian; the bench makes up for it.
        with suppress(OSError):
            os.write(self._pipe, content)


@dataclass(frozen=True)
class Report:
    """The file in which a rescuer says how far it is."""

    path: Path  # where it is

    def is_ready(self) -> bool:
        """Return whether a rescuer is ready or at work; not once it has left without an action."""
        return self.path.exists()

    def states(self) -> dict[str, str]:
        """Return by device `safe`, or what went wrong; empty as long as that is not known."""
        with suppress(OSError, ValueError):
            content = parse_json(self.path.read_text(encoding="utf-8"))
            return {str(name): str(state) for name, state in content["devices"].items()}
        return {}

    def take(self) -> dict[str, str]:
        """Return the states and remove the file, once they are known."""
        if states := self.states():
            self.path.unlink(missing_ok=True)
        return states

    def write(self, states: dict[str, str]) -> None:
        """Write the states of devices down, empty while they are not known; a bench that has left reads no more."""
        with suppress(OSError):
            write_whole(self.path, json.dumps({"process": os.getpid(), "devices": states}))


def in_words(states: Mapping[str, str]) -> str:
    """Return the states of devices as a text: `safe`, or what went wrong."""
    return ", ".join(
        f"{name}: {state if state == SAFE else f'NOT CONFIRMED SAFE, {state}'}" for name, state in states.items()
    )


def is_needed(signs: queue.SimpleQueue[bytes]) -> bool:
    """Wait until the guardian is gone or has been silent for too long, or releases this process.

    `signs` are what the guardian has written, empty at its end. Of a wait without a sign of life only its nominal
    time counts: while this process itself got no processor, or the machine was suspended, the guardian may not have
    got one either.
    """
    silent, has_begun = 0.0, False
    while silent < SILENCE:
        try:
            sign = signs.get(timeout=_SLICE)
        except queue.Empty:
            # Before its first sign it opens lines, which may take long.
            silent += _SLICE if has_begun else 0.0
            continue
        if sign in (b"", _RELEASED):
            return not sign
        silent, has_begun = 0.0, True
    return True


def main() -> int:
    """Wait until this process is needed, and make the devices of the rig safe then."""
    # It ends with its guardian only.
    for number in (*ENDING, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    # Without a buffer: a thread that waits for one would keep the interpreter from its end.
    pipe = io.FileIO(sys.stdin.fileno(), closefd=False)
    content = parse_json(pipe.readline())
    guardian = ParentProcess(content["guardian"])
    report = Report(Path(content["report"]))
    # The drivers as well: nothing has to be loaded any more when it counts, and the file may be edited meanwhile.
    file = load_rig(content["rig"], content["overrides"])
    bench = _descriptor_of(content["process"])
    signs: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    told = _Told()
    threading.Thread(target=_read, args=(pipe, signs, told), daemon=True).start()
    report.write({})
    if not is_needed(signs):
        # A bench that has lost its guardian since then must not wait for this one.
        report.path.unlink(missing_ok=True)
        return 0
    # A stopped guardian keeps its lines and locks.
    guardian.send(SIGKILL)
    guardian.await_end(_DIES)
    attach = None if content["attach"] is None else Path(content["attach"])
    states: dict[str, str] = {}
    try:
        # The devices have to be made safe whoever holds a lock.
        with opened(file, attach, "making safe without its guardian", lambda _: None) as place:
            for seconds, found in rescue(place, limit=TRY_FOR):
                states = {each.device: SAFE if each.is_safe else each.state for each in found}
                if seconds >= _REPORT_AFTER or all(each.is_safe for each in found):
                    report.write(states)
                    if _has_died(bench):
                        told.tell(states)
    except BenchError as error:
        states = dict.fromkeys((entry.name for entry in file.devices), str(error))
        report.write(states)
    if _is_left(report, bench):
        told.tell(states)
    return 0


class _Told:
    """Those who are told once that bench and guardian are gone; nobody if the guardian has named none."""

    def __init__(self) -> None:
        self._line = b""
        self._since = Stopwatch()

    def take(self, line: bytes) -> None:
        self._line, self._since = line, Stopwatch()

    def tell(self, states: Mapping[str, str]) -> None:
        line, self._line = self._line, b""
        # A target that has become wrong since the run began must not keep the devices from being made safe.
        with suppress(BenchError, LookupError, TypeError, ValueError):
            whom = parse_json(line)
            with Notifier(whom["targets"]) as notifier:
                notifier.facts = whom["facts"]
                t = whom["t"] + self._since.seconds()
                notifier.event(Event(t, "ERROR", "error", f"{_GONE}; {in_words(states)}"))
                notifier.event(Event(t, "WARN", "end", "failed"))


def _is_left(report: Report, bench: int | None) -> bool:
    """Return whether the bench has died or hangs: one that lives takes the report at once."""
    waited = Stopwatch()
    while report.is_ready() and waited.seconds() < _TAKEN and not _has_died(bench):
        WallClock().sleep(_SLICE)
    return report.is_ready()


def _has_died(process: int | None) -> bool:
    """Return whether a process is known to be dead."""
    return process is not None and bool(select.select([process], [], [], 0.0)[0])


def _descriptor_of(process: int) -> int | None:
    """Return what becomes readable when a process dies; None where the system has no such thing, or it is dead."""
    with suppress(AttributeError, OSError):
        return os.pidfd_open(process)
    return None


def _read(pipe: io.FileIO, signs: queue.SimpleQueue[bytes], told: _Told) -> None:
    while sign := pipe.readline():
        if sign not in (_ALIVE, _RELEASED):
            told.take(sign)
        signs.put(sign)
    signs.put(b"")


if __name__ == "__main__":
    sys.exit(main())
