"""Bringing a specimen back to where a record left it, before the run goes on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from bench.base import AgreementError, format_numbers
from bench.devices import Settle, Signal
from bench.execution.resumption.feeding import Fed
from bench.execution.resumption.interrupted import RESUMED, Interrupted
from bench.execution.run_at_hand import RunAtHand
from bench.rig import Look

NO_STEP = -1
"""Step number of telemetry that belongs to no step."""

_READINGS = 10
"""Readings of which mean and noise are compared with the record."""

_CREEP = 0.005
"""Share of what a signal went through in the record by which creep and the way back may make it differ."""

_FINE = 0.1
"""Share of what a signal went through in the record that its smallest step may be at most."""

_MOVED = 5.0
"""Standard deviations by which a drive has to move so that a slope can be told."""

_TICKS = 50
"""Ticks at the end of the record from which the noise is taken."""

_NORMAL = 0.6745 * math.sqrt(2.0)
"""Median of the magnitude of the difference of two readings with unit standard deviation."""


def reprime(run: RunAtHand, past: Interrupted, settle: Callable[[Settle], None]) -> None:
    """Bring the specimen back by the shortest sequence of its stored corners, and compare it with the record.

    It is recorded as telemetry of no step, and as events. The protocol of `past` has been fed; `settle` lets the rig
    settle by a rule, and raises if it does not. Raises AgreementError if a signal differs from the last readings by
    more than is allowed.
    """
    fed = past.fed
    places = fed.way_back()
    if not places or fed.step is None:
        return
    texts = [", ".join(f"{name} {value:g}" for name, value in place.setpoints.items()) for place in places]
    run.event("INFO", RESUMED, f"the specimen is brought back by {len(places)} corners: {'; '.join(texts)}")
    run.steps = NO_STEP
    try:
        done: Mapping[str, float] = {}
        prompted = None
        for place in places:
            if past.by_hand and place.prompt is not None and place.prompt is not prompted:
                run.station.operate(place.prompt.task, place.prompt.value)
                prompted = place.prompt
            run.station.apply({name: value for name, value in place.setpoints.items() if done.get(name) != value})
            done = place.setpoints
            settle(fed.settle_at(place, run.period))
            # In the place of the reading of a step, for watchdogs and interlocks.
            run.tick()
        readings = [run.look(Look.MEASURE)]
        while len(readings) < _READINGS:
            run.sleep_until(run.clock.now() + min(0.1, run.period))
            readings.append(run.look(Look.MEASURE))
        run.judge(run.clock.now(), readings[-1])
    finally:
        run.steps = fed.next_step
    wrong = _disagreements(run, past, readings)
    if not wrong:
        run.event("INFO", RESUMED, f"{', '.join(past.compared)}: as in the last readings of the record")
        return
    text = f"after the way back {'; '.join(wrong)}"
    if not past.asked.accept_disagreement:
        raise AgreementError(
            f"{text}; find out what has changed (the specimen, what was done by hand, the instruments), or go on all "
            "the same with --accept-disagreement"
        )
    run.event("WARN", RESUMED, f"{text}; accepted")


def _disagreements(run: RunAtHand, past: Interrupted, readings: Sequence[Mapping[str, float]]) -> list[str]:
    """Return what differs from the record by more than is allowed.

    Allowed are so many standard deviations, beside the larger of the resolution and 0.5 % of what the signal went
    through, for creep. A response may differ besides by what the same of the drive makes of it on the slope of the
    branch: a set-point is hit a little beside, and a room that has become warmer acts like that.
    """
    fed = past.fed
    described: Mapping[str, Signal] = run.station.description.by_name
    found = []
    allowed_of_drive = 0.0
    # The drive first: where it is allowed to differ, the response has to be as well.
    for name in sorted(past.compared, key=lambda name: name != past.drive):
        before = _last_readings(fed, name)
        now = np.array([reading[name] for reading in readings])
        if not (np.isfinite(before).all() and np.isfinite(now).all()):
            continue
        recorded = max(_noise(fed, name), _spread(before) if len(before) > 2 else 0.0)
        # A mean of readings that are near in time shares what wanders slowly: it counts as one reading.
        sigma = math.hypot(recorded, max(recorded, _spread(now)))
        signal = described[name]
        allowed = past.asked.sigmas * sigma + max(_resolution(fed, signal), _CREEP * _span(fed, name))
        if name == past.drive:
            allowed_of_drive = allowed
        elif past.drive:
            allowed += _slope(fed, past.drive, name) * allowed_of_drive
        difference = float(now.mean() - before.mean())
        if abs(difference) > allowed:
            *numbers, unit = format_numbers([now.mean(), before.mean(), allowed], signal.unit, signal.precision + 1)
            found.append(
                f"{name} reads {numbers[0]} {unit} and read {numbers[1]} {unit} in the record; a difference of "
                f"{numbers[2]} {unit} ({past.asked.sigmas:g} σ, the resolution or 0.5 % of its span, and what "
                f"the same of the drive makes of it) is allowed"
            )
    return found


def _span(fed: Fed, name: str) -> float:
    column = fed.past.names.index(name)
    values = [value for step in fed.past.steps if math.isfinite(value := step.values[column])]
    return max(values) - min(values)


def _last_readings(fed: Fed, name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the last readings of a signal that were taken in one place."""
    column = fed.past.names.index(name)
    last: list[float] = []
    for step in reversed(fed.past.steps):
        if not step.settled.failed:
            last.append(step.values[column])
            if step.setpoints:
                break
    # What came first may not have settled; what is compared is the end.
    return np.array(last[:_READINGS])


