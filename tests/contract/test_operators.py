"""Every operator of the bench keeps the contract of operators."""

from functools import cache

import numpy as np
import pytest

from bench.contracts import OperatorContract
from bench.identification import identify
from bench.models import identifiable_models

# Nested loops; the output is that of two plays and a curve, so that no model fits it to the last digit.
INPUTS = np.concatenate([np.linspace(a, b, 25) for a, b in ((0, 3), (3, 0.2), (0.2, 2.6), (2.6, 0.7), (0.7, 3))])
OPTIONS = {"polynomial": {"degree": 5}, "preisach-nonmonotonic": {"levels": 6, "plane": (0.5, 2.5)}}


@cache
def identified(name):
    plays, outputs = np.zeros(2), []
    for value in INPUTS:
        plays = np.clip(plays, value - np.array([0.2, 0.6]), value + np.array([0.2, 0.6]))
        outputs.append(1.0 + plays.sum() + 0.1 * np.sin(value))
    return identify(name, INPUTS, outputs, **OPTIONS.get(name, {})).model


@pytest.mark.parametrize("name", sorted(identifiable_models()))
class TestOperator(OperatorContract):
    @pytest.fixture
    def operator(self, name):
        return identified(name)
