"""Let a signal cross its limit, and read in the instruments when every output is off.

    python tools/interlock_times.py [--rig RIG]... [--case TEXT]... [--times N] [--busy N]

prints a table: for each interlock of each rig, while the protocol holds and while it computes, how often every output
was off in time, and the median and longest time from when the interlock had to act until then. That is the instant at
which the signal crosses its limit, in the plant's true state or by an injected fault, and the interlock's `seconds`
(`stale`, `within`) later. A look at 5 Hz and 0.1 s for the safe state are allowed after it. All times are those of
the laboratory, which `bench rig emulate` serves at the speed of the wall clock.

Limits and times of an interlock are replaced where it would not act within seconds, or a device would report an error
of its own first; what it asks for stays of its kind.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any

from guarded_run import HEADS, SETPOINTS, Found, GuardedRun, find_guardian, on, report, start_busy, trials_parser

from bench.rig import load_rig
from sim_devices.serving.process import EmulatedRig, serve

SAFE_WITHIN = 0.1
"""Time that the safe state may take, s."""

LONGEST = 90.0
"""Longest time from the start of a run, s."""

REST = 300.0
"""Laboratory time between two trials, in which the plant comes to rest, s."""

SINK_STEP = 128.0 / 2**12
"""Resolution in which the TEC controller gives the temperature of its sink, K."""


@dataclass(frozen=True)
class Crossing:
    """A quantity of the plant's true state and the limit that it crosses, upwards or downwards."""

    quantity: str
    limit: float
    upwards: bool = True

    def is_beyond(self, values: Mapping[str, Any]) -> bool:
        """Return whether it is beyond its limit."""
        value = values[self.quantity]["value"]
        return value > self.limit if self.upwards else value < self.limit


@dataclass(frozen=True)
class Case:
    """One thing that one interlock asks for, and how it is violated.

    Attributes
    ----------
    interlock : int
        Which of the interlocks of its rig.
    title : str
        What it asks for: range, stale or stuck.
    seconds : float
        Time after the crossing at which it has to act, s.
    changes : mapping
        Keys of the interlock that are replaced.
    crossing : Crossing or None
        Where the signal crosses its limit; None if that is at the instant of the fault, or of the set-point if the
        fault comes first.
    setpoints, then : mapping
        Set-points with which everything is on, and those that are sent afterwards.
    fault : str
        Fault that lets the signal cross its limit; empty if a set-point does.
    values : mapping
        What is chosen of it.
    fault_first : bool
        Whether the fault comes before the set-point that makes it felt.
    """

    interlock: int
    title: str
    seconds: float
    changes: Mapping[str, Any] = field(default_factory=dict)
    crossing: Crossing | None = None
    setpoints: Mapping[str, float] | None = None
    then: Mapping[str, float] = field(default_factory=dict)
    fault: str = ""
    values: Mapping[str, float] = field(default_factory=dict)
    fault_first: bool = False


def cases(rig: EmulatedRig) -> list[Case]:
    """Return what the interlocks of a rig ask for; the plant is at rest."""
    sink = _half_step_above(rig) if rig.name != "sma" else 0.0
    warm_sink = {"high": sink, "seconds": 2.0}, Crossing("sink_temperature", sink)
    frozen = {"stale": 3.0}
    on = SETPOINTS[rig.name]
    return {
        "vo2": [
            Case(0, "range", 0.0, {"high": 35.0}, Crossing("plate_temperature", 35.0), {"tec": 22.0}, {"tec": 45.0}),
            # The set-point moves the plate by nothing, as no current flows.
            Case(1, "stuck", 3.0, _stuck(5.0, 1.0), None, {"tec": 22.0}, {"tec": 40.0}, "supply-clipped",
                 {"amperes": 0.0}, fault_first=True),
            Case(2, "range", 2.0, *warm_sink, {"tec": 22.0}, {"tec": 15.0}),
            Case(3, "range", 1.0, {"high": 1.0}, Crossing("tec_current", 1.0), {"tec": 22.0}, {"tec": 80.0}),
            Case(4, "stale", 3.0, frozen, fault="psd.freeze"),
        ],
        "sma": [
            # The filter of the load cell has come so far after some 10 ms.
            Case(0, "range", 0.0, {"high": 4.0}, fault="force.out-of-range", values={"value": 12.0}),
            Case(0, "stale", 3.0, frozen, fault="load_cell.freeze"),
            Case(1, "range", 1.0, {"high": 1.5}, Crossing("supply_voltage", 1.5), {**on, "supply": 1.0},
                 {"supply": 2.0}),
            Case(1, "stuck", 3.0, _stuck(0.5, 0.2), Crossing("supply_voltage", 1.5), {**on, "supply": 1.0},
                 {"supply": 2.0}, "supply.freeze", fault_first=True),
            Case(2, "range", 1.0, {"high": 0.6}, Crossing("supply_current", 0.6), {**on, "supply": 1.0},
                 {"supply": 2.5}),
            Case(3, "stale", 3.0, frozen, fault="t7.freeze"),
        ],
        "hybrid": [
            Case(0, "range", 0.0, fault="base.out-of-range", values={"value": 65.0}),
            Case(0, "stale", 3.0, frozen, fault="t7.freeze"),
            Case(1, "range", 0.0, fault="tip.out-of-range", values={"value": 65.0}),
            Case(1, "stale", 3.0, frozen, fault="t7.freeze"),
            Case(2, "range", 2.0, *warm_sink, then={"tec": -0.15}),
            Case(3, "range", 0.0, {"high": 0.08}, Crossing("tec_current", 0.08), then={"tec": 0.12}),
            Case(4, "stale", 3.0, frozen, fault="t7.freeze"),
            Case(5, "range", 0.5, {"high": 15.0}, Crossing("piezo_voltage", 15.0), then={"piezo": 25.0}),
            Case(5, "stuck", 3.0, _stuck(5.0, 1.0), Crossing("amplifier_command", 5.0), {**on, "piezo": 0.0},
                 {"piezo": 25.0}, "amplifier-clipped", {"volts": 0.5}, fault_first=True),
        ],
    }[rig.name]  # fmt: skip


