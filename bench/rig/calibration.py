"""Calibrations: what a sensor reads against a reference, as a file that a rig file names.

A calibration is accuracy: it compares with a reference that is closer to the truth than the sensor. What a sensor
reads twice at the same place is repeatability, and needs no reference. A file has both.

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

import datetime
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, Field, ValidationError, model_validator

from bench.base import CheckedTable, DataError, DeviceError, check_unit, parse_json, problems, reason, write_json_file
from bench.devices import Signal
from bench.rig.derived import Derived, DerivedSignal

Floats = NDArray[np.float64]

MOST_COEFFICIENTS = 24
_FEWEST = 3
"""Values of the reference; a line and one degree of freedom."""
_PLACES = 33
"""Places over the range at which the uncertainty is averaged."""
_FOLDS = 8
_BINS = 24
_GAIN = 0.9
"""Part of the error of the left-out readings that a further coefficient has to leave at most, to be taken."""
_SIGNIFICANT = 3.0
"""Standard deviations from which on a lateness counts."""
_MARGIN = 0.01
"""Part of the calibrated range by which a reading may be beyond it."""


class Calibration(CheckedTable):
    """What a sensor reads against a reference, and how well that is known.

    The calibrated value is `slope` times the reading plus a Chebyshev series of it, in the unit of the reference.
    """

    format: Literal["bench-calibration"] = "bench-calibration"
    version: Literal[2] = 2
    signal: str = Field(description="signal of the sensor")
    unit: str = Field(description="unit of its readings")
    serial_number: str = Field(
        description="serial number of its instrument; empty if the instrument does not tell one"
    )
    date: datetime.date = Field(description="day of the calibration")
    interval_days: int = Field(ge=1, description="days after which a new calibration is due")
    reference: str = Field(min_length=1, description="what it was compared with, and its certificate")
    reference_unit: Annotated[str, AfterValidator(check_unit)] = Field(
        description="unit of the reference, in which the calibrated value is"
    )
    reference_uncertainty: float = Field(
        gt=0.0, description="standard uncertainty of the reference, common to all its values, in its unit"
    )
    reference_degrees_of_freedom: float | None = Field(
        default=None, gt=0.0, description="degrees of freedom of that uncertainty; null for infinitely many"
    )
    reference_gain_uncertainty: float = Field(
        default=0.0,
        ge=0.0,
        description="standard uncertainty of the scale of the reference, as a share of its values",
    )
    low: float = Field(description="least reading of the sensor that was compared")
    high: float = Field(description="greatest reading of the sensor that was compared")
    slope: float = Field(default=1.0, description="part of the value that is in proportion to the reading")
    coefficients: tuple[float, ...] = Field(
        min_length=1, description="Chebyshev series over low to high of what is added to that"
    )
    covariance: tuple[tuple[float, ...], ...] = Field(description="covariance of the coefficients, reference unit²")
    degrees_of_freedom: int = Field(ge=1, description="degrees of freedom of the covariance")
    lack_of_fit: float = Field(
        default=0.0, ge=0.0, description="standard uncertainty by what the series cannot follow, reference unit"
    )
    lateness: float = Field(
        default=0.0, ge=0.0, description="time by which the sensor reads later than the reference, s"
    )
    repeatability: float = Field(
        ge=0.0, description="standard deviation of one calibrated reading about the mean of many, reference unit"
    )
    readings: int = Field(ge=1, description="number of readings that were compared")
    run: str = Field(default="", description="run in which they were taken")

    @model_validator(mode="after")
    def _is_consistent(self) -> Calibration:
        if not self.low < self.high:
            raise ValueError(f"low, high: expected low < high, got {self.low:g} and {self.high:g}")
        size, matrix = len(self.coefficients), np.array(self.covariance, dtype=np.float64, ndmin=2)
        # But for rounding.
        least = -1e-9 * np.abs(matrix).max()
        if matrix.shape != (size, size) or not np.allclose(matrix, matrix.T, atol=-least):
            raise ValueError(f"covariance: expected a symmetric matrix of {size} by {size}")
        if np.linalg.eigvalsh(matrix)[0] < least:
            raise ValueError("covariance: expected no variance below 0, of no sum of the coefficients")
        return self

    @property
    def due(self) -> datetime.date:
        """Day from which a new calibration is due."""
        return datetime.date.fromordinal(
            min(self.date.toordinal() + self.interval_days, datetime.date.max.toordinal())
        )

    @property
    def uncertainty(self) -> float:
        """Standard uncertainty of a mean of calibrated readings, its accuracy: RMS over the range, reference unit."""
        places = np.linspace(self.low, self.high, _PLACES)
        gain = self.reference_gain_uncertainty * self.value(places)
        common = self.reference_uncertainty**2 + self.lack_of_fit**2
        return math.sqrt(common + float(np.mean(self.coefficient_uncertainty(places) ** 2 + gain**2)))

    def value(self, readings: ArrayLike) -> Floats:
        """Return the calibrated values of readings, in the unit of the reference and of their shape."""
        x = np.asarray(readings, dtype=np.float64)
        return self.slope * x + np.asarray(chebyshev.chebval(self._scaled(x), self.coefficients))

    def sensitivity(self, readings: ArrayLike) -> Floats:
        """Return by how much the calibrated value changes for a change of the reading, of their shape."""
        steepness = chebyshev.chebder(self.coefficients) * 2.0 / (self.high - self.low)
        return self.slope + np.asarray(chebyshev.chebval(self._scaled(np.asarray(readings)), steepness))

    def coefficient_uncertainty(self, readings: ArrayLike) -> Floats:
        """Return the standard uncertainties of calibrated values by those of the coefficients."""
        scaled = self._scaled(np.asarray(readings, dtype=np.float64))
        columns = chebyshev.chebvander(scaled, len(self.coefficients) - 1)
        variances = np.einsum("...i,ij,...j->...", columns, np.array(self.covariance), columns)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))

    def save(self, path: Path) -> None:
        """Write the file; raise DataError if that fails."""
        write_json_file(path, self.model_dump(mode="json"))

    def _scaled(self, readings: Floats) -> Floats:
        scaled = (2.0 * readings - self.low - self.high) / (self.high - self.low)
        return np.asarray(np.clip(scaled, -1.0, 1.0), dtype=np.float64)


def read_calibration(path: Path) -> Calibration:
    """Read a calibration file; raise DataError, which names the file, if it is none."""
    try:
        content = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"calibration file {path} cannot be read: {reason(error)}") from None
    try:
        return Calibration.model_validate(content)
    except ValidationError as error:
        raise DataError(
            "\n".join(f"calibration file {path}: {line}" for line in problems(error, Calibration))
        ) from None


def calibrate(
    readings: ArrayLike,
    standard: ArrayLike,
    *,
    times: ArrayLike | None = None,
    **about: Any,  # noqa: ANN401 - fields of a `Calibration`
) -> Calibration:
    """Find a calibration from readings of a sensor and of a reference at the same instants or places.

    Neighbouring readings of one value of the reference count as one place, by their mean. The number of coefficients
    is that beyond which places that were left out are not met better: one eighth after another, or one value after
    another where few were set up. With times, how late the sensor is against the reference is found too, from how
    fast the reference moves.

    Parameters
    ----------
    readings, standard : array_like, shape (N,)
        What sensor and reference read; at least 3 different values of the reference.
    times : array_like, shape (N,), optional
        Instants, s, where the readings are samples of one course.
    **about
        Fields of the calibration that are not found from the readings: `signal`, `unit`, `serial_number`, `date`,
        `interval_days`, `reference`, `reference_unit`, `reference_uncertainty` and what else is known.

    Raises
    ------
    DataError
        If there are too few readings, they do not differ, or a field is wrong.
    """
    x, y = np.asarray(readings, dtype=np.float64), np.asarray(standard, dtype=np.float64)
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    count, single = x.size, None
    if times is None and count:
        x, y, single = _places(x, y)
    distinct, of_value = np.unique(y, return_inverse=True)
    if distinct.size < _FEWEST or not x.max() > x.min():
        raise DataError(
            f"{about['signal']}: a calibration needs readings at {_FEWEST} values of the reference at least, which "
            f"differ; got {distinct.size}"
        )
    low, high = float(x.min()), float(x.max())
    scaled = (2.0 * x - low - high) / (high - low)
    speed: Floats | None = None
    if times is not None:
        speed = np.gradient(_smooth(y), np.asarray(times, dtype=np.float64)[good])
    slope = 1.0 if about["unit"] == about["reference_unit"] else float(np.polyfit(x, y, 1)[0])
    lacking = y - slope * x
    # Two degrees of freedom are left; a sweep has as many values as readings.
    most = max(1, min(MOST_COEFFICIENTS, distinct.size - 1, x.size - 2))
    columns: Floats = np.asarray(chebyshev.chebvander(scaled, most - 1), dtype=np.float64)
    # Short blocks in turn, so that what is left out lies between what is not.
    is_sweep = x.size >= _FOLDS**2 and distinct.size >= x.size // 2
    blocks = np.arange(x.size) * _FOLDS**2 // x.size % _FOLDS if is_sweep else of_value.reshape(-1)
    left_out = {n: _left_out(_design(columns, n, speed), lacking, blocks) for n in range(1, most + 1)}
    # Of few values the outermost do not count: the others do not tell them.
    inner = np.ones(x.size, dtype=np.bool_) if is_sweep else (blocks > 0) & (blocks < distinct.size - 1)
    errors = {n: _binned(scaled[inner], each[inner]) for n, each in left_out.items()}
    chosen = 1
    for n in range(2, most + 1):
        if errors[n] < _GAIN * errors[chosen]:
            chosen = n
    design = _design(columns, chosen, speed)
    found = np.linalg.lstsq(design, lacking, rcond=None)[0]
    residuals = lacking - design @ found
    freedom = max(1, x.size - found.size)
    variance = float(np.sum(residuals**2)) / freedom
    if not is_sweep:
        # The number of coefficients was chosen on the same few places, so that the residuals are too small; the
        # errors of what was left out are not (Allen 1974, Technometrics 16, 125: PRESS).
        variance = max(variance, float(np.mean(left_out[chosen][inner] ** 2)))
    covariance = variance * np.linalg.pinv(design.T @ design)
    lateness = 0.0
    if speed is not None:
        doubt = math.sqrt(float(covariance[-1, -1]))
        lateness = float(found[-1]) if found[-1] > _SIGNIFICANT * doubt else 0.0
    content = {
        **about,
        "low": low,
        "high": high,
        "slope": slope,
        "coefficients": found[:chosen].tolist(),
        "covariance": covariance[:chosen, :chosen].tolist(),
        "degrees_of_freedom": freedom,
        # The residuals of few places have it in them.
        "lack_of_fit": errors[chosen] if is_sweep else 0.0,
        "lateness": lateness,
        "repeatability": math.sqrt(variance) if single is None else abs(slope) * single,
        "readings": count,
    }
    try:
        return Calibration.model_validate(content)
    except ValidationError as error:
        raise DataError(
            "\n".join(f"calibration of {about['signal']}: {e}" for e in problems(error, Calibration))
        ) from None


def _places(x: Floats, y: Floats) -> tuple[Floats, Floats, float | None]:
    """Return the means of neighbouring readings of one value, the values, and the deviation of one reading."""
    starts = np.flatnonzero(np.concatenate([[True], np.diff(y) != 0.0]))
    counts = np.diff(np.append(starts, y.size))
    means = np.add.reduceat(x, starts) / counts
    freedom = y.size - starts.size
    if not freedom:
        return means, y[starts], None
    return means, y[starts], math.sqrt(float(np.sum((x - np.repeat(means, counts)) ** 2)) / freedom)


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
    """A signal by its calibration, in the unit of the reference.

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
        low, high, slope = record.low, record.high, record.slope
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
                    f"{source} reads {value:.6g} {record.unit}, beyond its calibration of {record.date}, "
                    f"{low:.6g} to {high:.6g} {record.unit}; calibrate it over the range that is used",
                )
            scaled = (inside - middle) / half
            correction = 0.0
            for power in powers:
                correction = correction * scaled + power
            return slope * value + correction

        description = self.description or name.replace("_", " ")
        signal = Signal(name, record.reference_unit, description, self.precision, record.uncertainty)
        return Derived(signal, self.sources, compute)
