"""A run of `bench run` on a served rig, as its own terminal would start it, for the harnesses beside it."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sqlite3
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Self

from benches import is_alive, rescuer_of, seconds_until

from bench.record import BLACK_BOX_NAME
from sim_devices.serving.process import EmulatedRig

PROTOCOLS = Path(__file__).with_name("hanging_protocols.py")

SETPOINTS = {
    "vo2": {"tec": 40.0},
    "sma": {"supply": 2.0, "stage": 0.001, "fan": 1.0},
    "hybrid": {"tec": 0.05, "piezo": 10.0},
}
"""Set-points that switch every output of a rig on."""

_LONGEST_START = 120.0
"""Longest wait for what a run does at its start, s."""


HEADS = f"{'safe':>7} {'median s':>9} {'longest s':>9} {'allowed s':>9}"
"""Heads of what `report` prints behind a title."""


@dataclass(frozen=True)
class Found:
    """What came of a trial: the time until its outputs were off and what was allowed, s; what was wrong."""

    seconds: float
    within: float
    problem: str = ""


def report(title: str, found: Sequence[Found]) -> int:
    """Print a row of the table, and what was wrong; return how often something was."""
    times = [each.seconds for each in found]
    problems = [each.problem for each in found if each.problem]
    print(
        f"{title} {len(found) - len(problems):3}/{len(found):3} {statistics.median(times):9.3f} "
        f"{max(times):9.3f} {found[0].within:9.1f}",
        *(f"         {each}" for each in problems),
        sep="\n",
        flush=True,
    )
    return len(problems)


def trials_parser(description: str, times: int) -> argparse.ArgumentParser:
    """Return the options of trials on served rigs; the runs hear signals from now on."""
    _hear_signals()
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", action="append", choices=list(SETPOINTS))
    parser.add_argument("--times", type=int, default=times, help="trials of each kind")
    parser.add_argument("--busy", type=int, default=0, help="busy processes beside")
    return parser


def _hear_signals() -> None:
    """Let the runs hear signals that a shell has its background jobs ignore."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for name in ("SIGHUP", "SIGQUIT"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_DFL)


def outputs_on(rig: EmulatedRig) -> dict[str, float]:
    """Return the true outputs of the instruments that are on."""
    return on(rig.control.request("state")["values"])


def on(values: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Return those of some true values that are outputs and on."""
    return {name: each["value"] for name, each in values.items() if each["is_output"] and abs(each["value"]) > 1e-6}


class GuardedRun:
    """A run, its folder, and its guardian; leaving it kills the bench and mends what is broken.

    Parameters
    ----------
    rig : EmulatedRig
        Where the instruments are.
    protocol : str
        One of `hanging_protocols.py`.
    overrides, parameters : mapping of str to str
        Options `--override` and `--set`.
    stalled : bool
        Whether nobody reads what the bench prints.
    options : sequence of str
        More options.
    """

    def __init__(
        self,
        rig: EmulatedRig,
        protocol: str,
        overrides: Mapping[str, str],
        parameters: Mapping[str, str],
        *,
        stalled: bool = False,
        options: Sequence[str] = (),
    ) -> None:
        self._rig = rig
        command = [sys.executable, "-P", "-m", "bench", "run", f"{PROTOCOLS}:{protocol}", "--rig", rig.name]
        command += ["--attach", str(rig.endpoints_file), "--no-rehearse", *options]
        with ExitStack() as stack:
            folder = Path(stack.enter_context(TemporaryDirectory(prefix="guarded-run-")))
            self._go = folder / "go"
            for option, values in (("--override", overrides), ("--set", {"until": str(self._go), **parameters})):
                for key, value in values.items():
                    command += [option, f"{key}={value}"]
            self._runs = folder / "runs"
            self._runs.mkdir()
            self._said = folder / "said.txt"
            out = stack.enter_context(self._said.open("wb")).fileno()
            if stalled:
                reading, out = os.pipe()
                stack.callback(os.close, reading)
            # In a session of its own, as its own terminal's would be.
            self.process = subprocess.Popen(
                [*command, "--out", str(self._runs)],
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            if stalled:
                os.close(out)
            stack.callback(self._end)
            self.guardian = self.rescuer = 0
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def exit_code(self) -> int | None:
        """Wait until the bench has left; return its exit code, None if it is still there after a minute."""
        with suppress(subprocess.TimeoutExpired):
            return self.process.wait(60)
        return None

    @property
    def said(self) -> str:
        """What the bench has printed, on one line, as the display may break a line anywhere."""
        return " ".join(self._said.read_text(errors="replace").split())

    def await_on(self, count: int) -> None:
        """Wait until everything is on, and find the guardian; then the protocol may go wrong."""
        self.await_note("everything is on")
        assert len(found := outputs_on(self._rig)) >= count, f"only {found} is on"
        self.guardian = find_guardian(self.folder)
        self.rescuer = rescuer_of(self.guardian)
        self._go.touch()

    def await_note(self, text: str) -> float:
        """Wait until the run has recorded a note; return the laboratory time at which it did, s."""
        since = time.monotonic()
        while time.monotonic() - since < _LONGEST_START:
            with suppress(sqlite3.Error, IndexError):
                db = sqlite3.connect(f"file:{next(self._runs.glob('*/journal.sqlite'), '')}?mode=ro", uri=True)
                try:
                    found = db.execute("SELECT t FROM events WHERE text = ?", (text,)).fetchone()
                    meta = {key: json.loads(value) for key, value in db.execute("SELECT key, value FROM meta")}
                finally:
                    db.close()
                if found:
                    # The record counts from the start of the run, the laboratory from its own.
                    began, served = (datetime.fromisoformat(meta[key]) for key in ("epoch", "laboratory_epoch"))
                    return (began - served).total_seconds() + float(found[0])
            assert self.process.poll() is None, f"it ended, exit code {self.process.returncode}: {self.said[-500:]}"
            time.sleep(0.02)
        raise AssertionError(f"{text!r} was never recorded")

    @property
    def folder(self) -> Path:
        """The folder of the run."""
        return next(self._runs.glob("*/journal.sqlite")).parent

    @property
    def cause(self) -> str:
        """What has tripped the guardian, by its own record; empty as long as nothing is recorded."""
        for record in self._runs.glob("*/guardian.jsonl"):
            for line in record.read_text().splitlines():
                note = json.loads(line)
                if note["what"] == "safe":
                    return str(note["cause"])
        return ""

    def has_freed_lines(self) -> bool:
        """Wait until the guardian has left the lines; return whether it has."""
        since = time.monotonic()
        while time.monotonic() - since < 30.0:
            if not is_alive(self.guardian):
                return True
            time.sleep(0.02)
        return False

    def _end(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for instrument in self._rig.instruments:
            self._rig.control.plug_in(instrument)
        if self.guardian and not self.has_freed_lines():
            os.kill(self.guardian, signal.SIGKILL)
        # Until then it may hold the rig.
        seconds_until(lambda: not is_alive(self.rescuer))


def find_guardian(folder: Path) -> int:
    """Return the guardian of the run in a folder, by its own record."""
    with (folder / BLACK_BOX_NAME).open(encoding="utf-8") as record:
        return int(json.loads(record.readline())["process"])


def start_busy(count: int, stack: ExitStack) -> None:
    """Keep processors busy until the stack is left."""
    for _ in range(count):
        busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
        stack.callback(busy.wait)
        stack.callback(busy.kill)
