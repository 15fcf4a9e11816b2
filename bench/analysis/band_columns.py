"""Prediction bands beside predictions and inverted set-points: what the commands write and print."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis.tables.dataset import Dataset
from bench.base import header_with_unit, prefixed
from bench.identification import (
    Band,
    Identification,
    ModelFile,
    Regularization,
    calibrate_band,
    calibrate_band_in_time,
    input_half_widths,
    set_up_problem,
)

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BandedPrediction:
    """The band about the predictions of a model for one sequence of inputs.

    Attributes
    ----------
    band : Band
        The model's band.
    half_widths : ndarray, shape (N,)
        Half-width at each row, output units.
    unit : str
        Unit of the output.
    holds_for : str
        The inputs for which it holds.
    """

    band: Band
    half_widths: Floats
    unit: str
    holds_for: str

    def columns(self, predicted: Floats) -> list[tuple[str, Floats]]:
        """Return heads and values of the lower and the upper end of the band, shape (N,) each."""
        return [
            (header_with_unit("predicted lower", self.unit), predicted - self.half_widths),
            (header_with_unit("predicted upper", self.unit), predicted + self.half_widths),
        ]

    @property
    def label(self) -> str:
        """The band in a figure."""
        return f"{100 * self.band.level:g} % prediction band"

    def coverage(self, residuals: Floats) -> float:
        """Return the share of residuals, shape (n,), of the last n rows that lie within the band, 0 to 1."""
        return float((np.abs(residuals) <= self.half_widths[self.half_widths.size - residuals.size :]).mean())

    def text(self, residuals: Floats | None = None) -> str:
        """Return the band in a line, with its coverage of measured outputs if their residuals are given."""
        width = f"± {prefixed(float(np.median(self.half_widths)), self.unit)}"
        covered = "" if residuals is None else f"; covers {100 * self.coverage(residuals):.1f} % of the rows measured"
        return f"{100 * self.band.level:g} % band: {width} (median); holds for inputs of {self.holds_for}{covered}"

    def rows(self) -> list[tuple[str, str]]:
        """Return what the band is: name and value of each row of a table."""
        widths = [
            ("half-width, median", np.median(self.half_widths)),
            ("half-width, largest", self.half_widths.max()),
        ]
        return [
            ("level", f"{100.0 * self.band.level:g} %"),
            *((name, prefixed(float(value), self.unit)) for name, value in widths),
            ("holds for inputs", self.holds_for),
        ]

    def to_json(self, residuals: Floats | None = None) -> dict[str, Any]:
        """Return the band for programs; `coverage` is None without residuals of measured outputs."""
        return {
            "level": self.band.level,
            "half_width": float(np.median(self.half_widths)),
            "largest_half_width": float(self.half_widths.max()),
            "coverage": None if residuals is None else self.coverage(residuals),
        }


def predict_band(
    model: ModelFile,
    inputs: Floats,
    state: Any = None,  # noqa: ANN401 - each operator has its own
) -> BandedPrediction | None:
    """Return the band of a model's predictions for inputs, shape (N,); None if its file has none.

    Parameters
    ----------
    model : ModelFile
        The model.
    inputs : ndarray, shape (N,)
        In the unit of the model, finite.
    state : object
        State before the first row; None is the initial one.
    """
    band, response = model.band, model.response
    if band is None:
        return None
    holds_for = model.valid.text(response.input_unit)
    return BandedPrediction(band, band.half_widths(response, inputs, state), response.output_unit, holds_for)


@dataclass(frozen=True)
class BandedTargets:
    """The band at inverted set-points.

    Attributes
    ----------
    outputs : BandedPrediction
        The band of the output at each set-point.
    setpoints : ndarray, shape (N,), or None
        Half-width about each set-point within which the target is met: that of the output over the local slope, in
        input units; nan where that is more than the operating range, as the output hardly moves with the input. None
        of a model with time, whose output depends on more than the last set-point.
    """

    outputs: BandedPrediction
    setpoints: Floats | None

    def columns(self, setpoints: Floats, predicted: Floats, unit: str) -> list[tuple[str, Floats | list[object]]]:
        """Return heads and values of both bands, the set-points in `unit`; empty cells where there is no slope."""

        def shown(values: Floats) -> list[object]:
            return ["" if value != value else value for value in values.tolist()]

        if self.setpoints is None:
            return [*self.outputs.columns(predicted)]
        return [
            (header_with_unit("setpoint lower", unit), shown(setpoints - self.setpoints)),
            (header_with_unit("setpoint upper", unit), shown(setpoints + self.setpoints)),
            *self.outputs.columns(predicted),
        ]


def invert_band(
    model: ModelFile,
    setpoints: Floats,
    passing: Floats,
    state: Any = None,  # noqa: ANN401 - each operator has its own
    times: Floats | None = None,
) -> BandedTargets | None:
    """Return the band at set-points that an inverse found; None if the model's file has none.

    Parameters
    ----------
    model : ModelFile
        The model.
    setpoints : ndarray, shape (N,)
        Input units.
    passing : ndarray, shape (N,)
        Set-point to pass before each; nan where there is none.
    state : object
        State before the first target; None is the initial one.
    times : ndarray, shape (N,), or None
        s, for a model with time.
    """
    if model.band is None:
        return None
    if times is not None:
        outputs = predict_band(model, setpoints, state)
        assert outputs is not None
        return BandedTargets(outputs, None)
    both = np.column_stack([passing, setpoints]).ravel()
    taken = np.isfinite(both)
    places = (np.cumsum(taken) - 1)[1::2]
    path = both[taken]
    found = predict_band(model, path, state)
    assert found is not None
    widths = input_half_widths(model.operator, path, found.half_widths, state)[places]
    return BandedTargets(replace(found, half_widths=found.half_widths[places]), widths)


def calibrate(
    found: Identification[Any], data: Dataset, skip: int, penalties: Regularization, options: Mapping[str, Any]
) -> Band:
    """Return the band of the model that was identified with the same arguments; errors as `calibrate_band`."""
    inputs, outputs, weights = data.inputs, data.outputs, data.weights
    if data.times is not None:
        return calibrate_band_in_time(found, data.times, inputs, outputs, weights=weights, skip=skip, **options)
    own = dict(options)
    initial, orientation = own.pop("initial", None), own.pop("orientation", "auto")
    problem = set_up_problem(
        found.model_name, inputs, outputs, weights, skip, penalties.smoothing, initial, own, orientation=orientation
    )
    return calibrate_band(problem, penalties.smoothing, penalties.ridge)
