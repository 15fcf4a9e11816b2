"""Uncertainties of signals: what a rig file states of them, and the budget of a reading.

A rig file states them by tables `[uncertainty.SIGNAL.COMPONENT]`, each with its source::

    [uncertainty.probe_position.gain]
    acts = "gain"                       # on the value: a share of it, the same for all readings
    half_width = 0.5
    unit = "%"
    basis = "estimate"
    source = "lever of 14 mm, measured with a calliper to 0.07 mm"

    [uncertainty.bending.length]
    acts = "length"                     # a key, or a constant, of the derived signal
    half_width = 0.3e-6
    unit = "m"
    basis = "certificate"
    source = "stage micrometer of the microscope"

What is common to several readings is one uncertain number in all of them, so that errors and differences of readings
have the right correlations. Derived signals are computed with uncertain numbers.

Sources: JCGM 100:2008 (GUM); JCGM 101:2008 for the coverage of distributions that are not normal. The numbers are
those of the GUM Tree Calculator (B. D. Hall, MSL New Zealand).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from bench.base import (
    CheckedTable,
    ConfigurationError,
    DeferredModule,
    DeviceError,
    difference_unit,
    fitting_prefix,
    read_quantity,
)
from bench.rig.calibration import Calibrated, Calibration
from bench.rig.derived import DerivedSignal
from bench.rig.layout import Range

GTC: Any = DeferredModule("GTC")

Floats = NDArray[np.float64]
Uncertain = Any
"""An uncertain number of the library's, which is not typed."""
Distribution = Literal["normal", "rectangular", "triangular", "U"]

ROOM = "room"
"""A component that is no error of a reading: the quantity follows the room, and so do identified parameters."""
_REMEDIES = {
    **dict.fromkeys(("gain", "offset", "nonlinearity"), "calibrate the sensor"),
    "drift": "calibrate more often, or correct for it",
    "noise": "average more readings",
    "resolution": "take a sensor with finer steps",
    "calibration": "take more readings in the calibration",
    "reference": "take a better reference",
    "fit": "take more readings",
    ROOM: "keep the room steadier, or measure longer",
}
"""What reduces a component, by how it acts."""
LEVEL = 0.95
"""Coverage of an expanded uncertainty. Source: GUM 6.3.3, the level of conformity statements."""
_DIVISORS = {"rectangular": math.sqrt(3.0), "triangular": math.sqrt(6.0), "U": math.sqrt(2.0)}
"""Half-width over standard uncertainty. Source: GUM 4.3.7, 4.3.9 and H.1.3.4."""
_WAVES = 1.5
"""Waves of a nonlinearity over its range: readings farther apart than a third of it have errors of their own.
Source: a choice; the best line takes the first half wave, and data sheets show S-shaped curves and waves of two."""
_PLACES = 1000
"""Places at which the largest component that is not normal is taken. Derivation: beside 40 000, the factors of
99 mixtures of U, rectangle and triangle with a normal part of 0.1 to 100 % differed by 7e-5 at most."""
_NORMAL = 1e6
"""Degrees of freedom from which on Student's t counts as normal. Derivation: the quantiles differ by 1e-6 of them."""

_FIRST = 1e-9
"""Second place of a search for a reading that begins at 0. Derivation: small beside readings in any SI unit, and a
million times the rounding of one.
"""

SHARED = ("gain", "offset", "nonlinearity", "drift")
"""How a component acts that is common to all readings."""
OWN = ("noise", "resolution")
"""How one acts that each reading has for itself."""
_CALIBRATED = ("gain", "offset", "nonlinearity")
"""What a calibration takes away."""


