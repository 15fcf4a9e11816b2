"""A station whose devices a guardian holds, in another process."""

from __future__ import annotations

import faulthandler
import math
import os
import subprocess
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, TextIO

import numpy as np
from pydantic import TypeAdapter

from bench.base import STACKS, AbortError, BenchError, Clock, GuardianError, Stopwatch, WallClock
from bench.devices import DeviceDescription, Floats, Signal
from bench.execution.guardian.channel import LONGEST_ANSWER, ChannelError, Message, to_error
from bench.execution.guardian.rescuer import SILENCE, Report, Rescuer
from bench.execution.guardian.start import start_guardian
from bench.execution.station.interface import Arrivals, News, Station
from bench.rig import Look, RigDescription, RigFile

_OPENING = 120.0
"""Longest wait until all devices are connected, s."""

_RESCUE = 20.0
"""Longest wait for what a rescuer reports, s; it reports within 3 s unless the machine is busy."""

_LONGEST_RESCUE = 60.0
"""Longest wait for one that is started only then, on a busy machine, s."""

_LOOK_AGAIN = 0.05
"""Time between two looks for that, s."""

_END = 5.0
"""Longest wait for the safe state of all devices, s."""

_ABORT = 1.0
"""Time that an answer may take once the run has to end, s; shorter than that after which the process is left."""

_SLICE = 0.2
"""Longest single wait, s, so that a signal to the process is noticed soon."""

STACKS_NAME = "stacks.txt"


