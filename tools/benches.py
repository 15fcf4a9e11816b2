"""What a bench does to a guardian, for tests and scripts."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from bench.execution.guardian.remote import RemoteStation
from bench.rig import attach, load_rig
from sim_devices.serving.process import EmulatedRig

LONG = 60.0
"""Wall-clock time that a busy machine may take, s."""

TOOLS = Path(__file__).parent
"""Where the scripts are that tests start as processes."""

IN_TIME = 10.0
"""Time beyond the declared one within which an output has to be off on a busy machine, s."""

_WAIT = 0.005
"""Single wait, s."""


@contextmanager
def connected(rig: EmulatedRig, file: str | None = None, **overrides: str) -> Iterator[RemoteStation]:
    """Open a served rig by a guardian, which is gone after the block."""
    values = {key.replace("__", "."): value for key, value in overrides.items()}
    name = file or rig.name
    with ExitStack() as stack:
        attachment = attach(rig.endpoints_file, rig.name)
        stack.callback(attachment.close)
        file = load_rig(name, values)
        station = RemoteStation(attachment.clock, file, name, values, rig.endpoints_file, 0, "a test")
        # While it can be found: nobody knows the rescuer of a guardian that has died.
        stack.callback(_leave, station, rescuer_of(station._process.pid))
        yield station


def _leave(station: RemoteStation, rescuer: int) -> None:
    # One that has ended needs no rescue, which would be a second process in each test.
    if station._process.returncode is None:
        station.clock.interrupted = lambda: False
        station.end()
    station.close()
    with suppress(ProcessLookupError):
        os.kill(station._process.pid, signal.SIGKILL)
    # Until then it may hold the rig.
    seconds_until(lambda: not is_alive(rescuer))


def rescuer_of(guardian: int) -> int:
    """Return the process that makes safe what a guardian cannot, by the pipe between them; 0 if there is none."""
    pipes = {
        link for link in map(_link, (Path("/proc") / str(guardian) / "fd").iterdir()) if link.startswith("pipe:")
    }
    readers = (entry for entry in Path("/proc").glob("[0-9]*") if _link(entry / "fd" / "0") in pipes)
    return next((int(each.name) for each in readers if int(each.name) != guardian), 0)


def _link(descriptor: Path) -> str:
    with suppress(OSError):
        return str(descriptor.readlink())
    return ""


def is_alive(process: int) -> bool:
    """Whether a process lives; one that nobody has waited for does not."""
    try:
        stat = (Path("/proc") / str(process) / "stat").read_text()
    except OSError:
        return False
    return stat.rpartition(")")[2].split()[0] != "Z"


def is_on(rig: EmulatedRig) -> bool:
    """Whether the true output of the TEC is on."""
    return bool(rig.control.state()["tec_output"])


def check_at_once(names: Iterable[str], check: Callable[[str], None]) -> None:
    """Carry checks out beside each other, as each mostly waits; all that fail are named."""
    with ThreadPoolExecutor(16) as pool:
        pending = {name: pool.submit(check, name) for name in names}
    failures = {name: error for name, future in pending.items() if (error := future.exception()) is not None}
    if failures:
        raise BaseExceptionGroup(f"failed: {', '.join(failures)}", [*failures.values()])


def seconds_until(condition: Callable[[], bool], longest: float = LONG) -> float:
    """Wait until something is so; return for how long, s.

    The waits count as long as they were to be: on a busy machine they are longer, and so is what is waited for.
    """
    waits = 0
    while not condition():
        assert waits * _WAIT < longest, f"not within {longest:g} s"
        time.sleep(_WAIT)
        waits += 1
    return waits * _WAIT