class Component(CheckedTable):
    """A component of the uncertainty of a signal: the table `[uncertainty.SIGNAL.COMPONENT]`."""

    acts: str = Field(
        min_length=1,
        description=f"{', '.join((*SHARED, *OWN))}, {ROOM}, or a key or constant of a derived signal",
    )
    standard: float | None = Field(default=None, gt=0, description="standard uncertainty, of a normal distribution")
    half_width: float | None = Field(default=None, gt=0, description="half-width of any other distribution")
    unit: str = Field(min_length=1, description="its unit; % for a share, as of a gain")
    distribution: Distribution = Field(
        default="rectangular", description="normal where standard is given, otherwise rectangular, triangular or U"
    )
    basis: Literal["data sheet", "certificate", "estimate", "measured"] = Field(description="what it rests on")
    source: str = Field(min_length=1, description="document and place, or how it was found")
    freedom: float | None = Field(default=None, gt=0, description="degrees of freedom; infinite if not given")
    range: Range | None = Field(default=None, description="readings over which a nonlinearity is stated")
    time: float | None = Field(
        default=None,
        gt=0,
        description="time after which the autocorrelation of a room or drift is 1/e, s; constant if not given",
    )

    @model_validator(mode="before")
    @classmethod
    def _normal_if_standard(cls, table: Any) -> Any:  # noqa: ANN401 - any TOML
        if isinstance(table, dict) and "standard" in table:
            return {"distribution": "normal", **table}
        return table

    @model_validator(mode="after")
    def _one_width(self) -> Self:
        if (self.standard is None) == (self.half_width is None):
            raise ValueError("expected either standard or half_width")
        if (self.standard is None) != (self.distribution != "normal"):
            raise ValueError(
                f"distribution = {self.distribution!r}: expected normal with standard, and rectangular, triangular "
                "or U with half_width"
            )
        if (self.range is None) == (self.acts == "nonlinearity"):
            raise ValueError("range: expected for a nonlinearity, and for nothing else")
        if self.time is not None and self.acts not in (ROOM, "drift"):
            raise ValueError("time: expected for a room or a drift only")
        return self

    @property
    def uncertainty(self) -> float:
        """Standard uncertainty, in `unit`."""
        if self.standard is not None:
            return self.standard
        assert self.half_width is not None
        return self.half_width / _DIVISORS[self.distribution]


Uncertainties = Mapping[str, Mapping[str, Component]]
"""Components by signal and name."""


@dataclass(frozen=True)
class BudgetRow:
    """One component of a budget.

    Attributes
    ----------
    signal, component, acts : str
        Which signal it belongs to, its name, and how it acts.
    type : {"A", "B"}
        Whether it was found by statistics.
    distribution : str
        normal, rectangular, triangular or U.
    standard : float
        Standard uncertainty, in `unit`.
    unit : str
        Its unit.
    freedom : float
        Degrees of freedom; may be infinite.
    contribution : float
        What it contributes to the standard uncertainty of the signal, in the unit of the budget.
    source : str
        What it rests on.
    time : float or None
        Time after which the autocorrelation of a room or a drift is 1/e, s; None of what does not change.
    """

    signal: str
    component: str
    acts: str
    type: str
    distribution: Distribution
    standard: float
    unit: str
    freedom: float
    contribution: float
    source: str
    time: float | None = None

    @property
    def sensitivity(self) -> float:
        """Magnitude of the sensitivity coefficient: unit of the budget over the unit of the component."""
        return self.contribution / self.standard

    @property
    def label(self) -> str:
        """The component with its signal."""
        return f"{self.component} of {self.signal}"


