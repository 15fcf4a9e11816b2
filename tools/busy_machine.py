"""Trials of emulated runs on a busy machine; each ends with a line that says whether it passed.

    python tools/busy_machine.py [--trial runs|clock|study ...] [--busy 16] [--runs 50]

- `runs`: virtual runs beside busy processes, whose records have to be equal to the last bit.
- `clock`: a run at a scaled clock beside them, which has to complete; shows the factor that it reached.
- `study`: a study of the lowest priority beside four of them, which also has to compile every kernel: its numbers
  have to be those of the same without them. It takes as long as the scheduler lets it: minutes on Linux, where
  sessions share the processors, up to hours where it does not (`kernel.sched_autogroup_enabled=0`).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from bench.record import Record

SHORT = ["--set", "hot=70", "--set", "cool=50"]
PROCESSES, RUNS_EACH = 4, 5
"""Processes of virtual runs at a time, and how many runs one carries out: most of a short run is the start of its
process."""
LONG_HOLD = 300.0
"""Time of either hold of the run at a scaled clock, s: seconds at x100."""
LOCAL = ("wall_seconds", "folder", "figures", "recordings")
"""What two studies with the same numbers do not share."""
CARRY_OUT = """
import sys
from bench.cli import main
for folder in sys.argv[1].split("\\n"):
    try:
        main([*sys.argv[2:], "--out", folder])
    except SystemExit as exit:
        if exit.code:
            raise
"""


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """Keep the processors busy."""
    with ExitStack() as stack:
        for _ in range(processes):
            # Sessions of their own, as of other terminals: Linux shares the processors among these, and a low
            # priority counts within one only.
            command = [sys.executable, "-S", "-c", "while True: pass"]
            loop = stack.enter_context(subprocess.Popen(command, start_new_session=True))
            stack.callback(loop.kill)
        yield


def carry_out(
    rig: str,
    clock: str,
    folders: Sequence[Path],
    cache: Path | None = None,
    hold: float = 8.0,
    patience: float = 280.0,
) -> subprocess.CompletedProcess[str]:
    """Carry runs of two holds (s) out in a process of their own, one after the other, each in a folder."""
    for folder in folders:
        folder.mkdir(parents=True)
    command = ["run", "creep", "--rig", rig, "--clock", clock, *SHORT, "--set", f"duration={hold:g}", "--seed", "3"]
    result = subprocess.run(
        [sys.executable, "-c", CARRY_OUT, "\n".join(map(str, folders)), *command],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=patience,
        env=os.environ | ({"NUMBA_CACHE_DIR": str(cache)} if cache else {}),
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result


def run(rig: str, clock: str, folder: Path, cache: Path | None = None, hold: float = 8.0) -> tuple[Path, str, str]:
    """Carry a run of two holds (s) out in a process of its own; return the folder of its record and its output."""
    result = carry_out(rig, clock, [folder], cache, hold)
    (record,) = folder.iterdir()
    return record, result.stdout, result.stderr


def fingerprint(folder: Path) -> str:
    """Return a hash of every bit of the readings and set-points of a run, and of their times."""
    digest = hashlib.sha256()
    with Record(folder) as record:
        assert record.status == "completed"
        for table in (record.steps(), record.telemetry()):
            assert len(table) > 0
            for name, column in table.columns.items():
                digest.update(name.encode() + column.tobytes())
        for step in record.step_records():
            digest.update(json.dumps(dict(step.setpoints)).encode() + struct.pack("<dd", step.started, step.finished))
    return digest.hexdigest()


def try_runs(folder: Path, options: argparse.Namespace) -> str:
    """Return what is wrong with virtual runs beside busy processes; nothing if they are equal."""
    folders = [folder / str(number) for number in range(options.runs)]
    shares = [folders[begin : begin + RUNS_EACH] for begin in range(0, len(folders), RUNS_EACH)]
    with busy(options.busy), ThreadPoolExecutor(PROCESSES) as pool:
        for done, _ in enumerate(pool.map(partial(carry_out, options.rig, "virtual", patience=3600.0), shares), 1):
            print(f"  {min(done * RUNS_EACH, options.runs)} of {options.runs} runs", flush=True)
    different = len({fingerprint(record) for each in folders for record in each.iterdir()})
    return "" if different == 1 else f"there are {different} different records among {options.runs} runs"


def try_clock(folder: Path, options: argparse.Namespace) -> str:
    """Return what is wrong with a run at a scaled clock beside busy processes; nothing if it completes."""
    with busy(options.busy):
        record, _, _ = run(options.rig, options.clock, folder / "scaled", hold=LONG_HOLD)
    with Record(record) as journal:
        print("  clock:", next(event.text for event in journal.events() if event.kind == "clock"))
        return "" if journal.status == "completed" else f"the run is {journal.status}"


def try_study(folder: Path, options: argparse.Namespace) -> str:
    """Return what is wrong with a study of the lowest priority beside busy processes; nothing if its numbers hold."""
    alone = _study(options.study, folder / "alone", {})
    nice = [] if os.name == "nt" else ["nice", "-n", "19"]
    with busy(options.loops):
        beside = _study(options.study, folder / "beside", {"NUMBA_CACHE_DIR": str(folder / "cache")}, *nice)
    different = sorted(name for name in alone.keys() | beside.keys() if alone.get(name) != beside.get(name))
    return f"other than alone: {', '.join(different)}" if different else ""


def _study(name: str, folder: Path, environment: Mapping[str, str], *prefix: str) -> dict[str, Any]:
    """Carry a study out; return its numbers."""
    folder.mkdir()
    result = folder / "result.json"
    command = [*prefix, sys.executable, "-m", "bench", "study", name, "--out", str(folder), "--json", str(result)]
    begin = time.monotonic()
    with (folder / "output.txt").open("w") as output:
        done = subprocess.run(command, stdout=output, stderr=output, env=os.environ | environment, check=False)
    print(f"  {folder.name}: exit {done.returncode} after {time.monotonic() - begin:.0f} s", flush=True)
    assert done.returncode == 0, (folder / "output.txt").read_text()
    values: dict[str, Any] = json.loads(result.read_text())
    return {name: value for name, value in values.items() if name not in LOCAL}


TRIALS = {"runs": try_runs, "clock": try_clock, "study": try_study}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trial", nargs="+", choices=TRIALS, default=["runs", "clock"])
    parser.add_argument("--rig", default="vo2")
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--busy", type=int, default=16, help="busy processes beside the runs")
    parser.add_argument("--clock", default="x100", help="clock of the trial `clock`")
    parser.add_argument("--study", default="hybrid", help="study of the trial `study`")
    parser.add_argument("--loops", type=int, default=4, help="busy processes beside that study")
    options = parser.parse_args()
    failed = []
    for name in options.trial:
        begin = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            try:
                problem = TRIALS[name](Path(folder), options)
            except (AssertionError, subprocess.TimeoutExpired) as error:
                problem = str(error)
        verdict = f"failed: {problem}" if problem else "passed"
        print(f"{name}: {verdict} ({time.monotonic() - begin:.0f} s)", flush=True)
        failed += [name] if problem else []
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
