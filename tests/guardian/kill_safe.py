"""Kill, stop and hang a bench in every way, and read in the instruments when their outputs are off.

    python tests/guardian/kill_safe.py [--rig RIG]... [--trial NAME]... [--times N] [--busy N]

prints a table: for each rig and trial, how often every output became safe within its declared time, and the median
and longest time it took. The instruments are served by `bench emulate` in another process, and the bench runs as on
hardware.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import statistics
import subprocess
import sys
import time
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from bench.attachment import ControlClient
from sim_devices.serving.process import EmulatedRig, serve

PROTOCOLS = Path(__file__).with_name("hanging_protocols.py")

SETPOINTS = {
    "vo2": {"tec": 40.0},
    "sma": {"supply": 2.0, "stage": 0.001, "fan": 1.0},
    "hybrid": {"tec": 0.05, "piezo": 10.0},
}
"""Set-points that switch every output of a rig on."""

DEATH, PROMISE, PATIENCE, CUT = 0.2, 5.0, 4.0, 8.0
"""Time within which every output has to be off, s: the bench died; it broke the promise of a hold (its period of 1 to
2 s and 2 s), or of a computation (set to 3 s here, and 1 s for the last step); an instrument that cannot be reached
switches itself off by its own watchdog."""


@dataclass(frozen=True)
class Trial:
    """One way to go wrong.

    Attributes
    ----------
    protocol : str
        What runs meanwhile.
    sent : signal or None
        What the bench is sent once everything is on.
    within : float
        Time within which every output has to be off, s.
    stalled : bool
        Whether nobody reads what the bench prints.
    ends : bool
        Whether the outputs have to go off at all.
    """

    protocol: str
    sent: signal.Signals | None
    within: float
    stalled: bool = False
    ends: bool = True


TRIALS = {
    "SIGKILL": Trial("hold", signal.SIGKILL, DEATH),
    "SIGTERM": Trial("hold", signal.SIGTERM, 3.0),
    "SIGQUIT": Trial("hold", signal.SIGQUIT, 3.0),
    "SIGSTOP": Trial("hold", signal.SIGSTOP, PROMISE),
    "endless loop": Trial("spin", None, PATIENCE),
    "endless loop, SIGTERM": Trial("spin", signal.SIGTERM, 3.0),
    "interpreter kept": Trial("keep-interpreter", None, PATIENCE),
    "stalled reader": Trial("talk", signal.SIGTERM, 3.0, stalled=True),
}


@dataclass(frozen=True)
class Found:
    """What came of a trial: the time until every output was off, s, and what was wrong."""

    seconds: float
    problem: str


def outputs(control: ControlClient) -> dict[str, float]:
    """Return the true outputs of the instruments that are on."""
    values = control.request("state")["values"]
    return {name: each["value"] for name, each in values.items() if each["is_output"] and abs(each["value"]) > 1e-6}


def carry_out(rig: EmulatedRig, trial: Trial, folder: Path, wait: float) -> Found:
    """Carry a trial out, and leave the laboratory as it was."""
    command = [sys.executable, "-P", "-m", "bench", "run", f"{PROTOCOLS}:{trial.protocol}", "--rig", rig.name]
    command += ["--attach", str(rig.endpoints_file), "--out", str(folder), "--override", "safety.patience=3"]
    # Not all rigs have a watchdog and an interlock for each output that heats.
    command += ["--override", "safety.unattended=false"]
    command += ["--set", f"setpoints={json.dumps(SETPOINTS[rig.name])}"]
    with ExitStack() as stack:
        if trial.stalled:
            reading, writing = os.pipe()
            stack.callback(os.close, reading)
            out: int = writing
        else:
            out = stack.enter_context((folder.parent / f"{folder.name}.txt").open("wb")).fileno()
        # In a session of its own, as its own terminal's would be.
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT, start_new_session=True
        )
        if trial.stalled:
            os.close(writing)
        stack.callback(_end, process)
        _await_on(rig.control, process, len(SETPOINTS[rig.name]), folder)
        guardians = find_guardians(process.pid)
        if trial.sent is None:
            _await_note(folder, "computing")
            start = time.monotonic()
        else:
            time.sleep(wait)
            if not outputs(rig.control):
                return Found(0.0, "the outputs were off before the trial")
            start = time.monotonic()
            process.send_signal(trial.sent)
        while (left := outputs(rig.control)) and time.monotonic() - start < trial.within + 10.0:
            time.sleep(0.002)
        seconds = time.monotonic() - start
        problem = "" if not left else f"still on: {', '.join(left)}"
        if seconds > trial.within and not problem:
            problem = f"after {seconds:.2f} s, {trial.within:g} s are allowed"
        if trial.sent is signal.SIGSTOP:
            process.send_signal(signal.SIGCONT)
            if process.wait(120) != 7:
                problem = problem or f"exit code {process.returncode} after SIGCONT"
            if outputs(rig.control):
                problem = "switched on again after SIGCONT"
        elif trial.sent not in (None, signal.SIGKILL) and process.wait(120) != 130:
            problem = problem or f"exit code {process.returncode}"
    _await_gone(guardians)
    return Found(seconds, problem)


def _await_on(control: ControlClient, process: subprocess.Popen[bytes], count: int, folder: Path) -> None:
    since = time.monotonic()
    while len(found := outputs(control)) < count:
        if process.poll() is not None or time.monotonic() - since > 120:
            said = (folder.parent / f"{folder.name}.txt").read_text()[-500:]
            raise AssertionError(f"the outputs did not all go on: {found}, exit code {process.poll()}: {said}")
        time.sleep(0.01)
    _await_note(folder, "everything is on")


def _await_note(folder: Path, text: str) -> None:
    """Wait until the newest run of a folder has recorded a note."""
    import sqlite3

    since = time.monotonic()
    while time.monotonic() - since < 120:
        runs = sorted(folder.iterdir(), key=lambda each: each.stat().st_mtime)
        with suppress(sqlite3.Error, IndexError):
            db = sqlite3.connect(f"file:{runs[-1] / 'journal.sqlite'}?mode=ro", uri=True)
            found = db.execute("SELECT count(*) FROM events WHERE text = ?", (text,)).fetchone()[0]
            db.close()
            if found:
                return
        time.sleep(0.02)
    raise AssertionError(f"{text!r} was never recorded")


def find_guardians(bench: int) -> list[int]:
    """Return the guardians that a bench has started."""
    return [number for number in _processes(b"bench.guardian") if _parent(number) == bench]


def _processes(word: bytes) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        with suppress(OSError):
            if entry.name.isdigit() and word in (entry / "cmdline").read_bytes():
                found.append(int(entry.name))
    return found


def _parent(number: int) -> int:
    try:
        # After the name in brackets: state and parent.
        return int(Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def _await_gone(processes: list[int]) -> None:
    """Wait until guardians have left the lines."""
    since = time.monotonic()
    while time.monotonic() - since < 30 and any(Path(f"/proc/{number}").exists() for number in processes):
        time.sleep(0.02)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait()


def main() -> int:
    """Print the table; return 0 if every output was safe in time in every trial."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rig", action="append", choices=list(SETPOINTS))
    parser.add_argument("--trial", action="append", choices=list(TRIALS))
    parser.add_argument("--times", type=int, default=10, help="trials of each kind")
    parser.add_argument("--busy", type=int, default=0, help="busy processes beside")
    parser.add_argument("--seed", type=int, default=0, help="of the instants")
    given = parser.parse_args()
    instants = random.Random(given.seed)
    bad = 0
    with ExitStack() as stack:
        for _ in range(given.busy):
            busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(_end, busy)
        print(f"{'rig':8} {'trial':24} {'safe':>7} {'median s':>9} {'longest s':>9} {'allowed s':>9}")
        for name in given.rig or SETPOINTS:
            rig = stack.enter_context(serve(name, clock="x1"))
            for title in given.trial or TRIALS:
                found = []
                for _ in range(given.times):
                    folder = Path(stack.enter_context(TemporaryDirectory())) / "runs"
                    folder.mkdir()
                    found.append(carry_out(rig, TRIALS[title], folder, instants.uniform(0.0, 2.0)))
                good = [each for each in found if not each.problem]
                times = [each.seconds for each in found]
                print(
                    f"{name:8} {title:24} {len(good):3}/{len(found):3} {statistics.median(times):9.3f} "
                    f"{max(times):9.3f} {TRIALS[title].within:9.1f}",
                    flush=True,
                )
                for each in found:
                    if each.problem:
                        bad += 1
                        print(f"         {each.problem}", flush=True)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