@dataclass(frozen=True)
class Budget:
    """The uncertainty budget of one value.

    Attributes
    ----------
    signal, unit : str
        What it is of.
    value : float
        At which value.
    rows : tuple of BudgetRow
        Its components, the largest first.
    freedom : float
        Effective degrees of freedom (Welch-Satterthwaite); may be infinite.
    not_stated : tuple of str
        Signals behind it of which the rig file states nothing.
    """

    signal: str
    unit: str
    value: float
    rows: tuple[BudgetRow, ...]
    freedom: float
    not_stated: tuple[str, ...] = ()

    @property
    def stated(self) -> bool:
        """Whether the rig file states something of all signals behind it."""
        return bool(self.rows) and not self.not_stated

    @property
    def standard(self) -> float:
        """Combined standard uncertainty, in the unit of the signal."""
        return math.hypot(*(row.contribution for row in self.rows))

    @cached_property
    def factor(self) -> float:
        """Coverage factor for 95 %."""
        return coverage_factor(self.rows)

    @property
    def expanded(self) -> float:
        """Expanded uncertainty for 95 %, in the unit of the signal."""
        return self.factor * self.standard

    def share(self, row: BudgetRow) -> float:
        """Return the part of the variance that a component has, 0 to 1."""
        return (row.contribution / self.standard) ** 2

    def advice(self) -> str:
        """Return what would reduce the uncertainty most, in one sentence."""
        if not self.stated:
            missing = " and ".join(self.not_stated) or self.signal
            return f"The uncertainty of {missing} is not stated: add [uncertainty.SIGNAL.COMPONENT] to the rig file."
        first, *others = self.rows
        left = coverage_factor(others) * math.hypot(*(row.contribution for row in others)) if others else 0.0
        how = _REMEDIES.get(first.acts, "measure it better")
        return (
            f"Most would be gained at {first.label} ({100.0 * self.share(first):.0f} % of the variance; {how}): "
            f"without it U would be {left:.2g} instead of {self.expanded:.2g} {self.unit}."
        )

    def in_fitting_unit(self) -> Budget:
        """Return the same budget in the unit that fits its value, such as mm in place of m, for people to read."""
        factor, unit = fitting_prefix(self.unit, self.value, self.expanded, least=0.1)
        rows = (replace(row, contribution=factor * row.contribution) for row in self.rows)
        alike = (
            replace(row, standard=factor * row.standard, unit=unit) if row.unit == self.unit else row for row in rows
        )
        return replace(self, value=factor * self.value, unit=unit, rows=tuple(alike))

    def to_json(self) -> dict[str, Any]:
        """Return the budget for programs; numbers that are infinite become null."""
        return {
            "value": self.value,
            "unit": self.unit,
            "stated": self.stated,
            "not_stated": list(self.not_stated),
            "standard": self.standard,
            "degrees_of_freedom": self.freedom,
            "coverage_factor": self.factor,
            "expanded": self.expanded,
            "level": LEVEL,
            "components": [
                {**vars(row), "sensitivity": row.sensitivity, "share": self.share(row)} for row in self.rows
            ],
            "advice": self.advice(),
        }


def coverage_factor(rows: Sequence[BudgetRow]) -> float:
    """Return the factor by which the standard uncertainty of a sum of components is expanded to 95 %.

    The largest component that is not normal keeps its distribution. All others together are Student's t of their
    effective degrees of freedom: the factor is the usual one where no component but normal ones counts, and less
    than 2 where a rectangular one dominates.

    Sources: GUM G.1.4, G.3, G.4.1 (Welch-Satterthwaite); JCGM 101:2008, 5.
    """
    from scipy.optimize import brentq
    from scipy.special import stdtr, stdtrit

    total = math.hypot(*(row.contribution for row in rows))
    if not total:
        return 2.0
    shaped = [row for row in rows if row.distribution != "normal"]
    largest = max(shaped, key=lambda row: row.contribution, default=None)
    others = [row for row in rows if row is not largest]
    spread = math.hypot(*(row.contribution for row in others))
    freedom = effective_freedom(others)
    freedom = freedom if freedom < _NORMAL else math.inf
    if largest is None:
        return float(stdtrit(freedom, 0.5 + 0.5 * LEVEL))
    if spread < 1e-6 * total:
        return float(_quantiles(largest.distribution, np.array(0.5 + 0.5 * LEVEL)))
    places = largest.contribution * _quantiles(largest.distribution, (np.arange(_PLACES) + 0.5) / _PLACES)

    def missing(factor: float) -> float:
        end = factor * total
        # Both distributions are symmetric.
        return 2.0 * float(np.mean(stdtr(freedom, (end - places) / spread))) - 1.0 - LEVEL

    return float(brentq(missing, 1.0, 20.0, xtol=1e-6))


def effective_freedom(rows: Sequence[BudgetRow]) -> float:
    """Return the effective degrees of freedom of a sum of components; may be infinite."""
    numbers = [GTC.ureal(0.0, row.contribution, row.freedom) for row in rows if row.contribution]
    return float(sum(numbers[1:], numbers[0]).df) if numbers else math.inf


def _quantiles(distribution: Distribution, levels: Floats) -> Floats:
    """Return the quantiles at levels of a distribution whose standard deviation is 1."""
    if distribution == "rectangular":
        unit = 2.0 * levels - 1.0
    elif distribution == "triangular":
        unit = np.where(levels < 0.5, np.sqrt(2.0 * levels) - 1.0, 1.0 - np.sqrt(2.0 * (1.0 - levels)))
    else:
        unit = np.sin(np.pi * (levels - 0.5))
    return np.asarray(unit * _DIVISORS[distribution])