def _stuck(moved: float, follows: float) -> dict[str, dict[str, float]]:
    return {"stuck": {"moved": moved, "follows": follows, "within": 3.0}}


def _half_step_above(rig: EmulatedRig) -> float:
    """Return where the reading of the sink steps up next: there it crosses a limit when the sink itself does."""
    sink = rig.control.request("state")["values"]["sink_temperature"]["value"]
    return round((math.floor(sink / SINK_STEP + 0.5) + 0.5) * SINK_STEP, 6)


def carry_out(rig: EmulatedRig, case: Case, protocol: str) -> Found:
    """Carry a trial out, and leave the laboratory as it was; times are those from when the interlock had to act."""
    file = load_rig(rig.name, {})
    tables = [each.model_dump(mode="json", exclude_unset=True) for each in file.interlocks]
    tables[case.interlock].update(case.changes)
    overrides = {"interlocks": _toml(tables), "safety.patience": "300"}
    setpoints = SETPOINTS[rig.name] if case.setpoints is None else case.setpoints
    parameters = {"setpoints": json.dumps(setpoints), "then": json.dumps(case.then)}
    if protocol == "spin":
        # A file that there is: it computes as soon as everything is on.
        parameters["until"] = __file__
    with ExitStack() as stack:
        stack.callback(rig.control.advance, REST)
        if case.fault_first:
            rig.control.fault(case.fault, **case.values)
        run = stack.enter_context(GuardedRun(rig, protocol, overrides, parameters))
        if case.fault:
            # Before the run is left: a guardian goes on until what is frozen shows that it is safe.
            stack.callback(rig.control.end_fault, case.fault)
        crossed = None
        if case.crossing is None:
            run.await_on(0)
            crossed = run.await_note(
                "computing" if protocol == "spin" and not case.fault_first else "everything is on"
            )
            if not case.fault_first:
                rig.control.fault(case.fault, **case.values)
                events = [each for each in rig.control.events() if each["fault"] == case.fault]
                crossed = float(events[-1]["time"])
        late, problem = _watch(rig, case, crossed)
        run.guardian = run.guardian or find_guardian(run.folder)
        since = time.monotonic()
        while not (cause := run.cause) and time.monotonic() - since < 10.0:
            time.sleep(0.05)
    expected = f"interlock: {file.interlocks[case.interlock].label}"
    allowed = 1.0 / file.safety.rate + SAFE_WITHIN
    if not problem and expected not in cause:
        problem = "something else was first"
    # It cannot be sooner than from the look before the crossing.
    if not problem and not -allowed <= late <= allowed:
        problem = f"{late:.3f} s, and {allowed:g} s are allowed"
    return Found(late, allowed, f"{problem}: {cause}" if problem else "")


def _watch(rig: EmulatedRig, case: Case, crossed: float | None) -> tuple[float, str]:
    """Watch the true state until every output is off; return how much later than it had to act (s), or a problem."""
    begin = time.monotonic()
    before, was_on = -math.inf, crossed is not None
    while True:
        state = rig.control.request("state")
        now, values = float(state["time"]), state["values"]
        if crossed is None and case.crossing is not None and was_on and case.crossing.is_beyond(values):
            # It has crossed since the look before this one.
            crossed = max(before, now - 0.1)
        before, left = now, on(values)
        was_on = was_on or bool(left)
        if (was_on and not left) or time.monotonic() - begin > LONGEST:
            break
        time.sleep(0.004)
    if left or not was_on:
        return math.nan, f"still on: {', '.join(left)}" if left else "nothing was ever on"
    if crossed is None:
        return math.nan, "the outputs were off before it crossed its limit"
    return now - crossed - case.seconds, ""


def _toml(value: object) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {_toml(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(each) for each in value) + "]"
    return json.dumps(value)


def main() -> int:
    """Print the table; return 0 if every output was off in time in every trial."""
    parser = trials_parser(__doc__, times=3)
    parser.add_argument("--case", action="append", default=[], help="only those whose name has this in it")
    given = parser.parse_args()
    bad = 0
    with ExitStack() as stack:
        start_busy(given.busy, stack)
        print(f"{'rig':7} {'interlock':32} {'protocol':9} {HEADS}")
        for name in given.rig or SETPOINTS:
            rig = stack.enter_context(serve(name, clock="x1"))
            for index, case in enumerate(cases(rig)):
                title = f"{load_rig(name, {}).interlocks[case.interlock].label} {case.title}"
                if given.case and not any(text in title for text in given.case):
                    continue
                for protocol in ("hold", "spin"):
                    # Anew each time, as a limit may depend on where the plant has come to rest.
                    found = [carry_out(rig, cases(rig)[index], protocol) for _ in range(given.times)]
                    bad += report(f"{name:7} {title:32} {protocol:9}", found)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