class RemoteStation(Station):
    """A station in another process.

    One request is outstanding at a time, and each has a number. If the guardian is lost, its rescuer makes the
    devices safe, or another one if there is none; this process never opens a line.

    Parameters
    ----------
    clock : Clock
        The clock of the run.
    file : RigFile
        The rig, as this process has read it.
    rig, overrides
        Name or path of the rig file that the guardian is to open, and values of it to replace, by dotted key.
    attach : Path or None
        Endpoints file of `bench rig emulate`, where the instruments are served.
    seed : int
        Seed of everything random in an emulated laboratory.
    doing : str
        Purpose in a few words, shown to whoever finds the rig in use.

    Raises
    ------
    ConfigurationError
        If the rig file is wrong, or the rig is in use.
    DeviceError
        If a device cannot be connected; nothing has moved.
    GuardianError
        If the guardian does not start.
    """

    def __init__(
        self,
        clock: Clock,
        file: RigFile,
        rig: str,
        overrides: Mapping[str, str],
        attach: Path | None,
        seed: int,
        doing: str,
    ) -> None:
        self.clock = clock
        self._answer_within = LONGEST_ANSWER + file.safety.reconnect
        self._number = 0
        self._news: list[News] = []
        self._tripped: BenchError | None = None
        self._promised: tuple[float, str] | None = None
        self._setpoints: dict[str, float] = {}
        self._safe: Mapping[str, str] | None = None
        self._is_holding = False
        self._pause = ""
        self._stacks: TextIO | None = None
        self._is_told = False
        self._keeps_record = False
        self._lost: GuardianError | None = None
        self._last_words = ""
        # On Windows what is still open cannot be deleted.
        self._scratch = tempfile.TemporaryDirectory(prefix="bench-rescuer-", ignore_cleanup_errors=True)
        self._report = Report(Path(self._scratch.name) / "report.json")
        self._what = {
            "rig": rig,
            "overrides": dict(overrides),
            "attach": None if attach is None else str(attach),
            "report": str(self._report.path),
            "process": os.getpid(),
        }
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        self._process, self._channel = start_guardian(self._log)
        try:
            found = self._ask(
                "hello",
                _OPENING,
                **self._what,
                content=repr(file.content),
                seed=seed,
                doing=doing,
            )
        except BaseException as error:
            self.close()
            if isinstance(error, GuardianError) and (said := self._last_words):
                raise GuardianError(f"{error}; it said: {said}") from None
            raise
        self.description = _description(file, found)
        self._setpoints = dict.fromkeys(self.description.limits, math.nan)

    @property
    def has_operator(self) -> bool:
        """Whether an emulated laboratory does what a prompt asks for."""
        return self.description.file.emulated

    @property
    def is_holding(self) -> bool:
        """Whether an interlock has the set-points stand until its signal is back."""
        return self._is_holding

    def take_pause(self) -> str:
        """Return why an interlock asks for a pause, once; empty if none does."""
        pause, self._pause = self._pause, ""
        return pause

    @property
    def is_told(self) -> bool:
        """Whether the guardian has told that this process hung."""
        return self._is_told

    def keep_record(
        self,
        folder: Path,
        targets: Sequence[str] = (),
        facts: Mapping[str, str] = MappingProxyType({}),
        epoch: str | None = None,
    ) -> None:
        """Have the guardian keep its own record in the folder of the run, and speak for this process if it cannot.

        If this process breaks a promise, the guardian has it write there where each of its threads stands, and ends
        it if it does not come back. If it hung or is gone, the guardian tells so: to the `targets`, see
        `bench.execution.notify`, with the `facts` in each message. `epoch` is the time of day of the laboratory at
        the start of the run, ISO 8601; now if not given.
        """
        if STACKS is not None:
            self._stacks = (folder / STACKS_NAME).open("w", encoding="utf-8")
            faulthandler.register(STACKS, self._stacks)
        self._ask(
            "record",
            folder=str(folder.resolve()),
            stacks=STACKS is not None,
            targets=list(targets),
            facts=dict(facts),
            epoch=epoch or self.clock.date().isoformat(),
        )
        self._keeps_record = True

    def promise(self, seconds: float, why: str) -> None:
        """Promise that each request from now on is followed by the next one within so many seconds."""
        if (seconds, why) != self._promised:
            self._ask("promise", seconds=seconds, why=why)
            self._promised = seconds, why

    def look(self, look: Look, wanted: Collection[str] = ()) -> dict[str, float]:
        """Read the devices; values by signal name."""
        values: dict[str, float] = self._ask("look", look=look.value, wanted=list(wanted))
        return values

    def quick_reader(self, wanted: Collection[str]) -> Callable[[], dict[str, float]]:
        """Return a function that takes a quick reading of the devices that some signals come from."""
        names = list(wanted)
        return lambda: self._ask("look", look=Look.PART.value, wanted=names)

    def mover(self, actuators: Sequence[str]) -> Callable[[Sequence[float]], None]:
        """Return a function that sends those of some set-points that have changed."""

        def move(setpoints: Sequence[float]) -> None:
            changed = {
                name: value
                for name, value in zip(actuators, setpoints, strict=True)
                if value != self._setpoints.get(name)
            }
            if changed:
                self.apply(changed)

        return move

    def block_player(
        self, inputs: Sequence[str], actuators: Sequence[str], period: float
    ) -> Callable[[Floats], Floats] | None:
        """Return what has an instrument carry out blocks of samples by itself; None if none can."""
        asked: dict[str, Any] = {"inputs": list(inputs), "actuators": list(actuators), "period": period}
        if not self._ask("can-play", **asked):
            return None

        def play(setpoints: Floats) -> Floats:
            rows = self._ask("play", setpoints=setpoints.tolist(), **asked)
            self._setpoints[actuators[0]] = float(setpoints[-1, 0])
            return np.array(rows, dtype=np.float64)

        return play

    def check(self, setpoints: Mapping[str, Sequence[float]]) -> None:
        """Raise LimitError if a device does not take one of its set-points; nothing is sent."""
        self._ask("check", setpoints={name: list(values) for name, values in setpoints.items()})

    def apply(self, setpoints: Mapping[str, float]) -> None:
        """Send set-points; all are checked before any is sent."""
        sent = self._ask("apply", setpoints={name: float(value) for name, value in setpoints.items()})
        self._setpoints.update(sent)

    def rest(self) -> None:
        """Bring every device into its safe state for a while."""
        self._ask("rest")

    def tare(self, device: str) -> None:
        """Make the present force of a load cell read zero."""
        self._ask("tare", device=device)

    def setpoint(self, device: str) -> float:
        """Return the set-point that was last sent to a device; nan before the first."""
        return self._setpoints[device]

    def arrivals(self) -> Arrivals:
        """Ask the devices that were sent set-points last how far they have come."""
        found = self._ask("arrivals")
        error = found["error"]
        return Arrivals(tuple(found["waiting"]), None if error is None else to_error(error))

    def judge(self, t: float, values: Mapping[str, float]) -> None:  # noqa: ARG002 - the guardian has judged them
        """Raise what has tripped the station, now that the readings are recorded."""
        if self._tripped is not None:
            raise self._tripped

    def sleep_until(self, instant: float) -> None:
        """Let laboratory time pass up to an instant, s."""
        self.clock.sleep_until(instant)

    def operate(self, task: str, value: float) -> None:
        """Have done by hand, in an emulated laboratory, what a prompt asks for."""
        self._ask("operate", task=task, value=value)

    def news(self) -> list[News]:
        """Return what happened since the last call, oldest first."""
        news, self._news = self._news, []
        return news

    def end(self) -> Mapping[str, str]:
        """Bring every device into its safe state; return by device `safe`, or what went wrong."""
        if self._safe is None:
            try:
                self._safe = self._ask("end", _END)
            except BenchError as error:
                self._safe = self._rescued(error)
        return self._safe

    def close(self) -> None:
        """Leave the guardian, which ends once every device is safe."""
        if self._stacks is not None and STACKS is not None:
            faulthandler.unregister(STACKS)
            self._stacks.close()
            path = Path(self._stacks.name)
            # The folder may be gone.
            with suppress(OSError):
                if not path.stat().st_size:
                    path.unlink()
            self._stacks = None
        if self._log.closed:
            return
        if self._keeps_record and self._safe is None:
            # A run that was refused has not died.
            with suppress(BenchError):
                self._ask("end", _END)
        self._channel.close()
        if not self._has_ended():
            # It goes on until what is not safe yet is safe.
            self._process.returncode = 0
        self._scratch.cleanup()
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").splitlines()
        self._last_words = lines[-1] if lines else ""
        self._log.close()

    def _has_ended(self) -> bool:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_END)
        return self._process.returncode is not None

    def _rescued(self, error: BenchError) -> Mapping[str, str]:
        """Make sure that the guardian is dead, and make the devices safe without it."""
        self._process.kill()
        self._has_ended()
        self._news.append(News("ERROR", "guardian", f"{error}; the devices are made safe without it"))
        states = self._reported(_RESCUE)
        if not states:
            self._report.write({})
            try:
                Rescuer({**self._what, "guardian": 0}).leave()
            except GuardianError as failure:
                return dict.fromkeys(self.description.devices, str(failure))
            states = self._reported(_LONGEST_RESCUE)
        return states or dict.fromkeys(self.description.devices, "no rescuer has said whether it is safe")

    def _reported(self, longest: float) -> Mapping[str, str]:
        """Return what a rescuer reports; nothing if there is none, or it says nothing for so long."""
        waited = Stopwatch()
        while self._report.is_ready() and waited.seconds() < longest:
            if states := self._report.take():
                return states
            WallClock().sleep(_LOOK_AGAIN)
        return {}

    def _ask(self, do: str, within: float | None = None, **content: Any) -> Any:  # noqa: ANN401 - what JSON holds
        """Send a request and return what is replied.

        Raises BenchError as the guardian answers or what has tripped the station, and GuardianError if the guardian
        is gone or does not answer.
        """
        if self._tripped is not None and do != "end":
            raise self._tripped
        if self._lost is not None:
            raise self._lost
        self._number += 1
        waited, silent = Stopwatch(), 0.0
        silence = within or SILENCE
        within = within or self._answer_within
        try:
            self._channel.send({"n": self._number, "do": do, **content})
            while True:
                if self._channel.wait(_SLICE):
                    for reply in self._channel.receive():
                        if reply.get("n") == self._number:
                            return self._taken(reply)
                    silent = 0.0
                else:
                    # Not the time in which this process got no processor: the guardian may not have got one either.
                    silent += _SLICE
                    if silent > silence:
                        raise ChannelError(f"it has said nothing for {silence:g} s")
                if waited.seconds() > within:
                    raise ChannelError(f"it has not answered for {within:g} s")
                if do != "end" and self.clock.interrupted() and waited.seconds() > _ABORT:
                    raise AbortError(f"ended while the guardian had not answered for {waited.seconds():.0f} s")
        except ChannelError as error:
            # What it answers from now on is not asked for any more.
            self._lost = GuardianError(f"the guardian, which holds the lines of the instruments, was lost: {error}")
            raise self._lost from None

    def _taken(self, reply: Message) -> Any:  # noqa: ANN401 - what JSON holds
        self._news += [News(**each) for each in reply.get("news", ())]
        self._is_holding = bool(reply.get("holding"))
        self._pause = reply.get("pause") or self._pause
        self._is_told = bool(reply.get("told"))
        if reply.get("tripped") is not None:
            self._tripped = to_error(reply["tripped"])
        if "error" in reply:
            raise to_error(reply["error"])
        return reply["result"]


def _description(file: RigFile, found: Message) -> RigDescription:
    kinds = {entry.name: entry.driver for entry in file.devices}
    known = TypeAdapter(DeviceDescription)
    devices = {
        name: known.validate_python({**content, "kind": kinds[name]}) for name, content in found["devices"].items()
    }
    return RigDescription(file, devices, TypeAdapter(tuple[Signal, ...]).validate_python(found["signals"]))
