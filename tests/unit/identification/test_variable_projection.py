"""Nonlinear least squares with the linear coefficients eliminated."""

import numpy as np
import pytest
from cases import cases

from bench.identification import Evidence, Separable, Stage, fit, variable_projection
from bench.models import Regressor

TIMES = np.linspace(0.0, 4.0, 200)
TRUE = np.log([0.3, 2.0])


def columns(logarithms):
    return np.exp(-TIMES[:, None] / np.exp(logarithms))


def measured(noise=0.0, signs=(1.5, 0.8)):
    return columns(TRUE) @ np.array(signs) + 0.4 + noise * np.random.default_rng(0).normal(size=TIMES.size)


def separable(outputs, roots=None, **options):
    return Separable(outputs, np.ones(TIMES.size) if roots is None else roots, columns, **options)


@cases("unit", [1e-9, 1.0, 1e9])
def test_times_coefficients_and_bias_are_found_exactly_in_any_unit(unit):
    problem = separable(unit * measured())
    end = variable_projection(problem, [np.log([0.1, 5.0])])[0]
    assert end.converged
    assert end.values == pytest.approx(TRUE, abs=1e-7)
    assert problem.coefficients(end.values) == pytest.approx(unit * np.array([1.5, 0.8, 0.4]), rel=1e-6)
    assert end.cost < (1e-8 * unit) ** 2


def test_the_jacobian_gives_the_gradient_of_the_cost_and_so_do_differences():
    roots = np.random.default_rng(1).uniform(0.5, 2.0, TIMES.size)
    problem, at, far = separable(measured(0.05), roots), np.log([0.2, 3.0]), np.full(2, np.inf)

    def cost(values):
        return 0.5 * float(np.sum(problem.residuals(values) ** 2))

    expected = [(cost(at + e) - cost(at - e)) / 2e-5 for e in 1e-5 * np.eye(2)]
    assert problem.jacobian(at, -far, far).T @ problem.residuals(at) == pytest.approx(expected, rel=1e-5)
    ends = [variable_projection(each, [at])[0].values for each in (problem, problem.residuals)]
    assert ends[0] == pytest.approx(ends[1], abs=1e-5)


def test_coefficients_with_signs_stay_at_zero_and_do_not_take_over_slopes():
    outputs = measured(signs=(-0.5, 1.0))

    def constrained(columns):
        return fit(Regressor.of_columns(columns), outputs, nonnegative=True)

    problem = separable(outputs, fit=constrained)
    end = variable_projection(problem, [TRUE], stages=[Stage(1, 1e-8, 3)])[0]
    assert problem.coefficients(end.values)[0] == 0.0
    assert np.linalg.norm(end.jacobian[:, 0]) == 0.0
    assert Evidence.of(end.jacobian, end.residuals, 100).deviations[0] == np.inf


def test_the_deviations_are_the_scatter_of_the_estimates():
    rng = np.random.default_rng(2)
    ends = [
        variable_projection(separable(measured() + 0.01 * rng.normal(size=TIMES.size)), [TRUE])[0] for _ in range(100)
    ]
    found = Evidence.of(ends[0].jacobian, ends[0].residuals, TIMES.size - 5)
    assert found.deviations == pytest.approx(np.std([end.values for end in ends], axis=0), rel=0.25)
    assert found.cosines.max() < 1e-4
    assert found.condition > 1.0


def test_the_best_of_several_starts_wins_within_bounds():
    def residuals(values):
        # Minima at -1 and, lower, at 2.
        return np.array([(values[0] + 1.0) * (values[0] - 2.0), 0.1 * (values[0] - 2.0)])

    starts = [np.array([start]) for start in (-3.0, -1.5, -0.9, 1.0)]
    every = variable_projection(residuals, starts, stages=[Stage(4, 1e-8, 50)])
    assert [round(float(end.values[0]), 1) for end in every] == [2.0, -1.0, -1.0, -1.0]
    assert variable_projection(residuals, starts)[0].values[0] == pytest.approx(2.0)
    bounds = np.array([0.6]), np.array([1.5])
    assert variable_projection(residuals, starts, bounds)[0].values[0] == pytest.approx(1.5)
    # Of neighbours one is searched from.
    assert len(variable_projection(residuals, starts, stages=[Stage(3, 1e-8, 50)], apart=2.0)) == 2


@cases("central", [False, True])
def test_a_parameter_of_zero_is_found_as_exactly_as_another(central):
    def residuals(values):
        return values[1] * np.exp(values[0] * TIMES) - 2.0

    end = variable_projection(residuals, [np.array([0.1, 1.0])], step=1e-6, central=central)[0]
    assert end.values == pytest.approx([0.0, 2.0], abs=1e-9)
    expected = np.column_stack([2.0 * TIMES, np.ones(TIMES.size)])
    np.testing.assert_allclose(end.jacobian, expected, atol=1e-5)


def test_without_parameters_there_is_but_the_linear_problem():
    problem = Separable(TIMES, np.ones(TIMES.size), lambda _: TIMES[:, None])
    end = variable_projection(problem, [np.empty(0)])[0]
    assert end.values.size == 0
    assert end.cost < 1e-20
