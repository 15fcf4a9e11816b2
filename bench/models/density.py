"""A Preisach density on its plane, as a model offers it for drawing."""

from __future__ import annotations

from dataclasses import dataclass

from bench.base import Floats


@dataclass(frozen=True, eq=False)
class Density:
    """A density over the half-plane α >= β of up- and down-thresholds.

    Attributes
    ----------
    title : str
        Name of the operator within its model, such as `H2`; empty for a model of one operator.
    levels : ndarray, shape (M + 1,)
        Increasing edges of rows and columns, input units.
    values : ndarray, shape (M, M)
        Density by cell, indexed [α, β], output units per input unit squared; nan above the diagonal.
    unit : str
        Unit of the levels, empty if unknown.
    output_unit : str
        Unit of the output, empty if unknown.
    measured : bool
        Whether the input is a quantity that is measured, not one that only the model knows.
    """

    title: str
    levels: Floats
    values: Floats
    unit: str
    output_unit: str = ""
    measured: bool = True


def density_unit(output_unit: str, input_unit: str) -> str:
    """Return the unit of a density, such as `(1/m)/°C²`."""
    output, squared = (f"({unit})" if "/" in unit else unit or "1" for unit in (output_unit, input_unit))
    return f"{output}/{squared}²"
