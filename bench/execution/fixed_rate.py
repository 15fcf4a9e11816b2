"""Carries out a controller at a fixed rate, sample by sample or block by block."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from bench.base import ConfigurationError, LimitError
from bench.control import BlockController, Floats, SampledController
from bench.devices import Settled
from bench.execution.run_at_hand import NOT_AT_WORK, RunAtHand, row_of, traced
from bench.protocol import LATENESS, FixedRate, Reading
from bench.record import Lateness
from bench.rig import SETPOINT

_PERIODS_OF_GRACE = 5
"""Periods of a loop beyond the next sample by which the station expects to hear from it."""

_GRACE = 0.5
"""Wall-clock time that comes on top, s."""


def carry_out(run: RunAtHand, message: FixedRate) -> Reading:
    """Carry a fixed rate out, and take the reading behind it.

    Raises
    ------
    ConfigurationError
        If the rig lacks something, or the controller returns another number of set-points.
    LimitError
        If its limits are beyond those of a device, or the controller asks for a set-point beyond them; none is sent
        then.
    """
    run.check_signals(*message.inputs, *message.watched)
    # Before the controller asks for any of them.
    run.station.check(dict(zip(message.actuators, message.limits, strict=False)))
    period = 1.0 / message.rate
    if period <= run.period:
        run.station.promise(_GRACE + _PERIODS_OF_GRACE * period, f"a loop at {message.rate:g} Hz")
    try:
        return (_blocks if message.block else _samples)(run, message, period)
    finally:
        run.trace = NOT_AT_WORK


def _samples(run: RunAtHand, message: FixedRate, period: float) -> Reading:
    controller, inputs = message.controller, message.inputs
    assert isinstance(controller, SampledController)
    clock, update = run.clock, controller.update
    setpoints = [f"{name}{SETPOINT}" for name in message.actuators]
    lowest, highest = ([each[side] for each in message.limits] for side in (0, 1))
    read = run.station.quick_reader(inputs)
    # What is watched is for the record alone.
    read_recorded = run.station.quick_reader((*inputs, *message.watched)) if message.watched else read
    measured = row_of(inputs)
    is_slow = period > run.period
    move = run.station.mover(message.actuators)
    samples = message.samples
    started = clock.now()
    values = run.tick()
    start = clock.now()
    next_tick = start + run.period
    k = taken = 0
    lateness = Lateness(message.rate)
    note_late = lateness.add
    while True:
        due = start + k * period
        # Between the samples of a slow loop interlocks and watchdogs do not wait for the next one.
        while is_slow and next_tick < due - 1e-6 * run.period:
            run.sleep_until(next_tick)
            values = run.tick()
            next_tick = run.tick_after(next_tick)
        run.sleep_until(due)
        # The controller may have put the end off.
        if k >= samples and k >= (samples := message.samples):
            break
        if run.pause_requested:
            # The loop goes on where it stood, as if no time had passed.
            start += run.pause_if_asked()
            due = start + k * period
            run.station.promise(_GRACE + _PERIODS_OF_GRACE * period, f"a loop at {message.rate:g} Hz")
        now = clock.now()
        is_recorded = taken % message.record_every == 0
        if is_recorded:
            values.update(read_recorded())
            commands = update(now - start, measured(values))
        else:
            commands = update(now - start, measured(read()))
        if len(commands) != len(setpoints):
            raise ConfigurationError(
                f"the controller of {', '.join(message.actuators)} gave {len(commands)} set-points; "
                f"expected {len(setpoints)}"
            )
        for low, command, high in zip(lowest, commands, highest, strict=False):
            if not low <= command <= high:
                _check_limits(message, np.array([commands]))
        move(commands)
        late = now - due
        note_late(late)
        if is_recorded:
            # Without the lateness, which tells the samples from the ticks.
            run.trace = traced(controller.trace)
            values.update(zip(setpoints, commands, strict=True))
            values.update(run.trace)
            values[LATENESS.name] = late
            run.record_tick(now, values)
        taken += 1
        if now >= next_tick:
            # Everything else: what its watchdogs wait for, and what interlocks look at.
            values = run.look()
            run.judge(clock.now(), values)
            next_tick = run.tick_after(next_tick)
        k += 1
        if (reached := (clock.now() - start) / period) >= k + 1:
            k = min(samples, math.floor(reached))
    return _finish(run, message, started, taken, lateness, commands)


def _blocks(run: RunAtHand, message: FixedRate, period: float) -> Reading:
    """Carry a fixed rate out block by block; see `FixedRate.block`."""
    controller, clock = message.controller, run.clock
    assert isinstance(controller, BlockController)
    setpoints = [f"{name}{SETPOINT}" for name in message.actuators]
    signals = (*message.inputs, *message.watched)
    samples = message.samples
    if message.block * period > run.period:
        raise ConfigurationError(
            f"a block of {message.block} samples takes {message.block * period:g} s; interlocks wait for its "
            f"end, so {run.period:g} s, the telemetry period, is allowed at most"
        )
    play = run.station.block_player(signals, message.actuators, period)
    run.expect_ticks(f"a loop at {message.rate:g} Hz in blocks of {message.block}")
    started = clock.now()
    values = run.tick()
    start = clock.now()
    next_tick = start + run.period
    readings: Floats = np.empty((0, len(signals)))
    k = taken = 0
    lateness = Lateness(message.rate)
    while True:
        due = start + k * period
        run.sleep_until(due)
        if k == samples:
            break
        start += run.pause_if_asked()
        due = start + k * period
        now = clock.now()
        count = min(message.block, samples - k)
        out: Floats = np.full((count, len(setpoints)), math.nan)
        times = (np.arange(k, k + count) * period).astype(np.float64)
        controller.step_block(times, readings[:, : len(message.inputs)], out)
        _check_limits(message, out)
        late = now - due
        readings = play(out) if play is not None else _sampled(run, message, signals, out, start + times)
        lateness.add(late, count)
        run.trace = traced(controller.trace)
        for each in range(-taken % message.record_every, count, message.record_every):
            values.update(run.trace)
            values.update(zip(signals, readings[each].tolist(), strict=True))
            values.update(zip(setpoints, out[each].tolist(), strict=True))
            values[LATENESS.name] = late
            run.record_tick(float(start + times[each]) + late, values)
        taken += count
        now = clock.now()
        if now >= next_tick:
            values = run.look()
            run.judge(now, values)
            next_tick = run.tick_after(next_tick)
        k = min(samples, max(k + count, math.floor((now - start) / period)))
    return _finish(run, message, started, taken, lateness, out[-1].tolist())


def _check_limits(message: FixedRate, out: Floats) -> None:
    """Raise `LimitError` unless all set-points, a sample in a row, are within the limits of the loop."""
    for name, (low, high), column in zip(message.actuators, message.limits, out.T, strict=False):
        if not (allowed := (low <= column) & (column <= high)).all():
            wrong = column[~allowed][0]
            raise LimitError(name, f"the controller asked for {wrong:g}, beyond {low:g} to {high:g}")


def _sampled(run: RunAtHand, message: FixedRate, signals: Sequence[str], out: Floats, instants: Floats) -> Floats:
    """Take the samples of a block one by one, as an instrument does that can by itself."""
    # None is sent when another is wrong.
    run.station.check(dict(zip(message.actuators, out.T.tolist(), strict=True)))
    read: Callable[[], dict[str, float]] = run.station.quick_reader(signals)
    move = run.station.mover(message.actuators)
    rows = []
    for instant, commands in zip(instants.tolist(), out.tolist(), strict=True):
        run.sleep_until(instant)
        values = read()
        rows.append([values[name] for name in signals])
        move(commands)
    return np.array(rows).reshape(len(out), len(signals))


def _finish(
    run: RunAtHand,
    message: FixedRate,
    started: float,
    taken: int,
    lateness: Lateness,
    commands: Sequence[float],
) -> Reading:
    """Tell how late a loop was, and take the reading."""
    run.trace = NOT_AT_WORK
    samples = message.samples
    lateness.left_out = samples - taken
    run.keep_lateness(message.label, lateness)
    run.event(
        "INFO",
        "loop",
        f"{taken} samples at {message.rate:g} Hz, {samples - taken} left out; late by "
        f"{1e3 * lateness.total / taken:.3g} ms on average, {1e3 * lateness.worst:.3g} ms at most",
    )
    sent = dict(zip(message.actuators, commands, strict=True))
    return run.measure_step(started, message.label, sent, Settled.CONTROLLED)
