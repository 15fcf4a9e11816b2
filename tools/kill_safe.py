"""Kill, stop and hang a bench or its guardian, and cut the lines: when every output is off, read in the instruments.

    python tools/kill_safe.py [--rig RIG]... [--trial NAME]... [--times N] [--busy N]

prints a table: for each rig and trial, how often every output became safe within its declared time, and the median
and longest time it took. The instruments are served by `bench rig emulate` in another process, and the bench runs
as on hardware.

The trials `cut` and `unplug` have rows for each instrument whose line is lost: for the outputs of the other ones, for
its own, which its watchdog switches off, and for those that no watchdog does, once the line is mended.
"""

from __future__ import annotations

import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass

from guarded_run import HEADS, SETPOINTS, Found, GuardedRun, outputs_on, report, start_busy, trials_parser

from bench.execution.guardian.rescuer import SILENCE
from bench.record import ending_of
from bench.rig import load_rig
from sim_devices.serving.process import EmulatedRig, serve

DEATH, PROMISE, PATIENCE = 0.2, 5.0, 4.0
"""Time within which every output has to be off on an idle computer, s: the bench died; it broke the promise of a hold
(its period of 1 to 2 s and 2 s), or of a computation (set to 3 s here, and 1 s for the last step).

The first is no promise of the bench but a bound of what was measured: the system says at once that a process has
died, each line ends the exchange at work, and one exchange switches an output off. What makes it longer is only how
long guardian and emulator wait for a processor, as with `--busy`.
"""

RESCUE = 2.0
"""Time within which the rescuer makes every device safe, s: it opens the lines."""

LINES = {
    "vo2": {"tec_output": "tec"},
    "sma": {"supply_voltage": "supply", "stage_torque": "stage", "fan": "t7"},
    "hybrid": {"tec_output": "tec", "amplifier_command": "t7", "amplifier_enable": "t7"},
}
"""Instrument that sets an output, by the name of the output."""

