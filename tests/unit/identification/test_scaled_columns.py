"""Products of centred, scaled columns, and of some of them, against the dense matrix."""

import numpy as np
from cases import cases
from scipy.sparse import csr_array

from bench.identification.fit.scaled_columns import ScaledColumns
from bench.models import Preisach, QuadraticTerm, uniform_levels
from bench.models.kernels.memory_kernels import by_column


@cases("penalised", [False, True])
@cases("places", [np.arange(17), np.array([0, 3, 4, 9, 14, 16]), np.array([2, 5]), np.array([15])])
def test_products_are_those_of_the_dense_columns(penalised, places):
    rng = np.random.default_rng(0)
    operator = Preisach(uniform_levels(-1.0, 1.0, 5), np.zeros(15), reversible=QuadraticTerm(-0.8, -0.3))
    regressor = operator.regressor(rng.uniform(-1.0, 1.0, 40))
    weights = rng.uniform(0.0, 2.0, 40)
    means = weights @ regressor.dense() / weights.sum()
    norms = rng.uniform(0.5, 2.0, 17)
    matrix = (regressor.dense() - means) / norms
    penalty = np.zeros((17, 17))
    if penalised:
        rough = rng.normal(size=(15, 15))
        penalty[:15, :15] = rough @ rough.T
    columns = ScaledColumns(
        changes=by_column(regressor.starts, regressor.cells, regressor.changes, 15),
        base=regressor.base,
        means=means[:15],
        norms=norms,
        extra=matrix[:, 15:].copy(),
        weights=weights,
        total=float(weights.sum()),
        penalty=csr_array(penalty[:15, :15]) if penalised else None,
    ).chosen(places)
    some = matrix[:, places]
    x, residual = rng.normal(size=places.size), rng.normal(size=40)
    np.testing.assert_allclose(columns.model(x), some @ x, atol=1e-12)
    np.testing.assert_allclose(columns.products(residual), some.T @ (weights * residual), atol=1e-12)
    block = some.T @ (weights[:, None] * some) + penalty[np.ix_(places, places)]
    np.testing.assert_allclose(columns.gram_product(x), block @ x, atol=1e-12)
