"""Folds of a measured sequence: gaps are respected, no residual is in two parts, units are left out whole."""

import numpy as np
from cases import cases
from hypothesis import given, settings, strategies as st
from hysteretic_plants import through

from bench.identification import ramps
from bench.identification.branches import turning_points
from bench.identification.choose.folds import (
    REACHED,
    block_folds,
    correlated_rows,
    excitation_units,
    near,
    unit_folds,
    with_reach,
)


@settings(max_examples=60, deadline=None)
@given(
    rows=st.integers(20, 300),
    folds=st.integers(2, 6),
    more_blocks=st.integers(0, 12),
    gap=st.integers(0, 9),
    seed=st.integers(0, 99),
)
def test_no_row_of_a_fit_is_tested_or_within_the_gap(rows, folds, more_blocks, gap, seed):
    usable = np.random.default_rng(seed).random(rows) < 0.9
    made = block_folds(usable, folds=folds, blocks=folds + more_blocks, gap=gap)
    # Every usable row is tested once.
    assert (sum(fold.tested.astype(int) for fold in made) == usable).all()
    for fold in made:
        assert not (fold.trained & ~usable).any()
        tested, trained = np.flatnonzero(fold.tested), np.flatnonzero(fold.trained)
        if tested.size and trained.size:
            assert np.abs(tested[:, None] - trained[None, :]).min() > gap
        # What is neither is within the gap.
        between = np.flatnonzero(usable & ~fold.tested & ~fold.trained)
        assert all(np.abs(tested - row).min() <= gap for row in between)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.booleans(), min_size=1, max_size=60), st.integers(0, 70))
def test_rows_near_chosen_ones_are_those_of_a_search(chosen, distance):
    flags = np.array(chosen)
    expected = [
        any(flags[max(0, row - distance) : row + distance + 1]) for row in range(flags.size)
    ]  # fmt: skip
    assert near(flags, distance).tolist() == expected


def test_blocks_are_contiguous():
    fold = block_folds(np.ones(100, dtype=bool), folds=5, blocks=10, gap=2)[0]
    assert np.flatnonzero(fold.tested).tolist() == [*range(10), *range(50, 60)]
    assert np.flatnonzero(~fold.trained).tolist() == [*range(12), *range(48, 62)]


@settings(max_examples=100, deadline=None)
@given(
    inputs=st.lists(st.floats(-1.0, 1.0), min_size=12, max_size=60), gap=st.integers(0, 3), number=st.integers(0, 4)
)
def test_no_fold_tests_what_its_fit_does_not_reach_unless_that_is_most_of_it(inputs, gap, number):
    values = np.array(inputs)
    fold = block_folds(np.ones(values.size, dtype=bool), blocks=10, gap=gap)[number]
    made = with_reach(fold, values, gap)
    if not fold.trained.any():
        assert made is fold
        return
    low, high = values[fold.trained].min(), values[fold.trained].max()
    beyond = fold.tested & ((values < low) | (values > high))
    if made is not fold:
        assert (made.trained == (fold.trained | beyond)).all()
        # What is tested is as far from the rows that were added as from any other.
        assert not (near(beyond, gap) & made.tested).any()
        assert not (made.tested & ~fold.tested).any()
        assert ((values[made.tested] >= low) & (values[made.tested] <= high)).all()
    elif high - low < REACHED * np.ptp(values[fold.trained | fold.tested]):
        assert 2 * (fold.tested & ~near(beyond, gap)).sum() < fold.tested.sum()


def test_an_extreme_that_one_block_alone_reaches_is_in_every_fit():
    inputs = through([0.5, -0.5, 0.5, -1.0, 0.5, -0.5, 0.5, -0.5], 150)
    folds = block_folds(np.ones(150, dtype=bool), blocks=5, gap=1)
    (alone,) = (fold for fold in folds if fold.tested[inputs < -0.9].any())
    made = with_reach(alone, inputs, 1)
    assert inputs[made.trained].min() == inputs.min()
    assert made.tested.any()
    # Of a record that goes there in most of a block, the block tests what it does beyond.
    rise = np.linspace(0.0, 1.0, 150)
    assert with_reach(folds[4], rise, 1) is folds[4]


def _amplitudes():
    return ramps([0.0, 10.0, 0.0, 10.0, 2.0, 8.0, 2.0, 8.0, 4.0, 6.0, 4.0, 6.0, 4.0, 0.0, 10.0], 0.25)


def test_a_unit_is_what_the_input_does_between_the_same_turns():
    inputs = _amplitudes()
    unit, amplitudes = excitation_units(inputs)
    inner = unit[(inputs > 4.5) & (inputs < 5.5)]
    assert len(set(unit.tolist())) == amplitudes.size
    # 10, 8, 6, 4 and 2: the major loop, two cycles, and the ways between them.
    assert {round(value) for value in amplitudes} == {10, 8, 6, 4, 2}
    assert set(inner.tolist()) == set(range(amplitudes.size))


def test_units_are_left_out_whole_and_the_major_loop_stays():
    inputs = _amplitudes()
    unit, amplitudes = excitation_units(inputs)
    made = unit_folds(inputs, np.ones(inputs.size, dtype=bool), folds=2)
    assert len(made) == 2
    major = np.flatnonzero(amplitudes > 9.0)
    for fold in made:
        assert not np.isin(unit[fold.tested], major).any()
        assert not set(unit[fold.tested].tolist()) & set(unit[fold.trained].tolist())
    tested = made[0].tested | made[1].tested
    assert (tested == ~np.isin(unit, major)).all()


def test_one_kind_of_cycle_has_no_units():
    inputs = ramps([0.0, 1.0] * 6, 0.1)
    assert unit_folds(inputs, np.ones(inputs.size, dtype=bool)) == ()


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(-9, 9), min_size=1, max_size=40))
def test_turning_points_without_a_least_move_are_the_extrema(values):
    inputs = np.array(values, dtype=float)
    turns = turning_points(inputs).tolist()
    expected = [0]
    for row in range(1, inputs.size - 1):
        before = [value for value in np.diff(inputs[: row + 1]) if value]
        after = [value for value in np.diff(inputs[row:]) if value]
        # The last row of a plateau turns.
        if before and after and inputs[row + 1] != inputs[row] and before[-1] * after[0] < 0:
            expected.append(row)
    expected.append(inputs.size - 1)
    assert turns == sorted(set(expected))


def test_small_moves_are_no_turns():
    inputs = np.array([0.0, 1.0, 0.95, 2.0, 1.96, 3.0, 1.0, 1.04, 0.0])
    assert turning_points(inputs, 0.1).tolist() == [0, 5, 8]
    assert turning_points(inputs, 0.045).tolist() == [0, 1, 2, 5, 8]


def test_the_gap_is_where_residuals_are_no_longer_correlated():
    rng = np.random.default_rng(0)
    white = rng.standard_normal(4000)
    slow = np.convolve(white, np.ones(20), "valid")
    assert correlated_rows(white, 100) <= 2
    assert 10 <= correlated_rows(slow, 100) <= 25
    assert correlated_rows(slow, 7) == 7
    assert correlated_rows(np.ones(50), 10) == 0


@cases("least", [0.0, 0.5])
def test_a_constant_input_has_no_turns_between_its_ends(least):
    assert turning_points(np.ones(5), least).tolist() == [0, 4]
