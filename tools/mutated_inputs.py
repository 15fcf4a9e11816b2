"""Mutated inputs of every kind that the bench reads: no traceback, bounded time and memory, no silent change.

    python tools/mutated_inputs.py --times 5000 --seed 0

Each input is a file, a line or a record that is changed at random, and is given to the command that reads it, most in
this process and one in a hundred in a process of its own. It has to be refused with a message, or taken as it is: a
row of a file is read or reported, and a number is what the file says. Inputs that fail are left in a folder, with
what went wrong. The same seed and number give the same input.
"""

import argparse
import faulthandler
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import commands
import mutated_data
import mutated_documents
import mutated_lines
import mutated_records

LONGEST, HANGING = 60, 600
"""Processor time of an input, and wall-clock time after which it hangs, as on a machine that is busy, s."""
MOST_MEMORY = 2 << 30
"""Memory that an input may take, bytes."""
IN_A_PROCESS = 100
"""One input of so many is tried in a process of its own as well."""

Trial = Callable[[Path, random.Random], str]


def all_kinds() -> dict[str, Trial]:
    """Return what tries an input of each kind: it returns what is wrong, empty if nothing is."""
    modules = mutated_data, mutated_documents, mutated_records, mutated_lines
    return {name: trial for module in modules for name, trial in module.KINDS.items()}


class SlowError(Exception):
    """An input took too long."""


def processes_time() -> float:
    """Return the processor time of the processes that were started and have ended, s."""
    return sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])


@contextmanager
def bounded():
    """End what takes longer than an input may, or more memory."""

    def end(number: int, _: object) -> None:
        raise SlowError(f"more than {LONGEST if number == signal.SIGPROF else HANGING} s")

    timers = {signal.SIGPROF: (signal.ITIMER_PROF, LONGEST), signal.SIGALRM: (signal.ITIMER_REAL, HANGING)}
    before = {number: signal.signal(number, end) for number in timers}
    for timer, seconds in timers.values():
        signal.setitimer(timer, seconds)
    began = processes_time()
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_MEMORY, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        for number, (timer, _) in timers.items():
            signal.setitimer(timer, 0)
            signal.signal(number, before[number])
    if processes_time() - began > LONGEST:
        raise SlowError(f"its processes took more than {LONGEST} s")


def try_input(kind: str, number: int, seed: int, folder: Path) -> str:
    """Try an input; return what is wrong, empty if nothing is. The folder has what it consists of."""
    rng = random.Random(f"{kind} {seed} {number}")
    try:
        with bounded():
            return all_kinds()[kind](folder, rng)
    except Exception as error:
        if isinstance(error, commands.UnclearError):
            return str(error)
        return traceback.format_exc()


def main() -> None:
    """Try the inputs, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--times", type=int, default=5000, help="inputs of all kinds together")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", choices=list(all_kinds()), help="only this one; repeatable")
    parser.add_argument("--failing", type=Path, default=Path("mutated-inputs"), help="folder for inputs that fail")
    options = parser.parse_args()
    faulthandler.enable()
    names = options.kind or list(all_kinds())
    # Kernels are compiled for these, which is no input's time.
    mutated_documents.models()
    mutated_records.records()
    tried, failed, begin = Counter(), Counter(), time.monotonic()
    seconds = Counter()
    for done in range(options.times):
        number = options.first + done
        kind = names[number % len(names)]
        started = time.monotonic()
        commands.in_a_process = number // len(names) % IN_A_PROCESS == IN_A_PROCESS - 1
        with tempfile.TemporaryDirectory(prefix="mutated-") as place:
            wrong = try_input(kind, number, options.seed, Path(place))
            if wrong:
                failed[kind] += 1
                kept = options.failing / f"{kind}-{options.seed}-{number}"
                shutil.rmtree(kept, ignore_errors=True)
                shutil.copytree(place, kept, ignore_dangling_symlinks=True)
                (kept / "wrong.txt").write_text(wrong, encoding="utf-8", errors="backslashreplace")
                print(f"{kept}: {wrong.strip().splitlines()[-1][:200]}", flush=True)
        tried[kind] += 1
        seconds[kind] += time.monotonic() - started
        if done % 50 == 49:
            left = (time.monotonic() - begin) / (done + 1) * (options.times - done - 1)
            print(
                f"{done + 1} of {options.times}, {failed.total()} failed, {left:.0f} s to go",
                file=sys.stderr,
                flush=True,
            )
    print(f"{'kind':12} {'inputs':>7} {'failed':>7} {'ms each':>8}")
    for kind in names:
        print(f"{kind:12} {tried[kind]:7} {failed[kind]:7} {1e3 * seconds[kind] / max(1, tried[kind]):8.0f}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
