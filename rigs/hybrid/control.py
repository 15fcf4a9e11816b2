"""Mid-ranging control of a cantilever with a slow thermal part of long range and a fast piezo part of short range.

The controllers are sampled: called at a fixed rate with all readings, they return all set-points. Units are SI;
temperatures are in °C and a positive current heats. The thermal part is driven by heat fed forward from the reference
and fed back from its estimated deflection. The piezo part makes up the difference, through the inverse of its
hysteresis, and so returns to the middle of its range.

Source: Allison and Isaksson, "Design and performance of mid-ranging controllers", Journal of Process Control 8, 1998.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar

import numpy as np

from bench.base import ConfigurationError, ConvergenceError, DeferredModule, closest
from bench.control import (
    ApproachedReference,
    ControllerSetup,
    ControllerSpec,
    Reference,
    Trace,
    check_positive,
)
from protocols.hybrid.control import MID_RANGING
from rigs.hybrid.estimates import (
    Bending,
    LowPass,
    ReducedNetwork,
    ThermalEstimate,
    ThermalNoise,
    Thermistor,
    UnscentedEstimate,
)
from rigs.hybrid.lateness import BEGIN, END, LatenessProbe
from rigs.hybrid.model import HybridModel
from rigs.hybrid.notch_loop import NotchLoop, NotchLoopParameters
from rigs.hybrid.play_inverse import SampledPlayInverse

if TYPE_CHECKING:
    from rigs.hybrid import _kernels as kernels
else:
    kernels = DeferredModule("rigs.hybrid._kernels")

T = TypeVar("T")

_NEAR = 0.5
"""Part of the stroke within which the piezo part takes the tip to the beginning of the reference at once."""
_AT_REST = 0.2
"""Difference of base and tip below which the rig counts as having rested before the start, K."""
_TOLERATED = 0.6
"""Difference of the lateness that is found to the one that is known, in periods, up to which both are the same."""
_ROOM = 4
"""Room for the reference that comes, in widths of its window."""
_RESTED = 15.0
"""Time for which the reference has rested where the error of the model alone is judged, s."""
_JUDGED = 5.0
"""Time over which it is, s."""
_HOLDS = 0.12
"""Part of the stroke that the model alone may err by there, RMS."""
_DOUBTED = 1.5
"""Factor below that error from which on there is a warning. On the specimen as identified the greatest error of 95
sessions is 6.4 % of the stroke."""
_NEW_CURRENT = 0.02
"""Time between two currents, s."""
_TABLE = f"[protocols.hybrid-control.tuning.{MID_RANGING}]"
_OF_THE_RUN = ("period", "every", "maximum_current", "noise")
"""Settings that do not stand in that table; those of the noise have one of their own."""


class _Preview:
    """Thermal part of the reference: smoothed by a window in time, with its derivative, now and ahead.

    Changes faster than the window are left to the piezo part. The window extends into the future of the known
    reference and adds no delay.
    """

    def __init__(self, reference: Reference, window: float, lead: float, period: float) -> None:
        half = max(1, round(0.5 * window / period))
        self._reference = reference
        self._period = period
        x = np.arange(-half, half + 1) / (half + 1.0)
        weights = 0.5 + 0.5 * np.cos(math.pi * x)
        self._weights = weights / weights.sum()
        slopes = np.sin(math.pi * x)
        # Exact for a ramp.
        self._slopes = slopes / (slopes @ (x * (half + 1.0) * period))
        width = 2 * half + 1
        ahead = round(lead / period)
        values = np.array([reference(k * period) for k in range(-half, half + 1 + ahead)])
        # What is ahead now is the present in a while.
        self._smoothed = deque(float(self._weights.dot(values[k : k + width])) for k in range(ahead))
        # The window ahead moves along the array, and back to its beginning once it has come to the end.
        self._width = width
        self._values = np.append(values[ahead:], np.zeros(_ROOM * width))
        self._begin = 0
        self._next = half + 1 + ahead

    def advance(self, t: float) -> tuple[float, float, float]:
        """Return the smoothed reference now (m), and ahead (m) with its derivative (m/s)."""
        values, begin = self._values, self._begin
        end = begin + self._width
        window = values[begin:end]
        # As a product by `@`, in half the time.
        ahead, rate = float(self._weights.dot(window)), float(self._slopes.dot(window))
        self._smoothed.append(ahead)
        if end == len(values):
            values[: self._width] = window
            begin, end = 0, self._width
        values[end] = self._reference(t + self._next * self._period)
        self._begin = begin + 1
        return self._smoothed.popleft(), ahead, rate


def _made(kind: type[T], table: str, given: Mapping[str, Any], **further: float) -> T:
    """Return numbers of a controller, made from a table of the rig file; `further` are not of that."""
    if not isinstance(given, Mapping):
        raise ConfigurationError(f"{_TABLE} {table.removesuffix('.')} = {given!r}: expected a table of numbers")
    known = [each.name for each in fields(kind) if each.name not in further]  # type: ignore[arg-type]
    if unknown := given.keys() - set(known):
        wrong = table + min(unknown)
        names = closest(wrong, [table + each for each in known])
        raise ConfigurationError(f"{_TABLE} {wrong}: there is no such number; {names}")
    try:
        return kind(**given, **further)
    except (TypeError, ValueError) as error:
        raise ConfigurationError(f"{_TABLE} {table}{error}") from None


def _lacking(kind: type[Any], table: str, given: object) -> list[str]:
    """Return the names of numbers that a table of the rig file has to have and lacks."""
    if not isinstance(given, Mapping):
        return []
    needed = [each.name for each in fields(kind) if each.default is MISSING and each.name not in _OF_THE_RUN]
    return [table + name for name in needed if name not in given]


@dataclass(frozen=True, kw_only=True)
class MidRangingParameters:
    """Settings of the mid-ranging controllers."""

    period: float
    """Time between two calls, s."""
    every: int
    """Calls per new current."""
    maximum_current: float
    """Greatest current of either sign, A."""
    gain: float
    """Heat fed back per missing deflection of the thermal part, W/m."""
    integral_time: float
    """Time constant of the integral in that feedback, s."""
    lead: float
    """Time by which the heat leads the reference, s: the lag of the bending behind the base."""
    window: float
    """Time over which the reference is smoothed for the thermal part, s."""
    filter_time: float
    """Time constant of the low-pass that estimates the thermal part in place of a Kalman filter, s."""
    integral: float
    """Gain of the piezo part's integral, 1/s, below half the rate of the calls."""
    stroke: float
    """Greatest deflection of either sign that the piezo part is asked for, m."""
    approach: float
    """Top speed of the move to the beginning of the reference, where that is far from the start, m/s."""
    noise: ThermalNoise
    """Of the Kalman filter."""
    lateness: float = 0.0
    """Time by which the deflection is read late, as the calibration of its sensor finds it, s."""
    probe: float = 0.0
    """Height of the square wave by which the lateness is checked while the reference rests, m; 0 for no check."""

    def __post_init__(self) -> None:
        maybe_none = ("lateness", "probe")
        check_positive(self, *(each.name for each in fields(self) if each.name not in maybe_none))
        for name in maybe_none:
            if not 0.0 <= (value := getattr(self, name)) < math.inf:
                raise ValueError(f"{name}: expected a number >= 0, got {value}")
        if not 2.0 * self.integral * self.period < 1.0:
            raise ValueError(f"integral: expected less than {0.5 / self.period:g} 1/s, got {self.integral}")

    @classmethod
    def at_rate(cls, rate: float, numbers: Mapping[str, Any], **further: float) -> Self:
        """Return the settings for a number of calls per second, with a new current every 20 ms or call.

        Parameters
        ----------
        rate : float
            Hz.
        numbers : mapping
            Those of this cantilever, as a table of the rig file; `noise` is one by itself.
        further : float
            The others.

        Raises
        ------
        ConfigurationError
            If a number is missing, there is no such number, or its value is not allowed.
        """
        noise = numbers.get("noise", {})
        if missing := _lacking(cls, "", numbers) + _lacking(ThermalNoise, "noise.", noise):
            raise ConfigurationError(
                f"nothing says of this cantilever: {', '.join(missing)}; give them in the rig file, {_TABLE}"
            )
        noise = _made(ThermalNoise, "noise.", noise)
        every = max(1, round(_NEW_CURRENT * rate))
        return _made(cls, "", {**numbers, "noise": noise}, period=1.0 / rate, every=every, **further)

    @property
    def samples_late(self) -> float:
        """The lateness in samples."""
        return self.lateness / self.period

    def share(self, period: float) -> float:
        """Return the share of a new value that a low-pass of `filter_time` takes in after a period (s)."""
        return -math.expm1(-period / self.filter_time)


