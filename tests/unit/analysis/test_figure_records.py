"""Long records in figures keep what can be seen of them."""

import numpy as np

from bench.analysis.figures.canvas import outline

COLUMNS = 700


def test_outline_keeps_ends_and_extremes_of_each_column_and_its_gaps():
    rng = np.random.default_rng(5)
    horizontal = np.sort(rng.uniform(0.0, 50.0, 9000))
    vertical = np.cumsum(rng.normal(size=9000))
    vertical[2000:3500] = np.nan
    x, y = outline(horizontal, vertical)
    assert x.size < 4 * COLUMNS
    assert (np.diff(x) >= 0.0).all()
    assert np.isnan(y).any()
    edges = horizontal[0] + np.linspace(0.0, np.ptp(horizontal), COLUMNS + 1)[1:-1]
    of_all, of_kept = (np.searchsorted(edges, each, side="right") for each in (horizontal, x))
    for column in range(COLUMNS):
        whole, kept = vertical[of_all == column], y[of_kept == column]
        assert (whole[0], whole[-1]) == (kept[0], kept[-1]) or np.isnan([whole[0], whole[-1]]).any()
        if np.isfinite(whole).any():
            assert (np.nanmin(whole), np.nanmax(whole)) == (np.nanmin(kept), np.nanmax(kept))


def test_outline_leaves_short_and_jumping_records_as_they_are():
    few = np.arange(4.0 * COLUMNS)
    assert outline(few, few)[0] is few
    back = np.tile(few, 2)
    assert outline(back, back)[0] is back
