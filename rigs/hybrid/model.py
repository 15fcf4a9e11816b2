"""The whole model of the thermo-piezoelectric cantilever, and the identification of its two static parts.

Source: Rakotondrabe and Ivan, "Development and dynamic modeling of a new hybrid thermo-piezoelectric
micro-actuator", IEEE Transactions on Robotics 26(6), 2010, eqs. 18 to 22; here "Rakotondrabe and Ivan 2010".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.identification import Identification, ThirdOrder, identify
from bench.models import Model, ModelSpec, Operator, Parts, Polynomial, PrandtlIshlinskii
from rigs.hybrid.network import NODES, ThermalNetwork

# Allowed use of a part beyond the range that it was fitted on, as a share of that range.
_BEYOND = 0.05

PUBLISHED_DYNAMICS = ThirdOrder(
    gain=102.0 * 2.4e8 / (1274.0 * 1.9e7),
    real_pole=1274.0,
    frequency=math.sqrt(1.9e7),
    damping=34.1 / (2.0 * math.sqrt(1.9e7)),
    numerator=(2.58e4 / 2.4e8, 1.0 / 2.4e8),
)
"""D(s) of Rakotondrabe and Ivan 2010, eq. 21, as printed.

The paper calls it delta/U, but its gain is 1.0113 instead of d_p: it is divided by the static deflection. Use
`normalised` behind a static model.
"""


@dataclass(frozen=True, eq=False)
class HybridResponse:
    """Response of the hybrid model.

    Parameters
    ----------
    deflections : ndarray, shape (N,)
        Deflection of the tip from rest, m: the sum of the next two.
    thermal, piezo : ndarray, shape (N,)
        Shares of the thermal and the piezo part, m.
    temperatures : ndarray, shape (N, 4)
        Temperature of each of `NODES`, °C.
    """

    deflections: Floats
    thermal: Floats
    piezo: Floats
    temperatures: Floats


@dataclass(frozen=True, eq=False)
class HybridModel(Model):
    """From current and voltage to the deflection of the tip (Rakotondrabe and Ivan 2010, eq. 22, corrected).

    deflection = p(T_L - T_r) - p(0) + D(s)/D(0) (P(U) - its bias)

    The temperature T_L of the tip comes from the thermal network, p is the thermomechanical polynomial and P the
    Prandtl-Ishlinskii operator from volts to metres: each play follows the voltage with a memory of its own, whereas
    in (20) every play starts from the total deflection. D is divided by its gain, 1.011 in (21), since P is the
    static deflection already. The values of p and P at rest, the zero of the sensor, are subtracted. T_r is constant,
    where (22) has the present temperature of the air: a cantilever that has followed the room to another temperature
    is bent, with a current or without.

    Parameters
    ----------
    network : ThermalNetwork
        From current to temperatures.
    polynomial : Polynomial
        From the tip's temperature above the reference, K, to m.
    hysteresis : PrandtlIshlinskii
        From V to m.
    dynamics : ThirdOrder
        D(s); its gain does not matter.
    reference : float
        T_r, temperature of the tip at which the deflection is 0, °C.

    Raises
    ------
    ValueError
        If the range of the polynomial does not contain 0 K, the hysteresis falls, or the reference is not a number.
    """

    kind: ClassVar[str] = "hybrid"
    parts: ClassVar[Parts] = {
        "network": ThermalNetwork.from_json,
        "polynomial": Polynomial.from_json,
        "hysteresis": PrandtlIshlinskii.from_json,
        "dynamics": ThirdOrder.from_json,
    }
    network: ThermalNetwork
    polynomial: Polynomial
    hysteresis: PrandtlIshlinskii
    dynamics: ThirdOrder
    reference: float = 22.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "reference", _checks.number("reference", self.reference))
        _check_contains_rest(self.polynomial)
        if not self.hysteresis.rises():
            raise ValueError("hysteresis: expected weights >= 0, as the deflection rises with the voltage")

    def simulate(
        self, currents: ArrayLike, voltages: ArrayLike, dt: float, ambient: ArrayLike = 22.0
    ) -> HybridResponse:
        """Return the response to currents and voltages that are held for dt each, exactly.

        Row k is at time k dt, before current and voltage k have acted.

        At the start every temperature is that of the air, and the piezo layer is relaxed.

        Parameters
        ----------
        currents, dt, ambient
            As in `ThermalNetwork.simulate`.
        voltages : array_like, shape (N,)
            V, held likewise.

        Raises
        ------
        ValueError
            If a sequence is wrong, or the model would be used more than 5 % beyond the range of temperatures or
            voltages that it was fitted on.
        """
        i = _checks.samples("currents", currents)
        u = _checks.counted("voltages", voltages, i.size, "values, one for each current")
        _check_range("voltages", u, self.hysteresis.input_range, "V", "hysteresis")
        temperatures = self.network.simulate(i, dt, ambient)
        rises = temperatures[:, NODES.index("tip")] - self.reference
        _check_range("currents: tip above the reference", rises, self.polynomial.input_range, "K", "polynomial")
        thermal = self.thermal_deflection(rises)
        static = self.hysteresis.evaluate(u) - self.hysteresis.bias
        piezo = self.dynamics.normalised().simulate(static, dt)
        return HybridResponse(thermal + piezo, thermal, piezo, temperatures)

    def thermal_deflection(self, rises: ArrayLike) -> Floats:
        """Return the static deflection at temperatures of the tip above the reference (K, shape (N,)), m."""
        return np.asarray(self.polynomial.evaluate(rises) - self.polynomial.evaluate([0.0])[0])

    def bandwidth(self, current: float = 0.0, ambient: float = 22.0) -> float:
        """Return the frequency at which small thermal deflections about a constant current have fallen by 3 dB, Hz.

        The polynomial is a factor for small changes: it is the bandwidth of the tip's temperature.
        """
        return self.network.bandwidth("tip", current, ambient)


@dataclass(frozen=True)
class OrderChoice:
    """The polynomial order chosen, and the RMS error of each order from 1 on, output units."""

    order: int
    rms: tuple[float, ...]


def choose_order(
    rises: ArrayLike, deflections: ArrayLike, *, maximum: int = 8, fraction: float = 1e-3
) -> OrderChoice:
    """Return the least order beyond which the error of the polynomial does not decrease substantially.

    As Rakotondrabe and Ivan 2010, section V-C (order 4), with a criterion: no higher order lowers the RMS error by
    more than a fraction of the range of the deflections. A single order without effect (an even one, for an odd
    curve) does not end the search.

    Parameters
    ----------
    rises : array_like, shape (N,)
        Temperature of the tip above a constant reference, K.
    deflections : array_like, shape (N,)
        m.
    maximum : int
        Highest order tried, at least 1.
    fraction : float
        Substantial decrease as a share of the range, between 0 and 1.

    Raises
    ------
    ValueError
        If a sequence is wrong, there are too few samples, or an option is out of its range.
    """
    if maximum < 1:
        raise ValueError(f"maximum: expected at least 1, got {maximum}")
    if not 0.0 < _checks.number("fraction", fraction) < 1.0:
        raise ValueError(f"fraction: expected a number between 0 and 1, got {fraction}")
    found = [_fit_polynomial(rises, deflections, order) for order in range(1, maximum + 1)]
    rms = tuple(each.errors.rms for each in found)
    enough = fraction * found[0].errors.span
    order = next(n for n in range(1, maximum + 1) if rms[n - 1] - min(rms[n - 1 :]) <= enough)
    return OrderChoice(order, rms)


def identify_polynomial(
    rises: ArrayLike, deflections: ArrayLike, order: int | None = None
) -> Identification[Polynomial]:
    """Return the thermomechanical polynomial that fits best (Rakotondrabe and Ivan 2010, eqs. 18 and 19).

    The offset is free, as a sensor has its own zero; `HybridModel` subtracts it.

    Parameters
    ----------
    rises : array_like, shape (N,)
        Temperature of the tip above the reference, K, below and above 0; quasi-static.
    deflections : array_like, shape (N,)
        m, without voltage.
    order : int or None
        Order; default that of `choose_order`.

    Raises
    ------
    ValueError
        If a sequence is wrong, there are too few samples, or the rises do not extend to 0 K.
    """
    found = _fit_polynomial(rises, deflections, choose_order(rises, deflections).order if order is None else order)
    _check_contains_rest(found.model)
    return found


def _fit_polynomial(rises: ArrayLike, deflections: ArrayLike, order: int) -> Identification[Polynomial]:
    levels = np.unique(_checks.samples("rises", rises)).size
    if levels <= order:
        raise ValueError(f"rises: expected more than {order} different values for order {order}, got {levels}")
    return identify("polynomial", rises, deflections, degree=order, input_unit="K", output_unit="m")


def identify_pi(
    voltages: ArrayLike,
    deflections: ArrayLike,
    *,
    plays: int = 15,
    maximum: float | None = None,
) -> Identification[PrandtlIshlinskii]:
    """Return the Prandtl-Ishlinskii operator that fits the quasi-static piezo deflection best.

    Plays with thresholds i maximum / plays, weights not negative, and a free offset (Rakotondrabe and Ivan 2010,
    eq. 20, with a state in volts for each play, relaxed before the first sample). The first weight is positive, so
    that the operator has its inverse.

    Parameters
    ----------
    voltages : array_like, shape (N,)
        V; a loop slow against the dynamics (0.1 Hz there).
    deflections : array_like, shape (N,)
        m, at a constant current.
    plays : int
        Number of plays.
    maximum : float or None
        Greatest voltage of the operating range, V; default the greatest among the samples.

    Raises
    ------
    ValueError
        If a sequence is wrong, a voltage exceeds the maximum, or the deflection does not follow small changes
        of the voltage at all.
    """
    u = _checks.samples("voltages", voltages)
    reach = float(np.abs(u).max())
    limit = reach if maximum is None else _checks.number("maximum", maximum)
    if not 0.0 < reach <= limit:
        raise ValueError(f"voltages: expected values that vary, up to ±{limit:g} V, got up to ±{reach:g} V")
    found = identify(
        "prandtl-ishlinskii",
        u,
        deflections,
        plays=plays,
        maximum=limit,
        input_range=(-limit, limit),
        input_unit="V",
        output_unit="m",
        initial=None,
    )
    if not found.model.coefficients[0] > 0.0:
        raise ValueError("deflections: expected a positive weight of the first play; there is no inverse without it")
    return found


def _check_contains_rest(polynomial: Operator[Any]) -> None:
    low, high = polynomial.input_range
    span = _BEYOND * (high - low)
    if not low - span <= 0.0 <= high + span:
        raise ValueError(f"polynomial: expected a range of rises that extends to 0 K, got {low:g} to {high:g} K")


def _check_range(name: str, values: Floats, span: tuple[float, float], unit: str, part: str) -> None:
    low, high = span
    beyond = _BEYOND * (high - low)
    least, greatest = float(values.min()), float(values.max())
    if least < low - beyond or greatest > high + beyond:
        raise ValueError(
            f"{name}: expected {low:g} to {high:g} {unit}, the range of the {part}, "
            f"got {least:g} to {greatest:g} {unit}"
        )


HYBRID = ModelSpec("thermo-piezoelectric cantilever: network, polynomial, plays and dynamics", HybridModel)
