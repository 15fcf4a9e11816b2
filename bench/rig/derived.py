"""Signals that are computed from others: an expression with units, or a class of one's own.

A rig file asks for them by tables::

    [derived.strain]
    expression = "gain * (bridge_a_voltage - bridge_b_voltage)"
    constants = { gain = "2.5e-3 1/V" }
    unit = "1"

    [derived.bending]
    kind = "beam_bending:Bending"       # module:Class, or registered in `bench.derived_signals`
    source = "spot_position"
    length = 300e-6

Each may use others, but none comes from itself.
"""

from __future__ import annotations

import ast
import math
import operator
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from pydantic import Field, field_validator
from simpleeval import SimpleEval

from bench.base import CheckedTable, DeviceError, quantity, unit_registry
from bench.devices import Signal

_OPERATORS = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    # On whole numbers Python's own power may take for ever, on negative ones it may be complex.
    ast.Pow: math.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
_FUNCTIONS: dict[str, Callable[..., float]] = {
    "abs": abs,
    "sqrt": math.sqrt,
    "exp": math.exp,
    "log": math.log,
    "sin": math.sin,
    "cos": math.cos,
    "tan": math.tan,
    "atan": math.atan,
    "min": lambda *values: min(values),
    "max": lambda *values: max(values),
}
_ON_QUANTITIES: dict[str, Callable[..., Any]] = {
    **{name: getattr(np, name) for name in ("abs", "sqrt", "exp", "log", "sin", "cos", "tan")},
    "atan": np.arctan,
    "min": lambda first, *others: reduce(np.minimum, others, first),
    "max": lambda first, *others: reduce(np.maximum, others, first),
}
"""The same functions on quantities with units."""
_STEP = 1e-5
"""Step of a numerical derivative, as a part of the value. Derivation: 1e-10 of it is lost by the third derivative,
1e-11 by rounding."""
_NODES = (ast.Expression, ast.BinOp, ast.UnaryOp, ast.Call, ast.Name, ast.Constant, ast.Load, *_OPERATORS)


@dataclass(frozen=True)
class Derived:
    """A derived signal of one rig, ready to be computed from the signals that are its sources.

    `compute` takes the values of all signals above it and returns its own, or raises `DeviceError` if it has none.
    """

    signal: Signal
    sources: tuple[str, ...]
    compute: Callable[[Mapping[str, float]], float]


class DerivedSignal(CheckedTable, ABC):
    """Base of the kinds of derived signals; its fields are the keys of the table in the rig file."""

    kind: str = Field(default="expression", description="which class computes it")

    @property
    @abstractmethod
    def sources(self) -> tuple[str, ...]:
        """Signals that it is computed from."""

    @abstractmethod
    def bind(self, name: str, units: Mapping[str, str]) -> Derived:
        """Return the signal for sources of these units.

        Parameters
        ----------
        name : str
            Name of the table.
        units : mapping of str to str
            Unit of each source.

        Raises
        ------
        ValueError
            If a unit does not fit; says which unit is expected.
        """

    def quantities(self) -> dict[str, tuple[float, str]]:
        """Return value and unit of each key whose uncertainty a rig file may state: numbers with a unit."""
        return {
            name: (float(getattr(self, name)), str(extra["unit"]))
            for name, info in type(self).model_fields.items()
            if isinstance(extra := info.json_schema_extra, dict) and "unit" in extra
        }

    def uncertain(
        self, name: str, units: Mapping[str, str], sources: Mapping[str, Any], errors: Mapping[str, Any]
    ) -> Any:  # noqa: ANN401 - an uncertain number
        """Return the signal as an uncertain number of the library GTC.

        This one takes the derivatives numerically, as GUM 5.1.3 allows; a kind may compute with uncertain numbers.

        Parameters
        ----------
        name, units
            As for `bind`.
        sources : mapping of str to uncertain number
            The signals that it is computed from.
        errors : mapping of str to uncertain number
            Errors of keys that `quantities` names, in their units; expected to be 0.
        """
        compute = self.bind(name, units).compute
        values = {source: float(number.x) for source, number in sources.items()}

        def slope(at: float, of: Callable[[float], float]) -> float:
            step = _STEP * abs(at) or _STEP
            return (of(at + step) - of(at - step)) / (2.0 * step)

        result: Any = compute(values)
        for source, number in sources.items():

            def moved(x: float, source: str = source) -> float:
                return compute({**values, source: x})

            result = result + slope(values[source], moved) * (number - values[source])
        for key, error in errors.items():

            def changed(x: float, key: str = key) -> float:
                return self.model_copy(update={key: x}).bind(name, units).compute(values)

            result = result + slope(self.quantities()[key][0], changed) * error
        return result