@dataclass(frozen=True)
class Part:
    """An elementary uncertain number with the row of a budget that it belongs to, whose contribution is open."""

    row: BudgetRow
    number: Uncertain
    angle: float | None = None
    """Of a wave of one unknown phase: 0 for its sine, π/2 for its cosine."""


@dataclass(frozen=True)
class UncertainReading:
    """A reading as an uncertain number, with all that may have an influence on it."""

    signal: str
    unit: str
    number: Uncertain
    parts: tuple[Part, ...]
    not_stated: tuple[str, ...]

    @property
    def standard(self) -> float:
        """Combined standard uncertainty."""
        return float(self.number.u)

    def contributions(self, *, shared: bool = False) -> list[tuple[Part, float]]:
        """Return the signed contributions of the parts, or of those that readings share; unit of the signal."""
        parts = [part for part in self.parts if not (shared and part.row.acts in OWN)]
        return [(part, float(GTC.rp.u_component(self.number, part.number))) for part in parts]

    def repeated(self, spread: float, freedom: float, how: str) -> UncertainReading:
        """Return the mean of several readings in the place of one that has no noise.

        Its resolution remains: readings of one quantity are rounded in the same way (GUM F.2.2.1).

        Parameters
        ----------
        spread : float
            Standard deviation of the mean, in the unit of the signal.
        freedom : float
            Degrees of freedom of that.
        how : str
            How it was found.
        """
        if not spread:
            return self
        row = BudgetRow(
            self.signal, "repeatability", "noise", "A", "normal", spread, self.unit, freedom, 0.0, f"measured: {how}"
        )
        part = Part(row, GTC.ureal(0.0, spread, freedom))
        return replace(self, number=self.number + part.number, parts=(*self.parts, part))

    def budget(self) -> Budget:
        """Return the budget of it."""
        first: dict[tuple[str, str], BudgetRow] = {}
        squares: dict[tuple[str, str], float] = {}
        for part, contribution in self.contributions():
            key = part.row.signal, part.row.component
            first.setdefault(key, part.row)
            squares[key] = squares.get(key, 0.0) + contribution**2
        found = [replace(first[key], contribution=math.sqrt(each)) for key, each in squares.items() if each > 0.0]
        rows = tuple(sorted(found, key=lambda row: -row.contribution))
        value = float(self.number.x)
        return Budget(self.signal, self.unit, value, rows, effective_freedom(rows), self.not_stated)


