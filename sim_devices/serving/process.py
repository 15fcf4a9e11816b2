"""An emulated rig served by a process of its own, for scripts, `unittest` and pytest.

Example::

    with serve("vo2") as rig:
        line = serial.serial_for_url(rig.port("tec"), 57600, timeout=1.0)
        rig.control.fault("tec-over-current")
        print(rig.control.state()["tec_output"])

A client of the instrument's protocol opens `rig.port("tec")`; `rig.control` reads the true state and injects faults.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from bench.base import BenchError, ConfigurationError, Stopwatch
from bench.rig import ControlClient, Endpoint, read_endpoints

_LONGEST_START = 300.0  # s of wall-clock time; a first start on a busy machine compiles
_LONGEST_END = 30.0
_NAP = 0.05


@dataclass(frozen=True)
class EmulatedRig:
    """A rig that is served.

    Attributes
    ----------
    name : str
        Its name.
    instruments : mapping of str to Endpoint
        Address, protocol and devices of each instrument, by its name.
    control : ControlClient
        The control socket: `state`, `fault`, `plug_in`, `advance` and more.
    endpoints_file : Path
        What `bench run --attach` takes.
    """

    name: str
    instruments: Mapping[str, Endpoint]
    control: ControlClient
    endpoints_file: Path

    def port(self, instrument: str) -> str:
        """Return the address of an instrument, such as `/dev/pts/3`, `socket://127.0.0.1:5020` or `tcp://…`.

        Raises ConfigurationError if there is no such instrument.
        """
        if instrument not in self.instruments:
            raise ConfigurationError(
                f"rig {self.name} has no instrument {instrument!r}; it has: {', '.join(self.instruments)}"
            )
        return self.instruments[instrument].port


@contextmanager
def serve(
    rig: str,
    *,
    clock: str = "x1",
    seed: int = 0,
    tcp: bool = False,
    baud_time: bool = False,
    overrides: Mapping[str, str] | None = None,
    faults: Sequence[Mapping[str, Any]] = (),
) -> Iterator[EmulatedRig]:
    """Serve an emulated rig from a process of its own until the block is left.

    The process also ends if this one does, in any way.

    Parameters
    ----------
    rig : str
        Name of a rig, or path of a rig file.
    clock : str
        `xN` for a laboratory N times as fast as the wall clock, or `wall`, on which time cannot be advanced.
    seed : int
        Seed of all that is random.
    tcp : bool
        Whether serial instruments are on TCP ports, not on pseudo-terminals; always so on Windows.
    baud_time : bool
        Whether bytes take the time of the line's speed.
    overrides : mapping of str to str, optional
        Values of the rig file to replace, by dotted key.
    faults : sequence of mappings
        Faults at instants from now on, with the keys of a schedule: `{"at": 2.0, "fault": "tec.drop"}`.

    Raises
    ------
    ConfigurationError
        If the rig cannot be served, or has no such fault; the message is that of `bench rig emulate`.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="bench-emulate-")))
        endpoints_file, output = folder / "endpoints.json", folder / "output.txt"
        options = ["--clock", clock, "--seed", str(seed), "--json", str(endpoints_file)]
        options += ["--tcp"] * tcp + ["--baud-time"] * baud_time
        options += [f"--override={key}={value}" for key, value in (overrides or {}).items()]
        # -P: a folder of the caller's project may have the name of one of the bench's packages.
        command = [sys.executable, "-P", "-m", "bench", "rig", "emulate", rig, *options]
        with output.open("wb") as file:
            process = subprocess.Popen(  # noqa: S603
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT
            )
        stack.callback(_end, process)
        _await(endpoints_file, process, output)
        endpoints = read_endpoints(endpoints_file)
        (served,) = endpoints.served.values()
        control = ControlClient(endpoints.control)
        stack.callback(_stop, control)
        control.request("end-with-connection")
        if faults:
            control.request("schedule", faults=[*map(dict, faults)])
        yield EmulatedRig(served.rig, served.instruments, control, endpoints_file)


def _await(file: Path, process: subprocess.Popen[bytes], output: Path) -> None:
    """Wait until the server is ready."""
    waited = Stopwatch()
    while not file.exists():
        with suppress(subprocess.TimeoutExpired):
            process.wait(_NAP)
            text = output.read_text(encoding="utf-8", errors="replace").strip().removeprefix("error: ")
            raise ConfigurationError(text or f"bench rig emulate ended with exit code {process.returncode}")
        if waited.seconds() > _LONGEST_START:
            raise ConfigurationError(f"bench rig emulate was not ready within {_LONGEST_START:.0f} s")


def _stop(control: ControlClient) -> None:
    with suppress(BenchError):
        control.request("stop")
    control.close()


def _end(process: subprocess.Popen[bytes]) -> None:
    try:
        process.wait(_LONGEST_END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