NO_WATCHDOG = {"stage_torque", "amplifier_command"}
"""Outputs that no watchdog switches off: that of the servo ends its motion, that of the T7 takes the amplifier's
enable line down."""


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
    """

    protocol: str
    sent: signal.Signals | None
    within: float
    stalled: bool = False


TRIALS = {
    "SIGKILL": Trial("hold", signal.SIGKILL, DEATH),
    "SIGTERM": Trial("hold", signal.SIGTERM, 3.0),
    "SIGQUIT": Trial("hold", signal.SIGQUIT, 3.0),
    "SIGUSR1": Trial("hold", signal.SIGUSR1, 3.0),
    "SIGSTOP": Trial("hold", signal.SIGSTOP, PROMISE),
    "endless loop": Trial("spin", None, PATIENCE),
    "endless loop, SIGTERM": Trial("spin", signal.SIGTERM, 3.0),
    "interpreter kept": Trial("keep-interpreter", None, PATIENCE),
    "stalled reader": Trial("talk", signal.SIGTERM, 3.0, stalled=True),
}

GUARDIAN = {"guardian SIGKILL": signal.SIGKILL, "guardian SIGSTOP": signal.SIGSTOP}
"""What the guardian is sent once everything is on."""


def judged(seconds: float, within: float, left: Collection[str] = ()) -> Found:
    """Return what is found if some outputs are left on, or were on for so long."""
    if left:
        return Found(seconds, within, f"still on after {seconds:.2f} s: {', '.join(left)}")
    return Found(seconds, within, f"after {seconds:.2f} s" if seconds > within else "")


def started(rig: EmulatedRig, protocol: str, *, stalled: bool = False) -> GuardedRun:
    """Start a run that switches everything on."""
    parameters = {"setpoints": json.dumps(SETPOINTS[rig.name])}
    return GuardedRun(rig, protocol, {"safety.patience": "3"}, parameters, stalled=stalled)


def watch(rig: EmulatedRig, names: Collection[str], longest: float) -> tuple[dict[str, float], set[str]]:
    """Watch outputs until all are off; return for how long each was on (s), and those that are still on."""
    start = time.monotonic()
    seconds = dict.fromkeys(names, 0.0)
    while True:
        left = outputs_on(rig).keys() & names
        now = time.monotonic() - start
        seconds.update(dict.fromkeys(left, now))
        if not left or now > longest:
            return seconds, left
        time.sleep(0.002)


def harm_bench(rig: EmulatedRig, trial: Trial, wait: float) -> dict[str, Found]:
    """Carry a trial out on the bench."""
    with started(rig, trial.protocol, stalled=trial.stalled) as run:
        run.await_on(len(SETPOINTS[rig.name]))
        if trial.sent is None:
            run.await_note("computing")
        else:
            time.sleep(wait)
            if not outputs_on(rig):
                return {"": Found(0.0, trial.within, "the outputs were off before the trial")}
            run.process.send_signal(trial.sent)
        seconds, left = watch(rig, LINES[rig.name], trial.within + 10.0)
        found = judged(max(seconds.values()), trial.within, left)
        problem = found.problem
        if trial.sent is signal.SIGSTOP:
            run.process.send_signal(signal.SIGCONT)
            if (code := run.exit_code()) != 7:
                problem = problem or f"exit code {code} after SIGCONT"
            if outputs_on(rig):
                problem = "switched on again after SIGCONT"
        elif trial.sent not in (None, signal.SIGKILL):
            code = run.exit_code()
            # A bench that hangs is ended by its guardian where the patience is over first.
            by_guardian = trial.protocol == "spin" and ending_of(run.folder) is not None
            if code != (7 if by_guardian else 130):
                problem = problem or f"exit code {code}, ended by {'its guardian' if by_guardian else 'the signal'}"
        return {"": Found(found.seconds, found.within, problem)}


def harm_guardian(rig: EmulatedRig, sent: signal.Signals, wait: float) -> dict[str, Found]:
    """Kill or stop the guardian: its rescuer makes the devices safe, and the bench ends with exit code 7."""
    within = RESCUE + (SILENCE if sent is signal.SIGSTOP else 0.0)
    with started(rig, "hold") as run:
        run.await_on(len(SETPOINTS[rig.name]))
        time.sleep(wait)
        os.kill(run.guardian, sent)
        seconds, left = watch(rig, LINES[rig.name], within + 10.0)
        found = judged(max(seconds.values()), within, left)
        problem = found.problem
        if (code := run.exit_code()) != 7:
            problem = problem or f"exit code {code}: {run.said[-300:]}"
        if not run.has_freed_lines():
            problem = problem or "the guardian is still there"
        found = Found(found.seconds, within, problem)
    restart(rig)
    return {"": found}


def cut_line(rig: EmulatedRig, instrument: str, fault: str, wait: float) -> dict[str, Found]:
    """Lose the line of an instrument."""
    file = load_rig(rig.name, {})
    devices = rig.instruments[instrument].devices
    lines = LINES[rig.name]
    own = {name for name, line in lines.items() if line == instrument}
    settings = [each.settings for each in file.devices if each.name in devices]
    # A watchdog that switches nothing off does not shorten the time for which the line may be away.
    watchdogs = [getattr(each, "watchdog", 0.0) for each in settings] if own - NO_WATCHDOG else []
    watchdogs = [watchdog for watchdog in watchdogs if watchdog]
    reconnect = min([file.safety.reconnect, *(0.6 * watchdog for watchdog in watchdogs)])
    # What belongs to whom, and the time that it has.
    parts: dict[str, tuple[set[str], float]] = {}
    if lines.keys() - own:
        parts["others"] = lines.keys() - own, reconnect + 3.0
    if own - NO_WATCHDOG:
        parts["its own"] = own - NO_WATCHDOG, max(watchdogs) + 1.0
    found: dict[str, Found] = {}
    with started(rig, "hold") as run:
        run.await_on(len(SETPOINTS[rig.name]))
        time.sleep(wait)
        rig.control.fault(f"{instrument}.{fault}")
        waited = {name for names, _ in parts.values() for name in names}
        seconds, left = watch(rig, waited, max([20.0, *(within + 10.0 for _, within in parts.values())]))
        for title, (names, within) in parts.items():
            found[title] = judged(max(seconds[name] for name in names), within, names & left)
        code = run.exit_code()
        said = run.said
        problem = ""
        if not code or not any(name in said for name in devices):
            problem = f"exit code {code}, and no device of {instrument} is named: {said[-300:]}"
        rig.control.plug_in(instrument)
        seconds, left = watch(rig, own, 13.0)
        mended = judged(max(seconds.values(), default=0.0), 3.0, left)
        if not run.has_freed_lines():
            problem = problem or "the guardian is still there"
        found["mended"] = Found(mended.seconds, mended.within, mended.problem or problem)
    restart(rig)
    return found


def restart(rig: EmulatedRig) -> None:
    """Switch every instrument off and on: a watchdog that has expired keeps its output off until then."""
    for name, instrument in rig.instruments.items():
        if instrument.devices:
            rig.control.fault(f"{name}.power-cycle")


def trials(rig: EmulatedRig) -> Iterator[tuple[str, Callable[[float], Mapping[str, Found]]]]:
    """Return the trials of a rig by name; each takes how long to wait before it goes wrong, s."""
    for title, trial in TRIALS.items():
        yield title, lambda wait, trial=trial: harm_bench(rig, trial, wait)
    for title, sent in GUARDIAN.items():
        yield title, lambda wait, sent=sent: harm_guardian(rig, sent, wait)
    for fault in ("cut", "unplug"):
        for name, instrument in rig.instruments.items():
            if instrument.devices:
                yield f"{fault} {name}", lambda wait, name=name, fault=fault: cut_line(rig, name, fault, wait)


def main() -> int:
    """Print the table; return 0 if every output was safe in time in every trial."""
    parser = trials_parser(__doc__, times=10)
    parser.add_argument("--trial", action="append", help="only trials of this name, or whose name begins with it")
    parser.add_argument("--seed", type=int, default=0, help="of the instants")
    given = parser.parse_args()
    instants = random.Random(given.seed)
    bad = 0
    with ExitStack() as stack:
        start_busy(given.busy, stack)
        print(f"{'rig':8} {'trial':28} {HEADS}")
        for name in given.rig or SETPOINTS:
            rig = stack.enter_context(serve(name, clock="x1"))
            for title, carry_out in trials(rig):
                if given.trial and not any(title == text or title.startswith(f"{text} ") for text in given.trial):
                    continue
                found = [carry_out(instants.uniform(0.0, 2.0)) for _ in range(given.times)]
                for part in dict.fromkeys(part for each in found for part in each):
                    parts = [each[part] for each in found if part in each]
                    bad += report(f"{name:8} {f'{title}: {part}' if part else title:28}", parts)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