class UncertainSignals:
    """Signals of a rig as uncertain numbers; what is common to readings is one number in all of them.

    Parameters
    ----------
    stated : mapping
        Components by signal and name.
    derived : mapping of str to DerivedSignal
        The derived signals of the rig.
    units : mapping of str to str
        Unit of each signal.
    path : str
        Of the rig file, for messages.

    Raises
    ------
    ConfigurationError
        If a component is of a signal that there is not, in a unit that does not match, or acts on nothing; names it.
    """

    def __init__(
        self, stated: Uncertainties, derived: Mapping[str, DerivedSignal], units: Mapping[str, str], path: str
    ) -> None:
        self._stated, self._derived, self._units = stated, derived, units
        self._shared: dict[tuple[str, str], list[Part]] = {}
        self._sizes: dict[tuple[str, str], float] = {}
        problems = []
        for signal, components in stated.items():
            for name, component in components.items():
                try:
                    self._sizes[signal, name] = self._size(signal, component)
                except ValueError as error:
                    problems.append(f"{path}: uncertainty.{signal}.{name}: {error}")
        if problems:
            raise ConfigurationError("\n".join(problems))

    def _size(self, signal: str, component: Component) -> float:
        """Return the standard uncertainty in the unit in which it acts; raise ValueError if there is none."""
        if signal not in self._units:
            raise ValueError(f"there is no signal {signal!r}; there are: {', '.join(self._units)}")
        acts, kind, unit = component.acts, self._derived.get(signal), component.unit
        scale = 1.0
        if acts == "gain":
            wanted = "%"
            scale = 0.01
        elif acts in (*SHARED, *OWN, ROOM):
            wanted = self._units[signal]
        else:
            keys = {} if kind is None else kind.quantities()
            if acts not in keys:
                more = f", or {', '.join(keys)}" if keys else ""
                raise ValueError(f"acts = {acts!r}: expected one of {', '.join((*SHARED, *OWN, ROOM))}{more}")
            value, wanted = keys[acts]
            if unit == "%":
                wanted, scale = unit, 0.01 * abs(value)
        difference = difference_unit(wanted)
        try:
            # The library of units takes a second to load.
            factor = 1.0 if unit in (wanted, difference) else read_quantity(f"1 {unit}", difference)
        except ValueError:
            raise ValueError(
                f"unit = {unit!r}: does not match; expected {wanted}, or a unit of the same kind"
            ) from None
        return scale * factor * component.uncertainty

    def scatter(self, signal: str) -> float | None:
        """Return by how much measurements of a signal scatter as it is stated, in its unit; None if no noise is."""
        own = {name: each.acts for name, each in self._stated.get(signal, {}).items() if each.acts in OWN}
        return math.hypot(*(self._sizes[signal, name] for name in own)) if "noise" in own.values() else None

    def room(self, signals: Sequence[str]) -> BudgetRow | None:
        """Return by how much one of some signals follows the room, as its contribution; None if none states it."""
        for signal in signals:
            for name, each in self._stated.get(signal, {}).items():
                if each.acts == ROOM:
                    return replace(_row(signal, name, each), contribution=self._sizes[signal, name])
        return None

    def _of_readings(self, signal: str) -> dict[str, Component]:
        return {name: each for name, each in self._stated.get(signal, {}).items() if each.acts != ROOM}

    def stated(self, names: Sequence[str]) -> list[str]:
        """Return those of some signals whose uncertainty is stated, with that of all signals behind them."""
        return [name for name in names if self._is_stated(name)]

    def _is_stated(self, signal: str) -> bool:
        kind = self._derived.get(signal)
        return bool(self._of_readings(signal)) if kind is None else all(map(self._is_stated, kind.sources))

    def reading(self, signal: str, values: Mapping[str, float], *, noise: bool = True) -> UncertainReading:
        """Return a reading of a signal as an uncertain number.

        Parameters
        ----------
        signal : str
            Which one.
        values : mapping of str to float
            The readings of it, or of the signals that it is derived from.
        noise : bool
            Whether it has noise. The mean of many readings at one place has none.
        """
        parts: list[Part] = []
        missing: list[str] = []
        number = self._reading(signal, values, parts, missing, noise, calibrated=False)
        return UncertainReading(signal, self._units[signal], number, tuple(parts), tuple(dict.fromkeys(missing)))

    def at(self, signal: str, value: float) -> UncertainReading:
        """Return a reading of a signal that has a value, whatever the readings behind it are.

        Raises ConfigurationError if it is computed from several signals, or never has the value.
        """
        from scipy.optimize import newton

        values, name = {signal: value}, signal
        while (kind := self._derived.get(name)) is not None:
            if len(kind.sources) != 1:
                raise ConfigurationError(
                    f"{name} is computed from {', '.join(kind.sources)}: its uncertainty is known after a run only"
                )
            (source,) = kind.sources
            compute, wanted = kind.bind(name, {source: self._units[source]}).compute, values[name]
            try:
                values[source] = float(newton(lambda x, f=compute, s=source, y=wanted: f({s: x}) - y, 0.0, x1=_FIRST))
            except (ArithmeticError, RuntimeError, DeviceError) as error:
                raise ConfigurationError(f"{name} cannot be {wanted:.6g} {self._units[name]}: {error}") from None
            name = source
        return self.reading(signal, values)

    def _reading(
        self,
        signal: str,
        values: Mapping[str, float],
        parts: list[Part],
        missing: list[str],
        noise: bool,
        *,
        calibrated: bool,
    ) -> Uncertain:
        components = {
            name: each
            for name, each in self._of_readings(signal).items()
            if (noise or each.acts != "noise") and not (calibrated and each.acts in _CALIBRATED)
        }
        kind = self._derived.get(signal)
        if kind is None:
            if not self._is_stated(signal):
                missing.append(signal)
            number: Uncertain = GTC.constant(values[signal])
        else:
            record = kind.calibration if isinstance(kind, Calibrated) else None
            sources = {
                source: self._reading(source, values, parts, missing, noise, calibrated=record is not None)
                for source in kind.sources
            }
            errors = {
                each.acts: self._part(signal, name, parts)[0].number
                for name, each in components.items()
                if each.acts not in SHARED + OWN
            }
            number = kind.uncertain(signal, {source: self._units[source] for source in sources}, sources, errors)
            if record is not None:
                number = number + self._of_calibration(signal, record, values[kind.sources[0]], parts)
        at = float(number.x)
        for name, each in components.items():
            if each.acts not in SHARED + OWN:
                continue
            first, *others = self._part(signal, name, parts)
            if each.acts == "gain":
                number = number + at * first.number
            elif others:
                assert each.range is not None
                low, high = each.range
                angle = 2.0 * math.pi * _WAVES * (at - low) / (high - low)
                number = number + math.sin(angle) * first.number + math.cos(angle) * others[0].number
            else:
                number = number + first.number
        return number

    def _part(self, signal: str, name: str, parts: list[Part]) -> list[Part]:
        """Return the elementary numbers of a component, which join `parts`."""
        component = self._stated[signal][name]
        found = self._shared.get((signal, name))
        if component.acts in OWN:
            # What a derived signal uses twice was read once.
            found = [each for each in parts if (each.row.signal, each.row.component) == (signal, name)]
        if not found:
            row = _row(signal, name, component)
            # A wave of any phase: its sine and its cosine.
            angles = (0.0, 0.5 * math.pi) if component.acts == "nonlinearity" else (None,)
            found = [Part(row, GTC.ureal(0.0, self._sizes[signal, name], row.freedom), angle) for angle in angles]
            self._shared[signal, name] = found
        _add(parts, found)
        return found

    def _of_calibration(self, signal: str, record: Calibration, at: float, parts: list[Part]) -> Uncertain:
        """Return the error of a calibration at a reading: the components are common to all readings."""
        number: Uncertain = 0.0
        for name, acts, type_, size, freedom in _components_of(record, at):
            if not size:
                continue
            source = f"certificate: {record.reference}"
            row = BudgetRow(signal, name, acts, type_, "normal", size, self._units[signal], freedom, 0.0, source)
            # Sensors that were compared with one reference have its error in common.
            of = f"{record.reference}, {record.reference_unit}" if acts == "reference" else f"calibrated {signal}"
            (first,) = self._shared.setdefault((of, name), [Part(row, GTC.ureal(0.0, 1.0, freedom))])
            number = number + size * first.number
            _add(parts, [replace(first, row=row)])
        return number


