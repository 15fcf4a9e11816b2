"""Hysteresis among voltage, force and length: one operator inside another, and two simpler models beside it.

Source: Zhang and Yip, "Three-Dimensional Hysteresis Modeling of Robotic Artificial Muscles with Application to
Shape Memory Alloy Actuators", Robotics: Science and Systems, 2017; here "Zhang and Yip 2017".

All are quasi-static. "Voltage" is the paper's temperature surrogate, the constant voltage that would hold the
present temperature (eq. 2). Force is the tension, length the elongation from the resting length, positive when
elongated.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.models.density import Density
from bench.models.documents import Model, Parts
from bench.models.operator import Operator, operator_from_json
from bench.models.operators.polynomial import Polynomial
from bench.models.streams.coupled_stream import CoupledStream, TwoStageState, TwoStageStream

S = TypeVar("S")
Stage: TypeAlias = Operator[Any]


class Coupled(Model, ABC, Generic[S]):
    """A model from voltage and force to length, immutable apart from a state S that the caller carries along.

    Attributes
    ----------
    pretension : float
        Force during a reset, force units.
    """

    pretension: float

    @property
    @abstractmethod
    def operators(self) -> Mapping[str, Stage]:
        """The operators by the names that Zhang and Yip 2017 give them."""

    @property
    @abstractmethod
    def units(self) -> tuple[str, str, str]:
        """Units of voltage, force and length."""

    @property
    def voltage_unit(self) -> str:
        """Unit of the voltage."""
        return self.units[0]

    @property
    def force_unit(self) -> str:
        """Unit of the force."""
        return self.units[1]

    @property
    def length_unit(self) -> str:
        """Unit of the length."""
        return self.units[2]

    @abstractmethod
    def initial_state(self) -> S:
        """Return the state after a reset under the pretension: heated to the high end of the voltage, then cooled."""

    @abstractmethod
    def step(self, state: S, voltage: float, force: float) -> tuple[S, float]:
        """Return state and length after both inputs moved monotonically to new values, force first.

        Raises ValueError if a number is not finite.
        """

    def stream(self, state: S | None = None) -> CoupledStream[S]:
        """Return the model with a memory of its own, for one sample at a time, from a state (default: initial)."""
        return CoupledStream(self, self.initial_state() if state is None else state)

    @abstractmethod
    def evaluate(self, voltages: ArrayLike, forces: ArrayLike, state: S | None = None) -> Floats:
        """Return the lengths of a sequence, shape (N,), from `state` (default: that after a reset).

        Raises ValueError if a sequence is empty, not one-dimensional or not finite, or the lengths differ.
        """

    @abstractmethod
    def advance(self, voltages: ArrayLike, forces: ArrayLike, state: S | None = None) -> S:
        """Return the state after a sequence; arguments and errors as `evaluate`."""

    def densities(self) -> tuple[Density, ...]:
        """Return the densities of the operators that have one, titled by their names."""
        return tuple(
            replace(density, title=name, measured=name not in self._arguments)
            for name, operator in self.operators.items()
            for density in operator.densities()
        )

    _arguments: ClassVar[tuple[str, ...]] = ()


@dataclass(frozen=True, eq=False)
class TwoStage(Coupled[TwoStageState]):
    """The two-stage model: length = H2[force - H1[voltage]] (Zhang and Yip 2017, eq. 6).

    H1 is the force over the voltage at resting length (eqs. 3 and 5). Both should rise with their input
    (nonnegative weights): then the length rises with the force and falls with the voltage, and a monotone move of
    either is a monotone move of the argument u = force - H1[voltage], so that no more than the end points of a
    move matters.

    If force and voltage both change in one sample, the memory of H2 depends on the order. The convention is: u
    moves with the force first, at the old voltage, and then with the voltage. With `together`, u goes straight to
    its new value instead; that is right for a wire between fixed ends or against a spring, where the force is the
    consequence of the voltage and u does not move out and back.

    Parameters
    ----------
    first : Operator
        H1, from voltage to force.
    second : Operator
        H2, from force to length.
    pretension : float
        Force during a reset, force units.

    Raises
    ------
    ValueError
        If the units of H1's output and H2's input differ or the pretension is not finite.
    """

    kind: ClassVar[str] = "two-stage"
    parts: ClassVar[Parts] = {"first": operator_from_json, "second": operator_from_json}
    _arguments: ClassVar[tuple[str, ...]] = ("H2",)
    first: Stage
    second: Stage
    pretension: float = 0.0

    def __post_init__(self) -> None:
        _agree("second", self.second.input_unit, self.first.output_unit)
        object.__setattr__(self, "pretension", _checks.number("pretension", self.pretension))

    @property
    def operators(self) -> Mapping[str, Stage]:
        """The operators by their names in Zhang and Yip 2017."""
        return {"H1": self.first, "H2": self.second}

    @property
    def units(self) -> tuple[str, str, str]:
        """Units of voltage, force and length."""
        return self.first.input_unit, self.first.output_unit or self.second.input_unit, self.second.output_unit

    def initial_state(self) -> TwoStageState:
        """Return the state after a reset under the pretension: heated to the high end of the voltage, then cooled.

        Heating takes u far down, so that H2 starts on its ascending branch. The stages start from their
        own initial states.
        """
        low, high = self.first.input_range
        hot, most = self.first.step(self.first.initial_state(), high)
        cold, least = self.first.step(hot, low)
        released, _ = self.second.step(self.second.initial_state(), self.pretension - most)
        argument = self.pretension - least
        second, length = self.second.step(released, argument)
        return TwoStageState(low, self.pretension, cold, second, least, argument, length)

    def step(
        self, state: TwoStageState, voltage: float, force: float, *, together: bool = False
    ) -> tuple[TwoStageState, float]:
        """Return state and length after both inputs moved monotonically to new values; see `Coupled.step`.

        With `together` u moves straight to its new value, otherwise with the force first.
        """
        stream = self.stream(state)
        length = stream.step(voltage, force, together=together)
        return stream.state, length

    def stream(self, state: TwoStageState | None = None) -> TwoStageStream:
        """Return the model with a memory of its own, of streams of its stages; see `Coupled.stream`."""
        return TwoStageStream(self, self.initial_state() if state is None else state)

    def move(self, state: TwoStageState, voltage: float, argument: float) -> tuple[TwoStageState, float]:
        """Return state and length after the voltage and the argument u moved to new values; the force follows.

        With `argument` = `state.argument` the length is held and the force is H1[voltage] + u. Raises ValueError if a
        number is not finite.
        """
        stream = self.stream(state)
        length = stream.move(voltage, argument)
        return stream.state, length

    def arguments(
        self, voltages: ArrayLike, forces: ArrayLike, state: TwoStageState | None = None, *, together: bool = False
    ) -> Floats:
        """Return the inputs of H2, shape (2 N,): for each sample after the move of the force and of the voltage.

        With `together` the two are the same. Arguments and errors as `evaluate`.
        """
        before = self.initial_state() if state is None else state
        v, f = _pair(voltages, forces)
        blocked = np.append(before.blocked, self.first.evaluate(v, before.first))
        return _interleaved(blocked, f, together)

    def evaluate(
        self, voltages: ArrayLike, forces: ArrayLike, state: TwoStageState | None = None, *, together: bool = False
    ) -> Floats:
        """Return the lengths of a sequence; `together` as in `step`, otherwise see `Coupled.evaluate`."""
        before = self.initial_state() if state is None else state
        path = self.arguments(voltages, forces, before, together=together)
        return self.second.evaluate(path, before.second)[1::2]

    def advance(
        self, voltages: ArrayLike, forces: ArrayLike, state: TwoStageState | None = None, *, together: bool = False
    ) -> TwoStageState:
        """Return the state after a sequence; arguments and errors as `evaluate`."""
        before = self.initial_state() if state is None else state
        v, f = _pair(voltages, forces)
        blocked = np.append(before.blocked, self.first.evaluate(v, before.first))
        path = _interleaved(blocked, f, together)
        first = _advanced(self.first, before.first, v)
        # The last step is taken singly: it gives the length.
        *_, argument = path.tolist()
        second, length = self.second.step(_advanced(self.second, before.second, path[:-1]), argument)
        return TwoStageState(float(v[-1]), float(f[-1]), first, second, float(blocked[-1]), argument, length)


@dataclass(frozen=True, slots=True)
class SummedState:
    """Present voltage and force, and the states of both operators."""

    voltage: float
    force: float
    by_force: Any
    by_voltage: Any


@dataclass(frozen=True, eq=False)
class Summed(Coupled[SummedState]):
    """The model to compare with: length = H3[force] - H4[voltage] (Zhang and Yip 2017, eq. 8).

    The loop over the voltage has the same shape at every force. The order of moves does not matter.

    Parameters
    ----------
    by_force : Operator
        H3, from force to length.
    by_voltage : Operator
        H4, from voltage to contraction, length units.
    pretension : float
        Force during a reset, force units.

    Raises
    ------
    ValueError
        If the units of the two outputs differ or the pretension is not finite.
    """

    kind: ClassVar[str] = "summed"
    parts: ClassVar[Parts] = {"by_force": operator_from_json, "by_voltage": operator_from_json}
    by_force: Stage
    by_voltage: Stage
    pretension: float = 0.0

    def __post_init__(self) -> None:
        _agree("by_voltage", self.by_voltage.output_unit, self.by_force.output_unit)
        object.__setattr__(self, "pretension", _checks.number("pretension", self.pretension))

    @property
    def operators(self) -> Mapping[str, Stage]:
        """The operators by their names in Zhang and Yip 2017."""
        return {"H3": self.by_force, "H4": self.by_voltage}

    @property
    def units(self) -> tuple[str, str, str]:
        """Units of voltage, force and length."""
        length = self.by_force.output_unit or self.by_voltage.output_unit
        return self.by_voltage.input_unit, self.by_force.input_unit, length

    def initial_state(self) -> SummedState:
        """Return the state after a reset under the pretension: heated to the high end of the voltage, then cooled."""
        low, high = self.by_voltage.input_range
        by_voltage = self.by_voltage.initial_state()
        for voltage in (high, low):
            by_voltage, _ = self.by_voltage.step(by_voltage, voltage)
        by_force, _ = self.by_force.step(self.by_force.initial_state(), self.pretension)
        return SummedState(low, self.pretension, by_force, by_voltage)

    def step(self, state: SummedState, voltage: float, force: float) -> tuple[SummedState, float]:
        """Return state and length after both inputs moved monotonically to new values; see `Coupled.step`."""
        v, f = _checks.number("voltage", voltage), _checks.number("force", force)
        by_force, elongation = self.by_force.step(state.by_force, f)
        by_voltage, contraction = self.by_voltage.step(state.by_voltage, v)
        return SummedState(v, f, by_force, by_voltage), elongation - contraction

    def evaluate(self, voltages: ArrayLike, forces: ArrayLike, state: SummedState | None = None) -> Floats:
        """Return the lengths of a sequence; see `Coupled.evaluate`."""
        before = self.initial_state() if state is None else state
        v, f = _pair(voltages, forces)
        return self.by_force.evaluate(f, before.by_force) - self.by_voltage.evaluate(v, before.by_voltage)

    def advance(self, voltages: ArrayLike, forces: ArrayLike, state: SummedState | None = None) -> SummedState:
        """Return the state after a sequence; see `Coupled.advance`."""
        before = self.initial_state() if state is None else state
        v, f = _pair(voltages, forces)
        return SummedState(
            float(v[-1]),
            float(f[-1]),
            _advanced(self.by_force, before.by_force, f),
            _advanced(self.by_voltage, before.by_voltage, v),
        )


@dataclass(frozen=True, eq=False)
class Linear(Coupled[TwoStageState]):
    """The model to compare with: length = H5[force - slope * voltage - offset] (Zhang and Yip 2017, eq. 9).

    It is the two-stage model with a straight line as first stage, see `two_stage`.

    Parameters
    ----------
    slope : float
        a, force units per voltage unit, >= 0.
    offset : float
        F0, force units.
    operator : Operator
        H5, from force to length.
    input_range : tuple of float
        Range of the voltage, for the reset.
    pretension : float
        Force during a reset, force units.
    voltage_unit : str
        Unit, for labels.

    Raises
    ------
    ValueError
        If the slope is negative, a number is not finite or the range does not increase.
    """

    kind: ClassVar[str] = "linear"
    parts: ClassVar[Parts] = {"operator": operator_from_json}
    _arguments: ClassVar[tuple[str, ...]] = ("H5",)
    slope: float
    offset: float
    operator: Stage
    input_range: tuple[float, float]
    pretension: float = 0.0
    voltage_unit: str = ""
    two_stage: TwoStage = field(init=False, repr=False)

    def __post_init__(self) -> None:
        slope, offset = _checks.number("slope", self.slope), _checks.number("offset", self.offset)
        if slope < 0.0:
            raise ValueError(f"slope: expected a number >= 0, got {slope}")
        low, high = _checks.increasing("input_range", self.input_range).tolist()
        line = Polynomial(
            np.array([0.5 * slope * (high - low)]),
            (low, high),
            offset + 0.5 * slope * (low + high),
            self.voltage_unit,
            self.operator.input_unit,
        )
        object.__setattr__(self, "slope", slope)
        object.__setattr__(self, "offset", offset)
        object.__setattr__(self, "input_range", (low, high))
        object.__setattr__(self, "two_stage", TwoStage(line, self.operator, self.pretension))
        object.__setattr__(self, "pretension", self.two_stage.pretension)

    @property
    def operators(self) -> Mapping[str, Stage]:
        """The operators by their names in Zhang and Yip 2017."""
        return {"H5": self.operator}

    @property
    def units(self) -> tuple[str, str, str]:
        """Units of voltage, force and length."""
        return self.voltage_unit, self.operator.input_unit, self.operator.output_unit

    def initial_state(self) -> TwoStageState:
        """Return the state after a reset under the pretension."""
        return self.two_stage.initial_state()

    def step(self, state: TwoStageState, voltage: float, force: float) -> tuple[TwoStageState, float]:
        """Return state and length after both inputs moved monotonically to new values; see `Coupled.step`."""
        return self.two_stage.step(state, voltage, force)

    def evaluate(self, voltages: ArrayLike, forces: ArrayLike, state: TwoStageState | None = None) -> Floats:
        """Return the lengths of a sequence; see `Coupled.evaluate`."""
        return self.two_stage.evaluate(voltages, forces, state)

    def advance(self, voltages: ArrayLike, forces: ArrayLike, state: TwoStageState | None = None) -> TwoStageState:
        """Return the state after a sequence; see `Coupled.advance`."""
        return self.two_stage.advance(voltages, forces, state)


def _agree(name: str, unit: str, other: str) -> None:
    """Refuse two units that are both known and differ."""
    if unit and other and unit != other:
        raise ValueError(f"{name}: expected the unit {other!r}, got {unit!r}")


def _pair(voltages: ArrayLike, forces: ArrayLike) -> tuple[Floats, Floats]:
    v = _checks.samples("voltages", voltages)
    return v, _checks.counted("forces", forces, v.size, "values, one for each voltage")


def _interleaved(blocked: Floats, forces: Floats, together: bool) -> Floats:
    """Return the inputs of the second stage from the blocked forces before and at each sample, shape (N + 1,)."""
    path = np.empty(2 * forces.size)
    path[1::2] = forces - blocked[1:]
    path[0::2] = path[1::2] if together else forces - blocked[:-1]
    return path


def _advanced(stage: Stage, state: Any, inputs: Floats) -> Any:  # noqa: ANN401 - each operator has its own state
    """Return an operator's state after a sequence, which may be empty."""
    return stage.advance(state, inputs) if inputs.size else state
