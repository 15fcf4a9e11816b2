"""The model that `bench identify` chooses errs hardly more than the best of a grid of settings by hand."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))

from renew_selection import WITHIN, show
from selection_quality import CASES, case, choose


@pytest.mark.benchmark
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_choice_beside_the_best_by_hand(seed, capsys):
    ratios, few = [], []
    with capsys.disabled():
        print(f"\nseed {seed}: errors on other reversals, % of the range: default / best by hand, ratio")
        for plant, kind in CASES:
            found = choose(case(kind, plant, seed))
            ratios.append(found.ratio)
            if kind == "60 samples":
                few.append(found.error / found.simple)
            show(f"{plant} {kind}", found)
        print(f"ratio: median {np.median(ratios):.2f}, {np.mean(np.array(ratios) <= WITHIN):.0%} within {WITHIN:g}")
    assert np.median(ratios) <= WITHIN
    assert max(few) <= 1.5
