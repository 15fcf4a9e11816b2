"""A model beside measurements, row by row: the columns that `bench predict` and `bench model test` write."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from bench.analysis.band_columns import BandedPrediction
from bench.analysis.tables.data import Quantity
from bench.analysis.tables.dataset import Dataset
from bench.analysis.uncertain_models import predicted_uncertainty
from bench.base import DataError, Floats, header_with_unit
from bench.identification import Errors, ModelFile, measure_errors


def check_finite(
    model: str, what: str, values: Floats, unit: str, given: Floats, of_given: str, unit_given: str
) -> None:
    """Check that what a model gave for N rows, shape (N,), is finite.

    Raises DataError otherwise: names the model, the first wrong row (from 1), and what it was given there.
    """
    wrong = np.flatnonzero(~np.isfinite(values))
    if wrong.size:
        row = int(wrong[0])
        value, at = f"{values[row]:g} {unit}".rstrip(), f"{given[row]:g} {unit_given}".rstrip()
        raise DataError(
            f"model {model}: its {what} is {value} in row {row + 1}, where the {of_given} is {at}, and not finite in "
            f"{wrong.size} of {values.size} rows: its numbers overflow; check its coefficients, and that the input "
            "is in the range that it was identified for"
        )


@dataclass(frozen=True)
class Predictions:
    """Outputs of models for one sequence of inputs, beside what was measured.

    Raises DataError if a model has an output that is not finite.

    Attributes
    ----------
    input : Quantity
        The inputs.
    unit : str
        Unit of the output; empty if unknown.
    predicted : mapping of str to ndarray
        Outputs by the name of the model, shape (N,) each.
    measured : Quantity or None
        The measured outputs, where there are some.
    time : Quantity or None
        When each row was taken, where it is known.
    skip : int
        First rows, which drive the memory but count in no error.
    bands : mapping of str to BandedPrediction
        Prediction bands of those models that have one.
    uncertainties : mapping of str to ndarray
        Standard uncertainties of the predicted outputs, shape (N,) each, of the models whose file has them.
    """

    input: Quantity
    unit: str
    predicted: Mapping[str, Floats]
    measured: Quantity | None = None
    time: Quantity | None = None
    skip: int = 0
    bands: Mapping[str, BandedPrediction] = field(default_factory=dict)
    uncertainties: Mapping[str, Floats] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        model: ModelFile,
        data: Dataset,
        predicted: Mapping[str, Floats],
        skip: int,
        bands: Mapping[str, BandedPrediction | None],
    ) -> Predictions:
        """Return what models give for a dataset; units that its file does not say are those of `model`."""
        unit = model.response.output_unit
        uncertain = {name: predicted_uncertainty(model, values) for name, values in predicted.items()}
        return cls(
            replace(data.input, unit=data.input.unit or model.response.input_unit),
            unit,
            predicted,
            data.output and replace(data.output, unit=data.output.unit or unit),
            None if data.times is None else Quantity("time", "s", data.times),
            skip=skip,
            bands={name: band for name, band in bands.items() if band is not None},
            uncertainties={name: each for name, each in uncertain.items() if each is not None},
        )

    def __post_init__(self) -> None:
        """Raise DataError if an output is not finite."""
        for name, values in self.predicted.items():
            check_finite(name, "output", values, self.unit, self.input.values, "input", self.input.unit)

    def residuals(self) -> dict[str, Floats]:
        """Return measured minus predicted output by model, shape (N,) each; none without measurements."""
        if self.measured is None:
            return {}
        return {name: self.measured.values - values for name, values in self.predicted.items()}

    def errors(self) -> dict[str, Errors]:
        """Return the errors over the rows after `skip` by model; none without measurements."""
        if self.measured is None:
            return {}
        measured = self.measured.values[self.skip :]
        return {name: measure_errors(measured, values[self.skip :]) for name, values in self.predicted.items()}

    def table(self) -> list[tuple[str, Floats]]:
        """Return the columns of a file with their heads: time, input, measured; what belongs to each model.

        The model is named in the heads if there are several.
        """
        columns = [(each.header, each.values) for each in (self.time, self.input) if each is not None]
        if self.measured is not None:
            columns.append((header_with_unit("measured", self.unit), self.measured.values))
        residuals = self.residuals()
        for name, values in self.predicted.items():
            prefix = f"{name} " if len(self.predicted) > 1 else ""
            columns.append((header_with_unit(f"{prefix}predicted", self.unit), values))
            if name in self.uncertainties:
                columns.append((header_with_unit(f"{prefix}u_predicted", self.unit), self.uncertainties[name]))
            if name in residuals:
                columns.append((header_with_unit(f"{prefix}residual", self.unit), residuals[name]))
        for name, band in self.bands.items():
            prefix = f"{name} " if len(self.predicted) > 1 else ""
            columns += [(f"{prefix}{head}", values) for head, values in band.columns(self.predicted[name])]
        return columns