class Expression(DerivedSignal):
    """An arithmetic expression over signals and constants, with its unit.

    Temperatures in °C count as differences, in K without an offset.
    """

    expression: str = Field(
        min_length=1, description=f"arithmetic over signals and constants; functions: {', '.join(_FUNCTIONS)}"
    )
    unit: str = Field(description="unit of the result; 1 for a plain number")
    constants: dict[str, str | float] = Field(
        default_factory=dict, description='numbers by name, with units as in "300e-6 m"'
    )
    description: str = Field(default="", description="a few words for axes and column headers")
    precision: int = Field(default=3, ge=0, le=12, description="digits after the point that are worth showing")

    @field_validator("expression")
    @classmethod
    def _can_be_parsed(cls, text: str) -> str:
        # The parser passes on every error of Python's own grammar.
        try:
            tree = ast.parse(text.strip(), mode="eval")
        except Exception as error:
            raise ValueError(f"is not an arithmetic expression: {error}") from None
        functions = set()
        for node in ast.walk(tree):
            part = ast.unparse(node) if isinstance(node, ast.expr) else type(node).__name__
            is_number = not isinstance(node, ast.Constant) or type(node.value) in (int, float)
            if not (isinstance(node, _NODES) and is_number):
                raise ValueError(f"{part!r} is no arithmetic; allowed are + - * / **, numbers, names and functions")
            if isinstance(node, ast.Call):
                if not isinstance(node.func, ast.Name) or node.func.id not in _FUNCTIONS or node.keywords:
                    raise ValueError(f"{part!r} is none of the functions {', '.join(_FUNCTIONS)}")
                functions.add(node.func)
            elif isinstance(node, ast.Name) and node.id in _FUNCTIONS and node not in functions:
                raise ValueError(f"{part!r} is a function and needs its arguments in parentheses")
        return text

    @property
    def sources(self) -> tuple[str, ...]:
        """Signals that the expression names."""
        names = [
            node.id
            for node in ast.walk(ast.parse(self.expression.strip(), mode="eval"))
            if isinstance(node, ast.Name)
        ]
        return tuple(name for name in dict.fromkeys(names) if name not in self.constants and name not in _FUNCTIONS)

    def bind(self, name: str, units: Mapping[str, str]) -> Derived:
        """Return the signal; see `DerivedSignal.bind`."""
        constants = {key: quantity(f"constants.{key}", str(value)) for key, value in self.constants.items()}
        quantities = constants | {source: quantity(source, f"1 {units[source]}") for source in self.sources}
        wanted = quantity("unit", f"1 {self.unit}")
        operators = {**_OPERATORS, ast.Pow: _power_of_quantity}
        check = SimpleEval(operators=operators, functions=_ON_QUANTITIES, names=quantities)
        # Only the units matter here, so a value may be infinite; the library raises many kinds of errors.
        try:
            with np.errstate(all="ignore"):
                found = unit_registry().Quantity(check.eval(self.expression))
        except Exception as error:
            raise ValueError(f"expression = {self.expression!r}: {error}") from None
        if not found.is_compatible_with(wanted):
            raise ValueError(f"expression = {self.expression!r} is in {found.units:~P}, not in unit = {self.unit!r}")
        # Everything is computed in SI base units, independent of the units of the sources.
        factors = {key: float(_in_base_units(quantity)) for key, quantity in quantities.items()}
        scale = 1.0 / float(_in_base_units(wanted))
        evaluator = SimpleEval(operators=_OPERATORS, functions=_FUNCTIONS)
        tree = evaluator.parse(self.expression)
        sources = self.sources

        def compute(values: Mapping[str, float]) -> float:
            evaluator.names = factors | {source: values[source] * factors[source] for source in sources}
            try:
                return scale * float(evaluator.eval(self.expression, previously_parsed=tree))
            except (ArithmeticError, ValueError) as error:
                shown = ", ".join(f"{source} = {values[source]:g}" for source in sources)
                raise DeviceError(name, f"{self.expression} has no value for {shown}: {error}") from None

        description = self.description or name.replace("_", " ")
        return Derived(Signal(name, self.unit, description, self.precision), sources, compute)

    def quantities(self) -> dict[str, tuple[float, str]]:
        """Return value and unit of each constant."""
        found = {key: quantity(f"constants.{key}", str(value)) for key, value in self.constants.items()}
        return {key: (float(each.magnitude), f"{each.units:~}" or "1") for key, each in found.items()}

    def uncertain(
        self, name: str, units: Mapping[str, str], sources: Mapping[str, Any], errors: Mapping[str, Any]
    ) -> Any:  # noqa: ANN401 - an uncertain number
        """Return the expression of uncertain numbers; see `DerivedSignal.uncertain`."""

        def base(number: Any, unit: str) -> Any:  # noqa: ANN401 - an uncertain number
            return number * _in_base_units(quantity("unit", f"1 {unit}"))

        names = {source: base(number, units[source]) for source, number in sources.items()}
        for key, (value, unit) in self.quantities().items():
            names[key] = base(value + errors[key] if key in errors else value, unit)
        operators = {**_OPERATORS, ast.Pow: operator.pow}
        evaluator = SimpleEval(operators=operators, functions=_on_uncertain_numbers(), names=names)
        try:
            return evaluator.eval(self.expression) / base(1.0, self.unit)
        except (ArithmeticError, ValueError) as error:
            raise DeviceError(name, f"{self.expression} has no uncertainty there: {error}") from None


def _on_uncertain_numbers() -> dict[str, Callable[..., Any]]:
    """Return the functions of expressions for uncertain numbers and for plain ones."""
    # Takes a second to import.
    import GTC

    def value(number: Any) -> float:  # noqa: ANN401 - an uncertain number
        return float(GTC.value(number))

    return {
        "abs": GTC.magnitude,
        **{name: getattr(GTC, name) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "atan")},
        "min": lambda *values: min(values, key=value),
        "max": lambda *values: max(values, key=value),
    }


def _power_of_quantity(base: Any, exponent: Any) -> Any:  # noqa: ANN401 - quantities or numbers
    if isinstance(base, int | float):
        base = np.float64(base)
    elif not base.dimensionless and not isinstance(exponent, int | float):
        raise ValueError(f"a power of {base.units:~P} needs a number as its exponent")
    return base**exponent


def _in_base_units(quantity: Any) -> float:  # noqa: ANN401 - a quantity of the library's
    return float(quantity.to_base_units().magnitude)