class _MidRanging:
    """Thermal and piezo part under one reference; the controllers differ in estimate and use of the piezo part.

    Readings are (deflection, m; temperature of the base, °C; temperature of the tip, °C), set-points (current, A;
    voltage, V). A missing reading holds both.
    """

    def __init__(
        self,
        model: HybridModel,
        reference: Reference,
        parameters: MidRangingParameters,
        estimate: Callable[[Bending, ReducedNetwork], ThermalEstimate],
        *,
        piezo: bool = True,
        integral: float = 0.0,
    ) -> None:
        self._p = parameters
        self._model = model
        self._make_estimate = estimate
        self._reference = ApproachedReference(reference, _NEAR * parameters.stroke, parameters.approach)
        self._position: Reference = self._reference
        self._step = parameters.period * parameters.every
        self._settings = np.array([parameters.gain, self._step, parameters.integral_time, parameters.maximum_current])
        self._prepare(model.reference)
        self._inverse = inverse = SampledPlayInverse(model.hysteresis, parameters.stroke) if piezo else None
        self._integral_gain = integral * parameters.period
        self._integral = 0.0
        self._probe: LatenessProbe | None = None
        # What the piezo part was asked for, as far back as readings are late, the last one first.
        whole, self._late_part = divmod(parameters.samples_late, 1.0)
        self._late_whole = int(whole)
        self._is_late = parameters.lateness > 0.0
        self._asked = deque([0.0], maxlen=2 + self._late_whole)
        self._fed_back = 0.0
        self._start = math.nan
        self._samples = 0
        self._current = 0.0
        self._voltage = 0.0 if inverse is None else inverse.input(0.0)
        self._wanted = math.nan
        self._base = self._tip = math.nan
        self._notice = ""

    def _prepare(self, room: float) -> None:
        """Make all that depends on the temperature of the room (°C) and on where the reference begins."""
        model, p = self._model, self._p
        self._celsius = room
        self._bending = Bending(model.polynomial, room - model.reference)
        self._network = ReducedNetwork(model.network, room)
        self._estimate = self._make_estimate(self._bending, self._network)
        self._preview = _Preview(self._position, p.window, p.lead, self._step)

    @property
    def delay(self) -> float:
        """Time by which the reference is put off, as its beginning has to be approached first, s."""
        return self._reference.delay

    def take_notice(self) -> str:
        """Return what is to be warned of, once; empty if there is nothing to say."""
        notice, self._notice = self._notice, ""
        return notice

    def _begin(self, t: float, deflection: float, base: float, tip: float) -> None:
        """Begin at the first readings: deflection without the piezo part (m), temperatures (°C)."""
        self._start = t
        self._reference.begin(deflection)
        self._position = self._reference.from_here
        # A rig that has rested is as warm as the room. Otherwise the room is that of the model.
        self._prepare(0.5 * (base + tip) if abs(base - tip) < _AT_REST else self._model.reference)
        self._estimate.begin(deflection, base - self._celsius, tip - self._celsius)
        probe = LatenessProbe(self._p.probe, self._p.period)
        if self._p.probe and self._integral_gain and probe.fits(self._reference):
            self._probe = probe

    def _seen_piezo(self) -> float:
        """Return the part of the piezo in the present reading, which is late, m."""
        asked, whole, part = self._asked, self._late_whole, self._late_part
        last = len(asked) - 1
        newer = asked[min(whole, last)]
        return newer + part * (asked[min(whole + 1, last)] - newer) if part else newer

    def _check_lateness(self, probe: LatenessProbe) -> None:
        """Raise `ConvergenceError` if readings are later than the controller knows."""
        p = self._p
        found = probe.lateness()
        if abs(found - p.lateness) > _TOLERATED * p.period:
            raise ConvergenceError(
                f"the deflection answers the piezo part {1e3 * found:.3g} ms late, the controller was given "
                f"{1e3 * p.lateness:.3g} ms: moves would be off by their speed times the difference; calibrate the "
                "sensor (calibration-displacement, bench rig calibrate) and set the parameter lateness"
            )

    def update(self, t: float, measured: tuple[float, ...]) -> tuple[float, float]:
        """Take deflection (m) and temperatures of base and tip (°C) at a time (s); return current and voltage.

        Raises ValueError if there are not three readings, and `ConvergenceError` if the deflection is read later than
        the controller knows.
        """
        if len(measured) != 3:
            raise ValueError(f"measured: expected deflection and two temperatures, got {len(measured)} readings")
        deflection, base, tip = measured
        p, inverse = self._p, self._inverse
        complete = math.isfinite(deflection + base + tip)
        if complete:
            piezo = self._seen_piezo() if self._is_late else self._asked[0]
            if math.isnan(self._start):
                self._begin(t, deflection - piezo, base, tip)
            self._base, self._tip = base - self._celsius, tip - self._celsius
            self._estimate.sample(deflection - piezo)
        elif math.isnan(self._start):
            return self._current, self._voltage
        now = t - self._start
        self._wanted = wanted = self._position(now)
        if self._samples % p.every == 0:
            self._heat(now, hold=not complete)
        self._samples += 1
        if complete and inverse is not None:
            # The voltage aims at the reference at the end of the coming period.
            period, late, estimate = p.period, p.lateness, self._estimate
            feedforward = self._position(now + period) - (estimate.value + period * estimate.rate)
            error = (self._position(now - late) if late else wanted) - deflection
            if self._probe is not None and now >= BEGIN:
                # The integral waits.
                added = self._probe.wave(now)
                self._voltage = inverse.input(feedforward + self._integral + added)
                self._probe.note(added, -error)
                if now >= END:
                    self._check_lateness(self._probe)
                    self._probe = None
                self._asked.appendleft(inverse.output)
                return self._current, self._voltage
            self._voltage = inverse.input(feedforward + self._integral + self._integral_gain * error)
            self._asked.appendleft(inverse.output)
            if self._integral_gain:
                # The part clipped by the stroke is taken back: the integral does not wind up.
                self._integral = inverse.output - feedforward
        return self._current, self._voltage

    def _heat(self, now: float, *, hold: bool) -> None:
        """Advance the thermal part over the past period; set the current of the coming one, or hold it."""
        network, base = self._network, self._base
        network.advance(base, self._current, self._step)
        self._estimate.correct(base, self._tip, self._current)
        wanted, ahead, rate = self._preview.advance(now)
        if hold:
            return
        bending = self._bending
        self._current, self._fed_back = kernels.next_current(
            ahead,
            rate,
            wanted - self._estimate.value,
            base,
            self._current,
            self._fed_back,
            self._settings,
            network.numbers,
            bending.range,
            bending.slopes,
            bending.table,
        )

    @property
    def trace(self) -> Trace:
        """State of the controller; the disturbance is the thermal deflection less that of the model."""
        disturbance, uncertainty = self._estimate.describe(self._tip)
        piezo = 0.0 if self._inverse is None else self._inverse.output
        return Trace(
            reference=self._wanted,
            predicted=self._estimate.value + piezo,
            disturbance=disturbance,
            uncertainty=uncertainty,
        )


