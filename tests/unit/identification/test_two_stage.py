"""Joint identification of the models among voltage, force and length."""

import dataclasses

import numpy as np
import pytest
from cases import cases
from scipy.optimize import nnls

from bench.identification import (
    Series,
    identify_first_stage,
    identify_linear,
    identify_second_stage,
    identify_summed,
    measure_series,
    predict_series,
    voltage_steps,
)
from bench.identification.fit.cell_layout import CellLayout, PlanesBeside
from bench.identification.fit.two_stage_fit import _beside, _chained
from bench.models import Linear, PrandtlIshlinskii, Preisach, Summed, TwoStage, uniform_levels

LOADS = (0.98, 2.94, 4.90, 6.86, 8.82)
HELD = (0.0, 0.6, 1.2, 1.8, 2.4, 3.0)
FORCES = np.concatenate([np.linspace(0.0, 10.5, 12), np.linspace(10.5, 0.0, 12)[1:]])
VOLTAGES = voltage_steps()


def preisach(low, high, least, greatest, seed, order=20, zeros=0.85, units=("", "")):
    rng = np.random.default_rng(seed)
    levels = uniform_levels(low, high, order)
    density = rng.random(order * (order + 1) // 2)
    density[rng.random(density.size) < zeros] = 0.0
    density *= 0.5 * (greatest - least) / (density @ Preisach(levels, density).cell_areas())
    return Preisach(levels, density, 0.5 * (least + greatest), input_unit=units[0], output_unit=units[1])


def smooth(low, high, units):
    """Return an operator whose density has one broad crest."""
    levels = uniform_levels(low, high, 20)
    rows, columns = np.tril_indices(20)
    density = np.exp(-(((rows - 12) / 6.0) ** 2) - ((columns - 7) / 6.0) ** 2)
    density *= 3.0 / (density @ Preisach(levels, density).cell_areas())
    return Preisach(levels, density, 2.0, input_unit=units[0], output_unit=units[1])


def roughness(operator):
    plane = operator.density_matrix()
    return np.nansum(np.diff(plane, axis=0) ** 2) + np.nansum(np.diff(plane, axis=1) ** 2)


def plays(low, high, weights, bias=0.0):
    half = 0.5 * (high - low)
    count = len(weights)
    thresholds = half * np.arange(count) / count
    return PrandtlIshlinskii(thresholds, weights, bias, 0.5 * (high + low), input_range=(low, high))


def two_stage(seed=0):
    first = preisach(0.0, 3.0, 0.3, 11.2, seed, units=("V", "N"))
    return TwoStage(first, preisach(-11.5, 11.5, -1.0, 5.0, seed + 1, units=("N", "mm")), 0.3)


def campaign(model, noise=0.0, seed=0):
    """The series of a model, each after a reset."""
    rng = np.random.default_rng(seed)

    def measured(series):
        lengths = predict_series(model, series) + noise * rng.standard_normal(series.lengths.size)
        return Series(series.kind, series.voltages, series.forces, lengths, series.preparation)

    loaded = [Series.under_load(load, VOLTAGES, np.zeros(VOLTAGES.size)) for load in LOADS]
    stretched = [Series.at_voltage(v, FORCES, np.zeros(FORCES.size)) for v in HELD]
    return [measured(s) for s in [*loaded, *stretched]]


def resting(model, noise=0.0):
    rng = np.random.default_rng(9)
    return model.first.evaluate(VOLTAGES) + noise * rng.standard_normal(VOLTAGES.size)


def identify_two_stage(
    voltages, forces, series, first=None, second=None, weights=None, order=20, smoothing=0.0, **own
):
    """Identify both stages; the first is the known one if there is one."""
    stage = identify_first_stage(voltages, forces, weights=weights, order=order, smoothing=smoothing)
    if first is not None:
        stage = dataclasses.replace(stage, model=first, modelled=first.evaluate(voltages))
    common = {"pretension": 0.3, "force_limit": 11.2, "order": order, "smoothing": smoothing}
    return identify_second_stage(stage, series, operator=second, **common | own)


@pytest.fixture(scope="module")
def exact():
    """A model, its series without noise, and what is found from them."""
    truth = two_stage()
    series = campaign(truth)
    return truth, series, identify_two_stage(VOLTAGES, resting(truth), series)


@pytest.fixture(scope="module")
def noisy():
    """The same with noise."""
    truth = two_stage(5)
    series = campaign(truth, noise=0.1)
    return truth, series, identify_two_stage(VOLTAGES, resting(truth, 0.05), series)


def test_recovers_a_two_stage_model(exact):
    _, _, found = exact
    assert found.errors["force-voltage"].rms < 1e-9
    # H1 fits its series, not the cells that the series leaves open: u is what counts for H2.
    assert found.errors["length-voltage"].rms_percent < 2.5
    assert found.errors["length-force"].rms_percent < 2.5
    for certificate in found.certificates.values():
        assert certificate.converged
        assert certificate.kkt_residual < 1e-10
    assert (found.model.first.density >= 0.0).all()
    assert (found.model.second.density >= 0.0).all()
    assert [found.residuals[k].size for k in ("force-voltage", "length-voltage", "length-force")] == [37, 185, 138]
    assert (found.model.voltage_unit, found.model.force_unit, found.model.length_unit) == ("V", "N", "mm")


def test_recovers_the_second_stage_exactly_if_the_first_is_right():
    first = plays(0.0, 3.0, [1.0, 0.5, 0.0, 2.0], 4.0)
    truth = TwoStage(first, preisach(-14.0, 14.0, -1.0, 5.0, 4), 0.3)
    blank = truth.second.with_coefficients(np.zeros(210), 0.0)
    found = identify_two_stage(VOLTAGES, resting(truth), campaign(truth), first=first, second=blank)
    assert found.errors["length-voltage"].maximum < 1e-8
    assert found.errors["length-force"].maximum < 1e-8
    other = Series.under_load(5.5, VOLTAGES, np.zeros(37))
    difference = predict_series(found.model, other) - predict_series(truth, other)
    assert np.abs(difference).max() < 0.1


def test_plays_in_the_second_stage():
    first = plays(0.0, 3.0, [1.0, 0.5, 0.0, 2.0], 4.0)
    truth = TwoStage(first, plays(-12.0, 12.0, [0.1, 0.0, 0.2, 0.05]), 0.3)
    blank = plays(-12.0, 12.0, np.zeros(4))
    found = identify_two_stage(VOLTAGES, resting(truth), campaign(truth), first=first, second=blank)
    assert found.model.second.weights == pytest.approx(truth.second.weights, abs=1e-10)
    assert found.model.second.bias == pytest.approx(0.0, abs=1e-10)


def test_second_fit_is_the_constrained_optimum(noisy):
    _, series, found = noisy
    model = found.model
    start = model.initial_state()
    rows, outputs = [], []
    for s in series:
        v, f = [p[0] for p in s.preparation], [p[1] for p in s.preparation]
        path = model.arguments(np.append(v, s.voltages), np.append(f, s.forces), start)
        rows.append(model.second.regressor(path, start.second).dense()[2 * len(v) + 1 :: 2])
        outputs.append(s.lengths)
    matrix, y = np.vstack(rows), np.concatenate(outputs)
    _, best = nnls(np.column_stack([matrix, np.ones(y.size), -np.ones(y.size)]), y)
    squares = sum(float(found.residuals[k] @ found.residuals[k]) for k in ("length-voltage", "length-force"))
    assert np.sqrt(squares) == pytest.approx(best, rel=1e-9)
    assert found.certificates["second"].kkt_residual < 1e-10


def test_of_several_weights_of_smoothness_the_best_on_samples_left_out_is_taken():
    second = smooth(-13.7, 13.7, ("N", "mm"))
    truth = Linear(3.8, -2.9, second, (0.0, 3.0), 0.3, "V")
    series, other = campaign(truth, noise=0.1), campaign(truth, seed=1)
    forces, tried = 3.8 * VOLTAGES - 2.9, (0.0, 1e-4, 1e-2)
    fits = [identify_linear(VOLTAGES, forces, series, smoothing=weight) for weight in tried]
    found = identify_linear(VOLTAGES, forces, series, smoothing=tried)
    (same,) = (fit for fit in fits if fit.smoothing == found.smoothing)
    np.testing.assert_array_equal(found.model.operator.coefficients, same.model.operator.coefficients)
    # The truth is smooth and the noise is not.
    assert found.smoothing == {"second": 1e-2}
    assert measure_series(found.model, other).rms < 0.8 * measure_series(fits[0].model, other).rms


def test_each_stage_has_a_smoothness_of_its_own():
    truth = TwoStage(smooth(0.0, 3.0, ("V", "N")), plays(-12.0, 12.0, [0.1, 0.0, 0.2, 0.05]), 0.3)
    found = identify_two_stage(
        VOLTAGES,
        resting(truth, 0.1),
        campaign(truth),
        second=plays(-12.0, 12.0, np.zeros(4)),
        smoothing=(1e-2, 0.0),
    )
    # Plays have no place in a plane, so that there is nothing to smooth.
    assert found.smoothing == {"first": 1e-2, "second": 0.0}


def test_both_planes_of_a_summed_model_are_smoothed():
    truth = Summed(smooth(0.0, 11.5, ("N", "mm")), smooth(0.0, 3.0, ("V", "mm")), 0.3)
    series, other = campaign(truth, noise=0.1), campaign(truth, seed=1)
    plain, smoothed = (identify_summed(series, order=25, smoothing=weight) for weight in (0.0, 1e-2))
    assert smoothed.certificates["second"].kkt_residual < 1e-10
    for plane in ("by_force", "by_voltage"):
        rough, even = (roughness(getattr(each.model, plane)) for each in (plain, smoothed))
        assert even < 0.3 * rough, plane
    assert measure_series(smoothed.model, other).rms < measure_series(plain.model, other).rms


def test_planes_beside_each_other_keep_their_neighbours():
    small, large = CellLayout.of(3), CellLayout.of(10)
    both = PlanesBeside.of_planes(small, large)
    rough = both.roughness.toarray()
    np.testing.assert_array_equal(rough[:3, :3], small.roughness.toarray())
    np.testing.assert_array_equal(rough[3:, 3:], large.roughness.toarray())
    assert not rough[:3, 3:].any()
    np.testing.assert_array_equal(both.neighbours[:3], small.neighbours)
    inside = large.neighbours >= 0
    np.testing.assert_array_equal(both.neighbours[3:][inside], large.neighbours[inside] + 3)
    assert (both.neighbours[3:][~inside] == -1).all()
    merged, parents = both.coarser()
    assert (merged.order, merged.cells.size) == (1, 1 + 3)
    np.testing.assert_array_equal(parents, [0, 0, 0, *(large.coarser()[1] + 1)])


def test_planes_and_resets(exact):
    truth, series, _ = exact
    found = identify_two_stage(VOLTAGES, resting(truth), series, order=10)
    first, second = found.model.first, found.model.second
    assert (first.levels[0], first.levels[-1], first.order) == (0.0, 3.0, 10)
    limit = max(11.2, first.output_range()[1]) + 0.3
    assert (second.levels[0], second.levels[-1], second.order) == (-limit, limit, 10)
    wide = identify_two_stage(VOLTAGES, resting(truth), series, force_limit=20.0, order=5)
    assert wide.model.second.levels[-1] == 20.3
    state = found.model.initial_state()
    cold = first.value(first.initial_state())
    assert state.argument == pytest.approx(0.3 - cold)
    # A load is hung on the cold wire; a voltage is set while there is no force.
    loaded, stretched = series[2], series[6]
    assert found.model.arguments(loaded.voltages, loaded.forces)[:2] == pytest.approx([4.9 - cold] * 2)
    assert stretched.preparation == ((0.0, 0.0), (0.6, 0.0))
    path = found.model.arguments([0.0, 0.6, 0.6], [0.0, 0.0, 1.0])
    warm = first.evaluate([0.6])[0]
    assert path == pytest.approx([-cold, -cold, -cold, -warm, 1.0 - warm, 1.0 - warm])


def test_weight_holds_the_force_of_the_cold_wire():
    truth = two_stage(1)
    forces = resting(truth, 0.05)
    forces[0] = 2.0
    weights = np.append(1e8, np.ones(forces.size - 1))
    series = campaign(truth)
    found = identify_two_stage(VOLTAGES, forces, series, weights=weights)
    assert found.model.initial_state().blocked == pytest.approx(2.0, abs=1e-4)
    assert found.certificates["first"].converged
    assert abs(identify_two_stage(VOLTAGES, forces, series).model.initial_state().blocked - 2.0) > 1e-3


def test_every_series_starts_from_its_own_reset(exact):
    truth, series, found = exact
    turned = identify_two_stage(VOLTAGES, resting(truth), series[::-1])
    for s in series:
        assert predict_series(turned.model, s) == pytest.approx(predict_series(found.model, s), abs=1e-7)


def test_errors_are_in_percent_of_the_range_over_all_series_of_a_kind(noisy):
    _, series, found = noisy
    lengths = np.concatenate([s.lengths for s in series[:5]])
    error = lengths - np.concatenate([predict_series(found.model, s) for s in series[:5]])
    errors = found.errors["length-voltage"]
    assert found.residuals["length-voltage"] == pytest.approx(error)
    assert errors.average_percent == pytest.approx(100.0 * np.abs(error).mean() / np.ptp(lengths))
    assert errors.rms_percent == pytest.approx(100.0 * np.sqrt((error**2).mean()) / np.ptp(lengths))
    assert measure_series(found.model, series[:5]) == errors


def test_recovers_a_summed_model():
    truth = Summed(preisach(0.0, 11.5, 0.0, 5.0, 1), preisach(0.0, 3.0, 0.0, 4.0, 2), 0.3)
    series = campaign(truth)
    found = identify_summed(series)
    assert found.errors["length-voltage"].maximum < 1e-8
    assert found.errors["length-force"].maximum < 1e-8
    assert set(found.errors) == {"length-voltage", "length-force"}
    assert found.certificates["second"].converged
    levels = found.model.by_force.levels, found.model.by_voltage.levels
    assert [(x[0], x[-1]) for x in levels] == [(0.0, 11.5), (0.0, 3.0)]
    assert (found.model.by_force.density >= 0.0).all()
    assert (found.model.by_voltage.density >= 0.0).all()
    assert found.model.by_voltage.bias == 0.0


def test_recovers_a_linear_model():
    second = preisach(-13.7, 13.7, -1.0, 5.0, 1, units=("N", "mm"))
    truth = Linear(3.8, -2.9, second, (0.0, 3.0), 0.3, "V")
    forces = 3.8 * VOLTAGES - 2.9
    series = campaign(truth)
    found = identify_linear(VOLTAGES, forces, series)
    assert (found.model.slope, found.model.offset) == (pytest.approx(3.8), pytest.approx(-2.9))
    assert found.errors["force-voltage"].maximum < 1e-12
    assert found.errors["length-voltage"].maximum < 1e-7
    assert found.errors["length-force"].maximum < 1e-7
    # The plane holds every argument that occurred.
    assert found.model.operator.levels[-1] == pytest.approx(10.5 + 2.9 + 0.3)


def test_richer_model_wins_on_its_own_data():
    truth = two_stage(6)
    series = campaign(truth, noise=0.02)
    forces = resting(truth, 0.02)
    two, summed, line = (
        identify_two_stage(VOLTAGES, forces, series),
        identify_summed(series),
        identify_linear(VOLTAGES, forces, series),
    )
    for kind in ("length-voltage", "length-force"):
        assert two.errors[kind].rms < summed.errors[kind].rms
        assert two.errors[kind].rms < line.errors[kind].rms


@cases("make", [lambda: preisach(-5.0, 5.0, -1.0, 1.0, 0, order=6), lambda: plays(-5.0, 5.0, [1.0, 0.5])])
def test_chained_and_paired_regressors(make):
    rng = np.random.default_rng(1)
    operator = make()
    parts = []
    for count in (5, 1, 9):
        start, _ = operator.step(operator.initial_state(), rng.uniform(-5.0, 5.0))
        parts.append(operator.regressor(rng.uniform(-5.0, 5.0, count), start))
    chain = _chained(parts)
    assert chain.dense() == pytest.approx(np.vstack([r.dense() for r in parts]), abs=1e-12)
    weights = rng.random(chain.shape[1])
    assert chain.product(weights) == pytest.approx(chain.dense() @ weights, abs=1e-12)
    other = preisach(0.0, 1.0, 0.0, 1.0, 3, order=4).regressor(rng.random(9))
    both = _beside(parts[2], other)
    cells = parts[2].base.size
    mine, theirs = parts[2].dense(), other.dense()
    assert both.dense() == pytest.approx(np.hstack([mine[:, :cells], -theirs, mine[:, cells:]]), abs=1e-12)


def test_voltage_steps():
    steps = voltage_steps()
    assert steps.size == 37
    assert steps[0] == 0.0
    assert {3.0, 0.3, 2.7, 0.6, 2.4, 0.9, 2.1, 1.2, 1.8, 1.5} <= set(steps)
    assert np.abs(np.diff(steps)).max() == pytest.approx(0.525)
    assert steps[-1] == 1.5
    assert voltage_steps(12).size == 12


def data():
    return Series.under_load(1.0, [0.0, 1.0, 2.0], [0.0, -1.0, -2.0])


@cases(
    ("make", "message"),
    [
        (lambda: Series("force", [0.0], [0.0], [0.0]), "kind: expected 'length-voltage'"),
        (lambda: Series("length-force", [0.0], [0.0], [0.0, 1.0]), "lengths: expected 1 values"),
        (lambda: Series("length-force", [0.0], [0.0], [0.0], ((1.0,),)), "preparation: expected pairs"),
        (lambda: Series.under_load(np.nan, [0.0], [0.0]), "load: expected a finite"),
        (lambda: Series.at_voltage(np.nan, [0.0], [0.0]), "voltage: expected a finite"),
        (lambda: identify_two_stage([0.0, 1.0], [0.3, 1.0], []), "series: expected at least one"),
        (lambda: identify_two_stage([0.1, 3.0], [0.3, 1.0], [data()]), "voltages: expected a sample at the lowest"),
        (lambda: identify_two_stage([0.0, 3.0], [0.3], [data()]), "forces: expected 2 values"),
        (lambda: identify_linear([0.1, 3.0], [0.3, 1.0], [data()]), "voltages: expected a sample at the lowest"),
        (lambda: identify_linear([0.0, 3.0], [3.0, 1.0], [data()]), "slope: expected a number >= 0"),
        (lambda: identify_summed([]), "series: expected at least one"),
        (lambda: measure_series(two_stage(), []), "series: expected at least one"),
        (lambda: voltage_steps(count=5), "count: expected at least 11"),
    ],
)
def test_wrong_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()