def _slope(fed: Fed, drive: str, name: str) -> float:
    """Return the greatest slope of a signal over the drive in the last readings of the record."""
    columns = [fed.past.names.index(signal) for signal in (drive, name)]
    last = np.array([[step.values[i] for i in columns] for step in fed.past.steps[-_READINGS:]])
    differences = np.abs(np.diff(last, axis=0))
    moved = differences[differences[:, 0] > _MOVED * _noise(fed, drive)]
    return float(np.max(moved[:, 1] / moved[:, 0])) if len(moved) and np.isfinite(moved).all() else 0.0


def _noise(fed: Fed, name: str) -> float:
    """Return the noise of a signal at rest: of ticks or of readings, whichever is larger."""
    # Free of drift: a median of differences within the second halves of steps, as the specimen moves in the first.
    ticks = fed.past.ticks
    values, steps = ticks[name][-_TICKS:], ticks["step"][-_TICKS:]
    of_steps = [np.abs(np.diff(values[steps == step])) for step in np.unique(steps)]
    differences = np.concatenate([np.empty(0), *(each[each.size // 2 :] for each in of_steps)])
    differences = differences[np.isfinite(differences)]
    of_ticks = float(np.median(differences)) / _NORMAL if differences.size else 0.0
    # Zero for a signal that stands on one digit and jumps now and then, which readings show.
    return max(of_ticks, _jumps(fed, name))


def _jumps(fed: Fed, name: str) -> float:
    """Return the standard deviation, of one reading, of the differences of readings from the ticks before them."""
    column = fed.past.names.index(name)
    ticks = fed.past.ticks
    last = dict(zip(ticks["step"].tolist(), ticks[name].tolist(), strict=True))
    steps = [step for step in fed.past.steps if step.step in last and not step.settled.failed]
    differences = np.array([step.values[column] - last[step.step] for step in steps])
    differences = differences[np.isfinite(differences)]
    return _spread(differences) / math.sqrt(2.0) if differences.size > 1 else 0.0


def _resolution(fed: Fed, signal: Signal) -> float:
    """Return the smallest step of a signal: one unit of the last digit that is shown, or as the record has it."""
    shown = 10.0**-signal.precision
    gaps = np.diff(np.unique(fed.past.ticks[signal.name]))
    # Equal values may differ by their rounding, and a signal that knows few values may well take the other one.
    gaps = gaps[(gaps > 1e-6 * shown) & (gaps <= _FINE * _span(fed, signal.name))]
    return max(shown, float(gaps.min())) if gaps.size else shown


def _spread(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    return float(np.std(values, ddof=1))