class HybridController(_MidRanging):
    """Mid-ranging control: the thermal part provides the range, the piezo part the accuracy.

    Parameters
    ----------
    model : HybridModel
        The identified model.
    reference : callable
        Wanted deflection, m, at a time in s from the first complete reading; also before 0 and after the end.
    parameters : MidRangingParameters
        Settings of the loops.
    estimator : {"unscented", "low-pass"}
        Estimate of the thermal part: a Kalman filter of the thermal state, or a low-pass.
    """

    def __init__(
        self,
        model: HybridModel,
        reference: Reference,
        parameters: MidRangingParameters,
        *,
        estimator: Literal["unscented", "low-pass"] = "unscented",
    ) -> None:
        p = parameters

        def estimate(bending: Bending, network: ReducedNetwork) -> ThermalEstimate:
            if estimator == "unscented":
                return UnscentedEstimate(bending, network, p.noise, p.period, p.every, p.lateness)
            if estimator == "low-pass":
                return LowPass(bending, p.share(p.period))
            raise ValueError(f"estimator: expected unscented or low-pass, got {estimator!r}")

        super().__init__(model, reference, p, estimate, integral=p.integral)


class OpenLoopHybrid(_MidRanging):
    """Inverse of the model without the deflection sensor, from the temperature of the tip alone.

    The thermal part follows the inverted polynomial, the piezo part adds what the polynomial at the measured
    temperature lacks, through the inverse of the hysteresis. The deflection tells only whether the model holds: where
    the reference has rested, the error may not be more than 12 % of the stroke, and from two thirds of that on there
    is a warning. Parameters as `HybridController`.
    """

    _resting = -math.inf
    """Since when the reference rests, s."""
    _squares, _count = 0.0, 0
    _doubted = 0.0
    """Greatest error of which there is a warning, m RMS."""

    def __init__(self, model: HybridModel, reference: Reference, parameters: MidRangingParameters) -> None:
        p = parameters
        super().__init__(model, reference, p, lambda bending, _: Thermistor(bending, p.share(p.period * p.every)))

    def update(self, t: float, measured: tuple[float, ...]) -> tuple[float, float]:
        """Take readings and return set-points; see `HybridController`.

        Raises `ConvergenceError` if the model does not hold.
        """
        before = self._wanted
        setpoints = super().update(t, measured)
        if self._wanted != before:
            self._resting, self._squares, self._count = t, 0.0, 0
        elif t - self._resting >= _RESTED and math.isfinite(measured[0]):
            self._squares += (measured[0] - self._wanted) ** 2
            self._count += 1
            if self._count * self._p.period >= _JUDGED:
                self._judge(math.sqrt(self._squares / self._count))
                self._squares, self._count = 0.0, 0
        return setpoints

    def _judge(self, error: float) -> None:
        most = _HOLDS * self._p.stroke
        known = f"its error at rest is {error:.2g} m RMS, and that of a model that holds at most {most:.2g}"
        if error > most:
            raise ConvergenceError(f"the model does not hold for this specimen: {known}; identify the specimen again")
        if error > max(most / _DOUBTED, self._doubted):
            self._notice, self._doubted = f"the open loop errs: {known}", error


