"""Entries of the dashboard: ticks as columns, their order beside steps and events, and portions of them."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st

pytest.importorskip("rerun")

from bench.dashboard.controlled_run import ControlPlots, ErrorPlot
from bench.dashboard.entries import Entry, Tick, Ticks, in_parts, merged, portions, single, size
from bench.devices import Signal
from bench.protocol import TRACES, Settled
from bench.record import Event, StepRecord

SIGNALS = (Signal("input", "V", "input"), Signal("output", "m", "output"), *TRACES)
"""Of a run under control of `output`."""
INSTANTS = st.sampled_from([0.0, 1.0, 2.0, 3.0])
NUMBERS = st.integers(0, 3)
VALUES = st.tuples(*[st.sampled_from([math.nan, -1.0, 0.5, 2.0])] * len(SIGNALS))
TICKS = st.builds(Tick, INSTANTS, NUMBERS, VALUES)
STEPS = st.builds(
    lambda step, finished, settled, values: StepRecord(step, 0.0, finished, "", "", settled, {}, values),
    NUMBERS,
    INSTANTS,
    st.sampled_from([Settled.DWELL, Settled.CONTROLLED]),
    VALUES,
)
EVENTS = st.builds(Event, INSTANTS, st.just("INFO"), st.just("note"), st.sampled_from(["one", "another"]))


def told(entries: list[Entry]) -> list[str]:
    return [repr((*entry[:2], tuple(entry.values)) if isinstance(entry, Tick) else entry) for entry in entries]


@given(st.lists(TICKS | STEPS | EVENTS, max_size=30))
def test_columns_of_ticks_are_the_ticks(entries: list[Entry]) -> None:
    parts = in_parts(entries)
    assert told(list(single(parts))) == told(entries)
    assert sum(map(size, parts)) == len(entries)
    assert not any(isinstance(one, Ticks) and isinstance(next_, Ticks) for one, next_ in pairwise(parts))


@given(st.lists(TICKS, min_size=1), st.lists(STEPS), st.lists(EVENTS))
def test_what_a_journal_has_is_merged_as_sorting_does(
    ticks: list[Tick], steps: list[StepRecord], events: list[Event]
) -> None:
    dated: list[tuple[tuple[float, float, int], Entry]] = [((tick.t, tick.step, 0), tick) for tick in ticks]
    dated += [((step.finished, step.step, 1), step) for step in steps]
    dated += [((event.t, math.inf, 0), event) for event in events]
    expected = [entry for _, entry in sorted(dated, key=lambda each: each[0])]
    assert told(list(single(merged(Ticks.of(ticks), steps, events)))) == told(expected)


@given(st.lists(TICKS | EVENTS, max_size=30), st.integers(1, 12))
def test_portions_are_full_but_the_last(entries: list[Entry], most: int) -> None:
    found = list(portions(in_parts(entries), most))
    counts = [sum(map(size, portion)) for portion in found]
    assert all(count == most for count in counts[:-1])
    assert all(0 < count <= most for count in counts)
    assert told(list(single(part for portion in found for part in portion))) == told(entries)


@given(st.lists(TICKS | STEPS, max_size=30))
def test_the_errors_are_the_same_tick_by_tick(entries: list[Entry]) -> None:
    at_once, one_by_one = (ErrorPlot(ControlPlots.of(SIGNALS, "output", None)) for _ in range(2))
    for part in in_parts(entries):
        at_once.see(part)
    for entry in entries:
        for part in in_parts([entry]):
            one_by_one.see(part)
    for name in ("now", "target"):
        assert np.array_equal(getattr(at_once, name), getattr(one_by_one, name), equal_nan=True)
    assert repr(at_once.rms()) == repr(one_by_one.rms())
    assert at_once.range() == one_by_one.range()
