"""Prediction bands beside predictions: what the commands write and print."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.analysis.tables.dataset import Dataset
from bench.base import Floats, header_with_unit, prefixed
from bench.identification import (
    Band,
    Candidate,
    Identification,
    ModelFile,
    Regularization,
    calibrate_band,
    calibrate_band_in_time,
    set_up_problem,
)


@dataclass(frozen=True)
class BandedPrediction:
    """The band about the predictions of a model.

    Attributes
    ----------
    band : Band
        The model's band.
    unit : str
        Unit of the output.
    holds_for : str
        The inputs for which it holds.
    """

    band: Band
    unit: str
    holds_for: str

    @property
    def half_width(self) -> float:
        """Half-width about each prediction, output units."""
        return self.band.half_width

    def columns(self, predicted: Floats) -> list[tuple[str, Floats]]:
        """Return heads and values of the lower and the upper end of the band, shape (N,) each."""
        return [
            (header_with_unit("predicted lower", self.unit), predicted - self.half_width),
            (header_with_unit("predicted upper", self.unit), predicted + self.half_width),
        ]

    @property
    def label(self) -> str:
        """The band in a figure."""
        return f"{100 * self.band.level:g} % prediction band"

    def coverage(self, residuals: Floats) -> float:
        """Return the share of residuals, shape (N,), that lie within the band, 0 to 1."""
        return float((np.abs(residuals) <= self.half_width).mean())

    def text(self, residuals: Floats | None = None) -> str:
        """Return the band in a line, with its coverage of measured outputs if their residuals are given."""
        width = f"± {prefixed(self.half_width, self.unit)}"
        covered = "" if residuals is None else f"; covers {100 * self.coverage(residuals):.1f} % of the rows measured"
        return f"{100 * self.band.level:g} % band: {width}; holds for inputs of {self.holds_for}{covered}"

    def rows(self) -> list[tuple[str, str]]:
        """Return what the band is: name and value of each row of a table."""
        return [
            ("level", f"{100.0 * self.band.level:g} %"),
            ("half-width", prefixed(self.half_width, self.unit)),
            ("holds for inputs", self.holds_for),
        ]

    def to_json(self, residuals: Floats | None = None) -> dict[str, Any]:
        """Return the band for programs; `coverage` is None without residuals of measured outputs."""
        return {
            "level": self.band.level,
            "half_width": self.half_width,
            "coverage": None if residuals is None else self.coverage(residuals),
        }


def band_of(model: ModelFile) -> BandedPrediction | None:
    """Return the band of a model's predictions; None if its file has none."""
    if model.band is None:
        return None
    return BandedPrediction(model.band, model.response.output_unit, model.valid.text(model.response.input_unit))


def calibrate(
    found: Identification[Any], data: Dataset, skip: int, penalties: Regularization, options: Mapping[str, Any]
) -> Band:
    """Return the band of the model that was identified with the same arguments; errors as `calibrate_band`."""
    inputs, outputs, weights = data.inputs, data.outputs, data.weights
    if data.times is not None:
        return calibrate_band_in_time(found, data.times, inputs, outputs, weights=weights, skip=skip, **options)
    own = dict(options)
    initial, orientation = own.pop("initial", None), own.pop("orientation", "auto")
    settings = Candidate(found.model_name, own, orientation, initial, penalties.smoothing)
    problem = set_up_problem(settings, inputs, outputs, weights, skip)
    return calibrate_band(problem, penalties.smoothing, penalties.ridge)
