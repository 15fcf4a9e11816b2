"""Moving the density of a Preisach plane."""

import numpy as np
import pytest

from bench.models import Preisach, transported, uniform_levels, widened, widening


def plane(levels, centre=6.0, width=2.0):
    middle = 0.5 * (levels[1:] + levels[:-1])
    rows, columns = np.tril_indices(middle.size)
    alpha, beta = middle[rows], middle[columns]
    return np.exp(-((0.5 * (alpha + beta) - centre) ** 2) - (alpha - beta - width) ** 2)


@pytest.mark.parametrize("levels", [uniform_levels(0.0, 12.0, 24), np.array([0.0, 1.0, 1.5, 4.0, 7.0, 7.5, 12.0])])
class TestTransported:
    def test_nothing_changes_without_a_move(self, levels):
        masses = plane(levels)
        np.testing.assert_allclose(transported(levels, masses, widening(1.0)), masses, rtol=1e-12, atol=0)

    def test_the_sum_of_either_sign_is_kept_wherever_it_goes(self, levels):
        masses = plane(levels) * np.random.default_rng(1).normal(size=plane(levels).size)
        for far in (0.1, 3.0, -50.0):
            moved = transported(levels, masses, lambda alpha, beta, far=far: (alpha * 0 + far, beta * 0 - 0.3 * far))
            assert moved.sum() == pytest.approx(masses.sum(), abs=1e-12)

    def test_masses_are_continuous_in_the_move(self, levels):
        masses = plane(levels)
        found = [transported(levels, masses, widening(factor)) for factor in np.linspace(0.9, 1.1, 201)]
        assert np.abs(np.diff(found, axis=0)).max() < 0.02 * masses.max()


def test_a_move_by_a_whole_cell_is_that_of_the_density():
    levels = uniform_levels(0.0, 12.0, 24)
    masses = plane(levels)
    moved = transported(levels, masses, lambda alpha, beta: (alpha * 0 + 0.5, beta * 0 + 0.5))
    order = 24
    before, after = np.zeros((2, order, order))
    before[np.tril_indices(order)], after[np.tril_indices(order)] = masses, moved
    np.testing.assert_allclose(after[1:-1, 1:-1], before[:-2, :-2], rtol=1e-9, atol=1e-15)


def test_a_widened_operator_has_loops_that_much_wider():
    levels = uniform_levels(0.0, 12.0, 48)
    operator = Preisach(levels, plane(levels))
    sweep = np.concatenate([np.linspace(0.0, 12.0, 481), np.linspace(12.0, 0.0, 481)])

    def width(each):
        outputs = each.evaluate(sweep)
        middle = 0.5 * (outputs.min() + outputs.max())
        up, down = outputs[:481], outputs[481:]
        return np.interp(middle, up, sweep[:481]) - np.interp(middle, down[::-1], sweep[:481])

    assert width(widened(operator, 1.4)) == pytest.approx(1.4 * width(operator), rel=0.01)
    assert widened(operator, 1.0) is operator
