"""Calibrations: what a sensor reads against a reference, as a file that a rig file names.

A calibration is accuracy: it compares with a reference that is closer to the truth than the sensor. What a sensor
reads twice at the same place is repeatability, and needs no reference. A file has both, each under its name.

A file is a JSON object with the fields of `Calibration` besides `format` and `version`. A rig file names it in a
derived signal, whose value is the calibrated one::

    [derived.displacement]
    kind = "calibrated"
    source = "probe_position"
    calibration = "probe.json"   # beside the rig file

Sources: JCGM 100:2008 (GUM), 4 and 5, for uncertainties; JCGM 200:2012 (VIM), 2.13 accuracy, 2.21 repeatability, 2.39
calibration.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, ValidationError, model_validator

from bench.base import CheckedTable, DataError, DeviceError, parse_json, problems, write_json_file
from bench.devices import Signal
from bench.rig.derived import Derived, DerivedSignal

Floats = NDArray[np.float64]

MOST_COEFFICIENTS = 24
_FOLDS = 8
_BINS = 24
_GAIN = 0.9
"""Part of the error of the left-out readings that a further coefficient has to leave at most, to be taken."""
_SIGNIFICANT = 3.0
"""Standard deviations from which on a lateness counts."""
_MARGIN = 0.01
"""Part of the calibrated range by which a reading may be beyond it."""


class Calibration(CheckedTable):
    """What a sensor reads against a reference: `correction` is added to what it reads."""

    format: Literal["bench-calibration"] = "bench-calibration"
    version: Literal[1] = 1
    signal: str = Field(description="signal of the sensor")
    unit: str = Field(description="its unit, in which everything here is")
    reference: str = Field(description="what it was compared with")
    calibrated: date = Field(description="day of the calibration")
    low: float = Field(description="least reading of the sensor that was compared")
    high: float = Field(description="greatest reading of the sensor that was compared")
    coefficients: tuple[float, ...] = Field(
        min_length=1, description="Chebyshev series of the correction over low to high"
    )
    lateness: float = Field(
        default=0.0, ge=0.0, description="time by which the sensor reads later than the reference, s"
    )
    uncertainty: float = Field(
        ge=0.0, description="standard uncertainty of a mean of corrected readings: its accuracy"
    )
    repeatability: float = Field(ge=0.0, description="standard deviation of one reading about the mean of many")
    readings: int = Field(ge=1, description="number of readings that were compared")
    run: str = Field(default="", description="run in which they were taken")

    @model_validator(mode="after")
    def _has_a_range(self) -> Calibration:
        if not self.low < self.high:
            raise ValueError(f"low, high: expected low < high, got {self.low:g} and {self.high:g}")
        return self

    def correction(self, readings: ArrayLike) -> Floats:
        """Return what is to be added to readings, in the unit of the calibration."""
        scaled = (2.0 * np.asarray(readings, dtype=np.float64) - self.low - self.high) / (self.high - self.low)
        return np.asarray(chebyshev.chebval(np.clip(scaled, -1.0, 1.0), self.coefficients))

    def save(self, path: Path) -> None:
        """Write the file; raise DataError if that fails."""
        write_json_file(path, self.model_dump(mode="json"))


def read_calibration(path: Path) -> Calibration:
    """Read a calibration file; raise DataError, which names the file, if it is none."""
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"calibration file {path} cannot be read: {error}") from None
    try:
        return Calibration.model_validate(content)
    except ValidationError as error:
        raise DataError(
            "\n".join(f"calibration file {path}: {line}" for line in problems(error, Calibration))
        ) from None


def calibrate(
    readings: ArrayLike,
    reference: ArrayLike,
    *,
    signal: str,
    unit: str,
    named: str,
    day: date,
    times: ArrayLike | None = None,
    reference_uncertainty: float = 0.0,
    run: str = "",
) -> Calibration:
    """Find a calibration from readings of a sensor and of a reference at the same instants or places.

    The number of coefficients is that beyond which readings that were left out are not met better: one eighth after
    another, or one value after another where few were set up. With times, how late the sensor is against the
    reference is found too, from how fast the reference moves.

    Parameters
    ----------
    readings, reference : array_like, shape (N,)
        What both read, in the same unit; N of at least 3.
    signal, unit, named, day, run
        For the file: sensor, unit, what the reference is, day, and run.
    times : array_like, shape (N,), optional
        Instants, s, where the readings are samples of one course.
    reference_uncertainty : float
        Standard uncertainty of the reference.

    Raises
    ------
    DataError
        If there are too few readings, or they do not differ.
    """
    x, y = np.asarray(readings, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    if x.size < 3 or not x.max() > x.min():
        raise DataError(f"{signal}: a calibration needs at least 3 readings that differ, got {x.size}")
    low, high = float(x.min()), float(x.max())
    scaled = (2.0 * x - low - high) / (high - low)
    speed: Floats | None = None
    if times is not None:
        speed = np.gradient(_smooth(y), np.asarray(times, dtype=np.float64)[good])
    # As many places as values that were set up; a sweep has as many as readings.
    distinct = np.unique(y, return_inverse=True)
    most = min(MOST_COEFFICIENTS, max(1, x.size // 2), max(1, distinct[0].size - 1))
    columns: Floats = np.asarray(chebyshev.chebvander(scaled, most - 1), dtype=np.float64)
    lacking = y - x
    # Short blocks in turn, so that what is left out lies between what is not.
    if distinct[0].size < x.size // 2 or x.size < _FOLDS**2:
        blocks = distinct[1].reshape(-1)
    else:
        blocks = np.arange(x.size) * _FOLDS**2 // x.size % _FOLDS
    left_out = {count: _left_out(_design(columns, count, speed), lacking, blocks) for count in range(1, most + 1)}
    errors = {count: _binned(scaled, each) for count, each in left_out.items()}
    chosen = 1
    for count in range(2, most + 1):
        if errors[count] < _GAIN * errors[chosen]:
            chosen = count
    design = _design(columns, chosen, speed)
    found = np.linalg.lstsq(design, lacking, rcond=None)[0]
    residuals = lacking - design @ found
    spread = math.sqrt(float(np.mean(residuals**2)) * x.size / max(1, x.size - found.size))
    lateness = 0.0
    if speed is not None:
        doubt = spread * math.sqrt(float(np.linalg.pinv(design.T @ design)[-1, -1]))
        lateness = float(found[-1]) if found[-1] > _SIGNIFICANT * doubt else 0.0
    return Calibration(
        signal=signal,
        unit=unit,
        reference=named,
        calibrated=day,
        low=low,
        high=high,
        coefficients=tuple(found[:chosen].tolist()),
        lateness=lateness,
        uncertainty=math.hypot(errors[chosen], reference_uncertainty),
        repeatability=spread,
        readings=x.size,
        run=run,
    )


def _smooth(values: Floats) -> Floats:
    """Return a course without the noise of single readings, for its speed."""
    width = min(25, 2 * ((values.size - 1) // 4) + 1)
    padded = np.pad(values, width // 2, mode="reflect", reflect_type="odd")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")


def _design(columns: Floats, count: int, speed: Floats | None) -> Floats:
    return columns[:, :count] if speed is None else np.column_stack([columns[:, :count], speed])


def _left_out(design: Floats, lacking: Floats, blocks: NDArray[np.int_]) -> Floats:
    """Return the errors at readings whose block did not take part in the fit."""
    errors = np.empty_like(lacking)
    for block in np.unique(blocks):
        out = blocks == block
        found = np.linalg.lstsq(design[~out], lacking[~out], rcond=None)[0]
        errors[out] = lacking[out] - design[out] @ found
    return errors


def _binned(scaled: Floats, errors: Floats) -> float:
    """Return the RMS of the mean errors in parts of the range: without the noise of single readings."""
    places = np.clip(((scaled + 1.0) * 0.5 * _BINS).astype(np.intp), 0, _BINS - 1)
    counts = np.bincount(places, minlength=_BINS)
    means = np.bincount(places, errors, minlength=_BINS)[counts > 0] / counts[counts > 0]
    return math.sqrt(float(np.mean(means**2)))


class Calibrated(DerivedSignal):
    """A signal corrected by its calibration.

    A reading beyond the calibrated range has no value, but for a hundredth of the range, over which the correction
    at its end holds.
    """

    source: str = Field(description="signal of the sensor")
    calibration: Calibration = Field(description="file of its calibration, beside the rig file")
    description: str = Field(default="", description="a few words for axes and column headers")
    precision: int = Field(default=3, ge=0, le=12, description="digits after the point that are worth showing")

    @model_validator(mode="after")
    def _is_of_the_source(self) -> Calibrated:
        if self.calibration.signal != self.source:
            raise ValueError(f"calibration: is of {self.calibration.signal}; expected source = {self.source!r}")
        return self

    @property
    def sources(self) -> tuple[str, ...]:
        """The signal of the sensor."""
        return (self.source,)

    def bind(self, name: str, units: Mapping[str, str]) -> Derived:
        """Return the signal; see `DerivedSignal.bind`."""
        record, source = self.calibration, self.source
        if units[source] != record.unit:
            raise ValueError(f"source = {source!r}: is in {units[source]}; the calibration is in {record.unit}")
        low, high = record.low, record.high
        margin = _MARGIN * (high - low)
        # Powers of the scaled reading, highest first: one reading at a time is what a fast loop asks for.
        powers = chebyshev.cheb2poly(record.coefficients)[::-1].tolist()
        middle, half = 0.5 * (low + high), 0.5 * (high - low)

        def compute(values: Mapping[str, float]) -> float:
            value = values[source]
            inside = low if value < low else high if value > high else value
            if abs(value - inside) > margin:
                raise DeviceError(
                    name,
                    f"{source} reads {value:.6g} {record.unit}, beyond its calibration of {record.calibrated}, "
                    f"{low:.6g} to {high:.6g} {record.unit}; calibrate it over the range that is used",
                )
            scaled = (inside - middle) / half
            correction = 0.0
            for power in powers:
                correction = correction * scaled + power
            return value + correction

        description = self.description or name.replace("_", " ")
        return Derived(
            Signal(name, record.unit, description, self.precision, record.uncertainty), self.sources, compute
        )
