"""Identification of the thermal network from measured steps of the current."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks
from bench.identification import Errors, Evidence, Stage, measure_errors, variable_projection
from rigs.hybrid.design import Design
from rigs.hybrid.network import NODES, ThermalNetwork

FREE_PARAMETERS: tuple[str, ...] = (
    "seebeck",
    "electrical_resistance",
    "tec_resistance",
    "tec_capacity",
    "beam_resistance",
    "beam_side_resistance",
    "block_side_resistance",
)
"""Parameters that `identify_network` fits by default."""

_MEASURED = [NODES.index("base"), NODES.index("tip")]

# Farthest that a parameter may move from its start, as logarithm: a factor of 20.
_REACH = 3.0
# A parameter of greater relative standard uncertainty counts as not identified.
_UNKNOWN = 0.25
# Nor are any, if the columns of the scaled Jacobian are this close to dependent.
_DEPENDENT = 1e7


@dataclass(frozen=True, eq=False)
class NetworkIdentification:
    """A thermal network fitted to measured temperatures, with the evidence for it.

    Parameters
    ----------
    network : ThermalNetwork
        The fitted network.
    ambient : float
        Estimated temperature of the air, from which all started, °C.
    uncertainties : mapping of str to float
        Standard uncertainty of each fitted parameter in its own unit, and of "ambient", K: from the Jacobian and
        the variance of the residuals, as if these were white.
    residuals : ndarray, shape (N, 2)
        Measured minus simulated temperature of base and tip, K.
    base, tip : Errors
        Error measures of the two, K.
    condition : float
        Condition number of the Jacobian with its columns scaled to unit norm.
    gradient : float
        Greatest cosine between the residuals and a column of the Jacobian; 0 is exact optimality.
    moves : ndarray, shape (n, N, 2)
        Change of the logarithm of each fitted parameter with each measured temperature of base and tip, 1/K.
    """

    network: ThermalNetwork
    ambient: float
    uncertainties: Mapping[str, float]
    residuals: Floats
    base: Errors
    tip: Errors
    condition: float
    gradient: float
    moves: Floats


def identify_network(
    currents: ArrayLike,
    base: ArrayLike,
    tip: ArrayLike,
    dt: float,
    *,
    start: ThermalNetwork | None = None,
    free: Sequence[str] = FREE_PARAMETERS,
) -> NetworkIdentification:
    """Return the network that follows measured steps of the current best in the least-squares sense.

    Fitted are the logarithms of the free parameters, so that they stay positive, and the ambient temperature,
    which all nodes have at the first sample. Temperatures determine heat capacities, conductances, alpha and R_p up
    to one common factor; a held parameter sets it. By default that is the best known one, the heat capacity of the
    block, a solid piece of metal. Also held are the capacity of the cantilever and the parameters that two
    thermistors cannot resolve: the resistances of the glue, along the block and of its front (in parallel with its
    sides), and that of the cantilever's end face (1.7 % of its loss). The others need steps of both signs, since
    alpha acts oddly in the current and R_p evenly, held until the block is warm (about 7 min), and sampled faster
    than the lag of the tip (about 2 s). The block shows as a slow share of a few kelvin: a room that drifts meanwhile
    shifts the common factor (see `room_influence`), but not temperatures and bandwidth.

    Parameters
    ----------
    currents : array_like, shape (N,)
        A, positive heats; number k is held from sample k to sample k + 1.
    base, tip : array_like, shape (N,)
        Temperatures at the clamped base and at the tip, °C; the first while everything is at rest.
    dt : float
        Sampling time, s.
    start : ThermalNetwork or None
        Start of the search, with the values of the held parameters; default that of `Design`.
    free : sequence of str
        Names of the parameters to fit.

    Raises
    ------
    ValueError
        If a sequence is wrong, a name unknown, or if the data do not identify the parameters: the Jacobian is
        nearly rank deficient, a relative standard uncertainty exceeds 25 %, or a parameter ends 20 times away
        from its start.
    """
    i = _checks.samples("currents", currents)
    each = "values, one for each current"
    measured = [_checks.counted(name, values, i.size, each) for name, values in (("base", base), ("tip", tip))]
    step = _checks.positive("dt", dt)
    known = {each.name for each in fields(ThermalNetwork)}
    if not free or not set(free) <= known or len(set(free)) != len(free):
        raise ValueError(f"free: expected different ones of {', '.join(sorted(known))}, got {', '.join(free)}")
    if 2 * i.size <= len(free) + 1:
        raise ValueError(f"currents: expected more than {(len(free) + 1) // 2} samples, got {i.size}")
    origin = Design().network() if start is None else start
    target = np.stack(measured, axis=1)

    def network(logarithms: Floats) -> ThermalNetwork:
        return replace(origin, **{n: getattr(origin, n) * math.exp(x) for n, x in zip(free, logarithms, strict=True)})

    def residuals(x: Floats) -> Floats:
        simulated = network(x[:-1]).simulate(i, step, float(x[-1]))
        return np.asarray((target - simulated[:, _MEASURED]).ravel())

    first = np.append(np.zeros(len(free)), target[0].mean())
    reach = np.append(np.full(len(free), _REACH), np.inf)
    search = Stage(1, 1e-12, 100 * first.size)
    found = variable_projection(residuals, [first], (first - reach, first + reach), stages=[search], central=True)[0]
    names, fit, logarithms = (*free, "ambient"), found.residuals, found.values
    evidence = Evidence.of(found.jacobian, fit, fit.size - first.size)
    deviations, condition = evidence.deviations, evidence.condition
    if lost := [n for n, deviation in zip(names, deviations, strict=True) if np.isinf(deviation)]:
        raise ValueError(
            f"currents: the temperatures do not depend on {', '.join(lost)}; expected steps of the current"
        )
    if condition > _DEPENDENT:
        raise ValueError(
            f"currents: the data do not tell {', '.join(free)} apart (condition {condition:.1e}); hold one of "
            "them, or measure longer and with steps of both signs"
        )
    poor = [
        f"{n} (± {100.0 * deviation:.0f} %)"
        for n, deviation, x in zip(free, deviations, logarithms, strict=False)
        if deviation > _UNKNOWN or abs(x) > 0.999 * _REACH
    ]
    if poor:
        raise ValueError(
            f"currents: the data do not identify {', '.join(poor)}; hold it, or measure longer and "
            "with steps of both signs"
        )
    fitted = network(logarithms[:-1])
    rows = fit.reshape(-1, 2)
    uncertainties = {n: float(getattr(fitted, n) * s) for n, s in zip(free, deviations, strict=False)}
    errors = [measure_errors(target[:, k], target[:, k] - rows[:, k]) for k in range(2)]
    return NetworkIdentification(
        network=fitted,
        ambient=float(logarithms[-1]),
        uncertainties={**uncertainties, "ambient": float(deviations[-1])},
        residuals=rows,
        base=errors[0],
        tip=errors[1],
        condition=condition,
        gradient=float(evidence.cosines.max()),
        moves=np.asarray(-np.linalg.pinv(found.jacobian)[:-1], dtype=np.float64).reshape(len(free), -1, 2),
    )


def room_influence(found: NetworkIdentification, currents: ArrayLike, dt: float, time: float) -> Floats:
    """Return the standard deviations of the logarithms of the fitted parameters for a room that wanders by 1 K rms.

    Derivation: to first order a logarithm moves by Σ w_j a_j for air that is off by a_j at sample j, where w follows
    from the moves of the fit and the network. If a room's autocorrelation falls as exp(-t/time), the variance is
    Σ w_j w_k exp(-|j - k| dt/time), which a recursion of first order sums up.

    Parameters
    ----------
    found : NetworkIdentification
        The network.
    currents : array_like, shape (N,)
        Those from which it was identified, A.
    dt, time : float
        Sampling time, and time after which the autocorrelation has fallen to 1/e, s.
    """
    from scipy.signal import lfilter

    weights = np.zeros((*found.moves.shape[:2], len(NODES)))
    weights[..., _MEASURED] = found.moves
    moved = found.network.air_weights(currents, dt, weights)
    passed = lfilter([1.0], [1.0, -math.exp(-dt / time)], moved)
    # Of air that hardly changes nothing but rounding is left.
    return np.asarray(np.sqrt(np.maximum((moved * (2.0 * passed - moved)).sum(axis=1), 0.0)))