class ThermalFeedback(_MidRanging):
    """Thermal part alone, fed forward and fed back from the deflection; the voltage stays 0.

    Parameters as `HybridController`; the gain can be higher, as no piezo part does the rest.
    """

    def __init__(self, model: HybridModel, reference: Reference, parameters: MidRangingParameters) -> None:
        p = parameters
        super().__init__(model, reference, p, lambda bending, _: LowPass(bending, p.share(p.period)), piezo=False)


def make_fine(model: HybridModel, reference: Reference, parameters: NotchLoopParameters) -> NotchLoop:
    """Return the loop of the piezo part alone, at a rate that resolves the resonance."""
    dynamics = model.dynamics
    return NotchLoop(model.hysteresis, dynamics.frequency, dynamics.damping, reference, parameters)


def _mid_ranging(summary: str, controller: Callable[..., _MidRanging]) -> ControllerSpec:
    """Return a controller of the class for the registry.

    Options of its setup: `reference` (callable, m), `rate` (Hz), `numbers` (see `MidRangingParameters.at_rate`),
    `lateness` (s) and `probe` (m). Its limits are those of the current, the lower one the negative of the upper.
    """

    def make(setup: ControllerSetup) -> _MidRanging:
        options = setup.options
        further = {name: options[name] for name in ("lateness", "probe")} | {"maximum_current": setup.limits[1]}
        parameters = MidRangingParameters.at_rate(options["rate"], options["numbers"], **further)
        return controller(setup.model.model, options["reference"], parameters)

    return ControllerSpec(summary, make)


def _fine(setup: ControllerSetup) -> NotchLoop:
    options = setup.options
    parameters = NotchLoopParameters(**{name: options[name] for name in ("rate", "integral", "stroke")})
    return make_fine(setup.model.model, options["reference"], parameters)


HYBRID = _mid_ranging("mid-ranging of thermal and piezo part, with a Kalman filter", HybridController)
HYBRID_LOW_PASS = _mid_ranging(
    "mid-ranging of thermal and piezo part, with a low-pass", partial(HybridController, estimator="low-pass")
)
OPEN_LOOP = _mid_ranging("the inverse of the model, without the deflection sensor", OpenLoopHybrid)
THERMAL_FEEDBACK = _mid_ranging("feedback to the thermal part alone", ThermalFeedback)
NOTCH = ControllerSpec("the piezo part alone, with a notch at its resonance", _fine)
