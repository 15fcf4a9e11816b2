"""Carries out what an operator does by hand, under the limits and interlocks of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping

from bench.base import ConfigurationError, LimitError
from bench.devices import Settled
from bench.execution.run_at_hand import RunAtHand
from bench.operator import Command, Desk, HoldAll, Leave, Remark, Rest, SetPoint, Shown, Tare
from bench.protocol import ByHand, Reading

_PERIOD = 0.5
"""Longest time between two looks for a command, s."""


def carry_out(run: RunAtHand, message: ByHand) -> Reading:
    """Carry commands out until the operator leaves; each that sends something is a step of the record.

    A command that is refused is said, and nothing is sent. What a device or an interlock raises ends the run.
    """
    hands = _Hands(run, message.desk)
    rig = run.station.description
    message.desk.shown = Shown(rig.file.name, rig.signals, rig.limits, tuple(rig.file.interlocks))
    period = min(run.period, _PERIOD)
    run.expect_ticks("the operator moves the rig by hand")
    while True:
        now = run.clock.now()
        while (command := message.desk.take()) is not None:
            if isinstance(command, Leave):
                return hands.leave()
            hands.obey(command)
        if hands.look_for_pauses():
            return hands.leave()
        hands.advance()
        message.desk.ticks.append((run.clock.now() - run.zero, run.tick()))
        run.sleep_until(now + period)


class _Hands:
    def __init__(self, run: RunAtHand, desk: Desk) -> None:
        self._run = run
        self._desk = desk
        self._ramps: dict[str, tuple[SetPoint, float, float]] = {}
        """Ramps under way by device: the command, where and when it began."""

    def obey(self, command: Command) -> None:
        """Carry a command out, or say why not."""
        try:
            if isinstance(command, SetPoint):
                self._set(command)
            elif isinstance(command, HoldAll):
                self._stop_ramps("hold")
            elif isinstance(command, Rest):
                self._stop_ramps("")
                self._run.switch_off()
            elif isinstance(command, Tare):
                self._run.station.tare(command.device)
                self._run.event("INFO", "remark", f"by hand: {command.device} tared")
            elif isinstance(command, Remark):
                self._run.event("INFO", "remark", command.text)
        except (ConfigurationError, LimitError) as error:
            self._desk.say(f"refused: {error}")

    def _set(self, command: SetPoint) -> None:
        run = self._run
        limits = run.station.description.limits_of(command.device)
        run.station.check({command.device: (command.value,)})
        if run.station.is_holding:
            raise ConfigurationError("an interlock holds the set-points until its signal is back")
        self._ramps.pop(command.device, None)
        if math.isinf(command.rate):
            self._send({command.device: command.value}, "set")
            return
        present = run.station.setpoint(command.device)
        if math.isnan(present):
            raise ConfigurationError(
                f"{command.device} has no set-point that a ramp could begin at; set one ({limits}) first"
            )
        self._ramps[command.device] = command, present, run.clock.now()
        run.event(
            "INFO",
            "remark",
            f"by hand: ramp of {command.device} from {present:g} to {command.value:g} {limits.unit} by "
            f"{command.rate:g} {limits.unit}/s",
        )

    def _send(self, setpoints: Mapping[str, float], label: str) -> None:
        run = self._run
        started = run.clock.now()
        run.station.apply(setpoints)
        run.measure_step(started, label, setpoints, Settled.UNRECORDED)

    def advance(self) -> None:
        """Send what the ramps have come to."""
        if self._run.station.is_holding:
            return
        now = self._run.clock.now()
        for device, (command, start, since) in [*self._ramps.items()]:
            way = command.value - start
            passed = command.rate * (now - since)
            if passed < abs(way):
                self._run.station.apply({device: start + math.copysign(passed, way)})
            else:
                del self._ramps[device]
                self._send({device: command.value}, "ramp")

    def look_for_pauses(self) -> bool:
        """Stop the ramps where an interlock asks for a pause; return whether the system asks for the end."""
        ends, why = self._run.take_pause()
        if why:
            self._stop_ramps(why)
        return ends

    def _stop_ramps(self, why: str) -> None:
        for device in self._ramps:
            self._run.event("INFO", "remark", f"by hand: ramp of {device} stopped{f': {why}' if why else ''}")
        self._ramps.clear()

    def leave(self) -> Reading:
        """Return the last reading."""
        return self._run.measure_step(self._run.clock.now(), "end", {}, Settled.UNRECORDED)
