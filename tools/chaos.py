"""Let every method of the guardian fail once, and read in the instrument whether its output goes off.

    python tools/chaos.py ENDPOINTS [METHOD]...

prints a line of JSON for each: whether it failed, when the output was off, and what the bench was told.
"""

from __future__ import annotations

import inspect
import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from benches import is_alive, rescuer_of, seconds_until

from bench.base import BenchError, LimitError
from bench.execution.guardian import __main__ as program, process, remote
from bench.execution.guardian.black_box import BlackBox
from bench.execution.guardian.channel import Channel
from bench.execution.guardian.lines import LineThreads
from bench.execution.guardian.process import Guardian
from bench.execution.station.core import StationCore
from bench.rig import ControlClient, Look, attach, load_rig, read_endpoints

LEASE = 0.5
LONGEST = 30.0


def _methods(kind: type, *left_out: str) -> dict[str, tuple[type, str]]:
    return {
        f"{kind.__name__}.{name}": (kind, name)
        for name, _ in inspect.getmembers(kind, inspect.isfunction)
        if name not in ("__init__", *left_out)
    }


_NOT_IN_A_RUN = (
    *("begin", "serve", "close", "keep_in", "_keep_record", "_look_readers", "finish"),
    *("_line_was_away", "_lose_bench", "_terminate"),
)

METHODS = {
    **_methods(Guardian, *_NOT_IN_A_RUN, "_blind", "_can_play", "_play", "_judge_block", "_operate"),
    **_methods(StationCore, "begin"),
    **_methods(LineThreads, "_work"),
    **_methods(BlackBox, *_NOT_IN_A_RUN, "_write"),
    **_methods(Channel, "fileno", "close", "wait"),
}
"""What can fail once an output is on."""


class Forked:
    """A guardian that was forked, as a process that was started is used."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self.returncode: int | None = None

    def kill(self) -> None:
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)

    def wait(self, seconds: float) -> int:
        since = time.monotonic()
        while self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
            elif time.monotonic() - since > seconds:
                raise subprocess.TimeoutExpired("guardian", seconds)
            else:
                time.sleep(0.005)
        return self.returncode


def _fail_once(kind: type, name: str, note: int) -> None:
    """Let a method fail the first time that it is called with an output on."""
    original = getattr(kind, name)
    guardians: list[Guardian] = []
    failed: set[type] = set()
    serve = Guardian.serve

    def noted(self: Guardian) -> None:
        guardians.append(self)
        serve(self)

    def faulty(self, *arguments, **named):
        if kind not in failed and guardians and guardians[0]._statuses:
            failed.add(kind)
            os.write(note, b"x")
            raise ZeroDivisionError(name)
        return original(self, *arguments, **named)

    Guardian.serve = noted
    setattr(kind, name, faulty)
    for do, method in process._REQUESTS.items():
        if method is original:
            process._REQUESTS[do] = faulty


def _start(kind: type, name: str, note: int, log: object) -> tuple[Forked, Channel]:
    del log
    ours, theirs = socket.socketpair()
    pid = os.fork()
    if pid == 0:
        try:
            ours.close()
            sys.argv = ["guardian", str(theirs.detach())]
            _fail_once(kind, name, note)
            os._exit(program.main())
        finally:
            os._exit(3)
    theirs.close()
    return Forked(pid), Channel(ours)


def trial(title: str, endpoints: Path, control: ControlClient) -> dict:
    """Let one method fail; return what came of it."""

    def is_on() -> bool:
        return bool(control.state()["tec_output"])

    noted, note = os.pipe()
    os.set_blocking(noted, False)

    def failed() -> bool:
        with suppress(BlockingIOError):
            return bool(os.read(noted, 1))
        return False

    remote.start_guardian = lambda log: _start(*METHODS[title], note, log)
    attachment = attach(endpoints, "vo2")
    station = remote.RemoteStation(attachment.clock, load_rig("vo2"), "vo2", {}, endpoints, 0, "a test")
    rescuer = rescuer_of(station._process.pid)
    station._answer_within = 2.0
    found: dict = {"method": title, "error": None}
    try:
        with suppress(BenchError):
            station.promise(LEASE, "chaos")
            station.apply({"tec": 40.0})
        # The bench works for a while, and is late then.
        try:
            for _ in range(3):
                station.look(Look.GLANCE)
                station.arrivals()
                station.promise(LEASE, "chaos")
                station.promise(1.1 * LEASE, "chaos")
            station.check({"tec": [40.0]})
            with suppress(LimitError):
                station.check({"tec": [400.0]})
            # A look of the guardian's own.
            time.sleep(0.3)
            # Something has to be done after the failure, so that the bench may go on.
            station.apply({"tec": 41.0})
        except BenchError as error:
            found["error"] = f"{type(error).__name__}: {error}"
        since = time.monotonic()
        while is_on() and time.monotonic() - since < LONGEST:
            time.sleep(0.01)
        found["off_after"] = None if is_on() else time.monotonic() - since
        found["safe"] = dict(station.end())
        found["on_at_the_end"] = is_on()
        found["failed"] = failed()
    finally:
        station._process.kill()
        station.close()
        attachment.close()
        # Until then it holds the lines, and may stop the TEC once more.
        seconds_until(lambda: not is_alive(rescuer))
        os.close(noted)
        os.close(note)
        # Whoever opens a T7 next waits for 3 s if it was not released.
        for instrument in ("tec", "psd"):
            control.fault(f"{instrument}.power-cycle")
    return found


def main() -> None:
    """Carry out all trials, or those that are named."""
    endpoints = Path(sys.argv[1])
    control = ControlClient(read_endpoints(endpoints).control)
    for title in sys.argv[2:] or METHODS:
        print(json.dumps(trial(title, endpoints, control)), flush=True)


if __name__ == "__main__":
    main()
