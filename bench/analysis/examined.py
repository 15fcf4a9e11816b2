"""A model's predictions for one file of measurements, with the session recalibrated and the band about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis.band_columns import BandedPrediction, predict_band
from bench.analysis.predictions import check_finite
from bench.analysis.session_recalibration import Session
from bench.analysis.tables.times import bind_times
from bench.base import ConfigurationError
from bench.identification import Errors, ModelFile, Recalibration, measure_errors
from bench.models import TimedSequence

Floats = npt.NDArray[np.float64]

# Fewer rows hardly have first ones; these are a tenth of all, and err so many times more than the others.
_FEWEST, _FIRST_PART, _MUCH = 100, 10, 3.0


@dataclass(frozen=True)
class Examined:
    """What a model gives for a sequence of inputs.

    Attributes
    ----------
    predicted : ndarray, shape (N,)
        Outputs of the model, after recalibration if one was asked for.
    measured : ndarray, shape (N,), or None
        The measured outputs, where there are some.
    recalibration : Recalibration or None
        What moved in the session, if that was asked for.
    band : BandedPrediction or None
        The band about the predictions, if the model's file has one.
    units : (str, str)
        Units of input and output.
    first : int
        First row that counts in errors: those before drive the memory or tell the recalibration.
    """

    predicted: Floats
    measured: Floats | None
    recalibration: Recalibration | None
    band: BandedPrediction | None
    units: tuple[str, str]
    first: int

    @property
    def residuals(self) -> Floats | None:
        """Measured minus predicted outputs of the rows that count; None without measurements."""
        return None if self.measured is None else (self.measured - self.predicted)[self.first :]

    def errors(self) -> Errors:
        """Return the errors over the rows that count. There must be measurements."""
        assert self.measured is not None
        return measure_errors(self.measured[self.first :], self.predicted[self.first :])

    def warnings(self) -> list[str]:
        """Return a sentence if the largest errors stand in the first rows, which follow what nobody recorded."""
        errors = np.abs(np.empty(0) if self.residuals is None else self.residuals)
        first = errors.size // _FIRST_PART
        if errors.size < _FEWEST or not errors[:first].max() > _MUCH * (largest := float(errors[first:].max())):
            return []
        last = self.first + int(np.flatnonzero(errors[:first] > largest)[-1]) + 1
        unit = self.units[1]
        return [
            f"the largest errors stand in the first {last} rows ({errors.max():.4g} {unit}".rstrip()
            + f"; {largest:.4g} {unit}".rstrip()
            + f" in the others), where what came before the file still matters: --skip {last} leaves them out"
        ]

    def to_json(self) -> dict[str, Any]:
        """Return `recalibration` and `band` for programs, those that there are."""
        found: dict[str, Any] = {}
        if self.recalibration is not None:
            found["recalibration"] = {**self.recalibration.to_json(), "errors_from_row": self.first + 1}
        if self.band is not None:
            found["band"] = self.band.to_json(self.residuals)
        return found


def examine(
    model: ModelFile,
    inputs: Floats,
    measured: Floats | None = None,
    *,
    state: Any = None,  # noqa: ANN401 - each operator has its own
    session: Session | None = None,
    skip: int = 0,
    times: Floats | None = None,
) -> Examined:
    """Return what a model gives for a sequence of inputs, shape (N,).

    Parameters
    ----------
    model : ModelFile
        The model.
    inputs : ndarray, shape (N,)
        In the unit of the model, finite.
    measured : ndarray, shape (N,), or None
        Measured outputs.
    state : object
        State before the first row; None is the initial one.
    session : Session, optional
        What is estimated of the session from measured outputs.
    skip : int
        First rows that drive the memory but do not count.
    times : ndarray, shape (N,), or None
        s, for a model with time.

    Raises
    ------
    ConfigurationError
        If the session cannot be estimated, or a model with time has no times.
    DataError
        If an output is not finite.
    """
    bound = bind_times(model, times)
    times = times if isinstance(bound, TimedSequence) else None
    units = model.response.input_unit, model.response.output_unit
    if session is None:
        with np.errstate(over="ignore", invalid="ignore"):
            predicted = np.asarray(bound.evaluate(inputs, state))
        check_finite(model.name, "output", predicted, units[1], inputs, "input", units[0])
        return Examined(predicted, measured, None, predict_band(model, inputs, state, times), units, skip)
    if measured is None:
        raise ConfigurationError("--recalibrate needs measured outputs: name their column with --output")
    found = session.estimate(bound, inputs, measured, skip=skip, state=state)
    with np.errstate(over="ignore", invalid="ignore"):
        predicted = found.predict(bound, inputs, state)
    check_finite(model.name, "output", predicted, units[1], inputs, "input", units[0])
    return Examined(
        predicted,
        measured,
        found,
        predict_band(model, inputs + found.values.get("input-offset", 0.0), state, times),
        units,
        session.first_unused(inputs.size, skip),
    )