def _add(parts: list[Part], found: Sequence[Part]) -> None:
    """Add elementary numbers, but not twice."""
    parts.extend(part for part in found if all(part.number is not each.number for each in parts))


def _row(signal: str, name: str, component: Component) -> BudgetRow:
    """Return the row of a component, whose contribution is open."""
    return BudgetRow(
        signal=signal,
        component=name,
        acts=component.acts,
        type="A" if component.basis == "measured" else "B",
        distribution=component.distribution,
        standard=component.uncertainty,
        unit=component.unit,
        freedom=component.freedom or math.inf,
        contribution=0.0,
        source=f"{component.basis}: {component.source}",
        time=component.time,
    )


def _components_of(record: Calibration, at: float) -> list[tuple[str, str, str, float, float]]:
    """Return name, action, type, standard uncertainty and degrees of freedom of what a calibrated value has."""
    value, fitted = float(record.value(at)), float(record.coefficient_uncertainty([at])[0])
    return [
        ("calibration", "calibration", "A", fitted, float(record.degrees_of_freedom)),
        (
            "reference",
            "reference",
            "B",
            record.reference_uncertainty,
            record.reference_degrees_of_freedom or math.inf,
        ),
        ("scale of the reference", "reference", "B", record.reference_gain_uncertainty * abs(value), math.inf),
        ("lack of fit", "calibration", "A", record.lack_of_fit, float(record.degrees_of_freedom)),
    ]
