"""Prediction bands beside predictions and inverted set-points: what the commands write and print."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis.tables.dataset import Dataset
from bench.base import header_with_unit
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
    simultaneous : ndarray, shape (N,), or None
        The same of the band that covers all rows of a stretch at once; None if the file has none.
    departures : tuple of str
        In which ways the inputs are not of the class on which the band was calibrated; none if they are.
    unit : str
        Unit of the output.
    """

    band: Band
    half_widths: Floats
    simultaneous: Floats | None
    departures: tuple[str, ...]
    unit: str

    def columns(self, predicted: Floats) -> list[tuple[str, Floats]]:
        """Return heads and values of the lower and the upper end of the band, shape (N,) each."""
        return [
            (header_with_unit("predicted lower", self.unit), predicted - self.half_widths),
            (header_with_unit("predicted upper", self.unit), predicted + self.half_widths),
        ]

    @property
    def label(self) -> str:
        """The band in a figure; marked where the inputs are of another class than that of the calibration."""
        return f"{100 * self.band.level:g} % prediction band" + (", other class of input" if self.departures else "")

    def coverage(self, residuals: Floats) -> float:
        """Return the share of residuals, shape (n,), of the last n rows that lie within the band, 0 to 1."""
        return float((np.abs(residuals) <= self.half_widths[self.half_widths.size - residuals.size :]).mean())

    def text(self, residuals: Floats | None = None) -> str:
        """Return the band in a line, with its coverage of measured outputs if their residuals are given."""
        width = f"± {np.median(self.half_widths):.4g} {self.unit}".rstrip()
        covered = "" if residuals is None else f"; covers {100 * self.coverage(residuals):.1f} % of the rows measured"
        kind = self.band.calibrated_on.kind
        return f"{100 * self.band.level:g} % band: {width} (median); calibrated on {kind}{covered}"

    def warning(self) -> str:
        """Return a warning if the inputs are not of the class of the band, else an empty text."""
        if not self.departures:
            return ""
        return (
            f"this input is of another class than the {self.band.calibrated_on.kind} on which the band was "
            f"calibrated: {'; '.join(self.departures)}; the band may cover far less than "
            f"{100 * self.band.level:g} %. Calibrate on inputs like this one: `bench identify --band`"
        )

    def rows(self) -> list[tuple[str, str]]:
        """Return what the band is: name and value of each row of a table."""
        widths = [
            ("half-width, median", np.median(self.half_widths)),
            ("half-width, largest", self.half_widths.max()),
        ]
        if self.simultaneous is not None:
            widths.append((f"half-width for all of {self.band.stretch} rows", np.median(self.simultaneous)))
        return [
            ("level", f"{100.0 * self.band.level:g} %"),
            *((name, f"{value:.4g} {self.unit}".rstrip()) for name, value in widths),
            ("calibrated on", self.band.calibrated_on.kind),
        ]

    def to_json(self, residuals: Floats | None = None) -> dict[str, Any]:
        """Return the band for programs; `coverage` is None without residuals of measured outputs."""
        together = self.simultaneous
        return {
            "level": self.band.level,
            "half_width": float(np.median(self.half_widths)),
            "largest_half_width": float(self.half_widths.max()),
            "simultaneous_half_width": None if together is None else float(np.median(together)),
            "stretch": self.band.stretch,
            "calibrated_on": self.band.calibrated_on.kind,
            "departures": list(self.departures),
            "coverage": None if residuals is None else self.coverage(residuals),
        }


def predict_band(
    model: ModelFile,
    inputs: Floats,
    state: Any = None,  # noqa: ANN401 - each operator has its own
    times: Floats | None = None,
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
    times : ndarray, shape (N,), or None
        s, for a model with time.
    """
    band = model.band
    if band is None:
        return None
    operator = model.response
    spread = band.spread(operator, inputs, state)
    return BandedPrediction(
        band,
        band.pointwise * spread,
        None if band.simultaneous is None else band.simultaneous * spread,
        band.departures(inputs, spread, times),
        operator.output_unit,
    )


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
        outputs = predict_band(model, setpoints, state, times)
        assert outputs is not None
        return BandedTargets(outputs, None)
    both = np.column_stack([passing, setpoints]).ravel()
    taken = np.isfinite(both)
    places = (np.cumsum(taken) - 1)[1::2]
    path = both[taken]
    found = predict_band(model, path, state)
    assert found is not None
    widths = input_half_widths(model.operator, path, found.half_widths, state)[places]
    together = None if found.simultaneous is None else found.simultaneous[places]
    at = BandedPrediction(found.band, found.half_widths[places], together, found.departures, found.unit)
    return BandedTargets(at, widths)


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
