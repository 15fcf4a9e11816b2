"""The columns that are written of models beside measurements."""

import numpy as np
import pytest

from bench.analysis import Applied, Quantity, rows_table
from bench.identification import ModelFile
from bench.models import Polynomial

INPUTS = np.array([0.0, 0.5, 1.0])


def applied(slope, fit_rms, sensor):
    """Return a line with a stated uncertainty beside measurements that are 1 mm more."""
    stated = {"outputs": [0.0, 1.0], "standard": [sensor, sensor]}
    model = Polynomial(np.array([slope]), (-1.0, 1.0), input_unit="V", output_unit="mm")
    file = ModelFile("polynomial", model, provenance={"rms": fit_rms, "uncertainty": stated})
    predicted = slope * INPUTS
    return Applied(file, Quantity("drive", "V", INPUTS), predicted, Quantity("y", "mm", predicted + 1.0))


def test_each_of_several_models_has_its_own_columns():
    table = dict(rows_table({"coarse": applied(2.0, 3.0, 4.0), "fine": applied(1.0, 0.3, 0.4)}))

    assert list(table) == [
        "drive [V]", "measured [mm]",
        "coarse predicted [mm]", "coarse u_predicted [mm]", "coarse residual [mm]",
        "fine predicted [mm]", "fine u_predicted [mm]", "fine residual [mm]",
    ]  # fmt: skip
    assert table["coarse u_predicted [mm]"] == pytest.approx(np.full(3, 5.0))
    assert table["fine u_predicted [mm]"] == pytest.approx(np.full(3, 0.5))
    assert table["fine residual [mm]"] == pytest.approx(np.ones(3))


def test_the_columns_of_one_model_do_not_name_it():
    table = dict(rows_table({"fine": applied(1.0, 0.3, 0.4)}))

    assert list(table) == ["drive [V]", "measured [mm]", "predicted [mm]", "u_predicted [mm]", "residual [mm]"]
