"""The thermal network of the thermo-piezoelectric cantilever.

Source: Rakotondrabe and Ivan, "Development and dynamic modeling of a new hybrid thermo-piezoelectric
micro-actuator", IEEE Transactions on Robotics 26(6), 2010; here "Rakotondrabe and Ivan 2010". A cantilever of PZT
on copper is clamped to one face of a thermoelectric cooler; a block of aluminium is glued to the other.

The network follows from Kirchhoff's laws for the paper's Fig. 10, in absolute temperature, with the Peltier heat of
each face at that face's own temperature. The printed equations differ from it in these points:

- c_sf of (15) has one R_c too many: with it, the block rests 40 K below the room without any current.
- One Peltier source, alpha T_act0 i, serves both faces in Fig. 10: the electrical power alpha (T_h - T_c) i is lost.
- Misprints: a sign in (2), (R_vs + 1)/R_s in (5), T_so twice in (6), "+ 1" missing in (7), R_c for R_act in (8).
- R_vsf and R_va2 carry a factor 2 that belongs to surfaces shared by two nodes; an end face has one.

**Positive current heats the cantilever.** The paper's positive current cools it; i here is -i there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from bench.base import Floats, checks as _checks

Node: TypeAlias = Literal["block end", "block front", "base", "tip"]

NODES: tuple[Node, ...] = ("block end", "block front", "base", "tip")
"""The nodes with a heat capacity, in the order of all arrays of temperatures.

The insulated end and the front of the block (the paper's T_so, T_sf), the clamped base of the cantilever, which
is also the cooler's face (T_act0), and its tip (T_actL).
"""

ABSOLUTE_ZERO = -273.15
_BLOCK_END, _BLOCK_FRONT, _BASE, _TIP = range(4)


def check_fields(settings: Any, *free: str) -> None:  # noqa: ANN401 - a dataclass
    """Check that every field of a dataclass is a positive number; those named `free` may have either sign."""
    for each in fields(settings):
        check = _checks.number if each.name in free else _checks.positive
        object.__setattr__(settings, each.name, check(each.name, getattr(settings, each.name)))


@dataclass(frozen=True)
class ThermalNetwork:
    """Four heat capacities, the resistances among them and the air, and the cooler between base and block.

    With x the massless node between cooler and glue, J = R_p i²/2 and every temperature absolute:

        (T_x - T_sf)/R_c = -alpha T_x i + J - (T_x - T_0)/R_th
        C_s dT_so/dt   = (T_a - T_so)/R_vs + (T_sf - T_so)/R_s
        C_s dT_sf/dt   = (T_a - T_sf)/R_vs//f + (T_so - T_sf)/R_s + (T_x - T_sf)/R_c
        (C_act + C_tec) dT_0/dt = (T_a - T_0)/R_va1 + (T_L - T_0)/R_act + alpha T_0 i + J + (T_x - T_0)/R_th
        C_act dT_L/dt  = (T_a - T_L)/R_va1//2 + (T_0 - T_L)/R_act

    For a constant current that is linear in the temperatures. Arrays of temperatures have one column for each of
    `NODES` and are in °C; the current is positive when it heats the cantilever.

    Parameters
    ----------
    block_capacity : float
        C_s of each half of the block, J/K.
    block_resistance, block_side_resistance, block_front_resistance : float
        R_s along the block, R_vs from the side of each half and R_vf from the front face to the air, K/W.
    glue_resistance : float
        R_c, K/W.
    seebeck : float
        alpha, V/K.
    electrical_resistance : float
        R_p, Ohm.
    tec_resistance : float
        R_th through the cooler, K/W.
    tec_capacity : float
        Heat capacity C_tec at the base besides the cantilever's, J/K.
    beam_capacity : float
        C_act of each half of the cantilever, J/K.
    beam_resistance, beam_side_resistance, beam_end_resistance : float
        R_act along the cantilever, R_va1 from the side of each half and R_va2 from the end face to the air, K/W.

    Raises
    ------
    ValueError
        If a parameter is not a positive number.
    """

    block_capacity: float
    block_resistance: float
    block_side_resistance: float
    block_front_resistance: float
    glue_resistance: float
    seebeck: float
    electrical_resistance: float
    tec_resistance: float
    tec_capacity: float
    beam_capacity: float
    beam_resistance: float
    beam_side_resistance: float
    beam_end_resistance: float

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def capacities(self) -> Floats:
        """Heat capacity of each node, J/K, shape (4,)."""
        base = self.beam_capacity + self.tec_capacity
        return np.array([self.block_capacity, self.block_capacity, base, self.beam_capacity])

    @property
    def air_conductances(self) -> Floats:
        """Conductance of each node to the air, W/K, shape (4,)."""
        block, beam = 1.0 / self.block_side_resistance, 1.0 / self.beam_side_resistance
        ends = 1.0 / self.block_front_resistance, 1.0 / self.beam_end_resistance
        return np.array([block, block + ends[0], beam, beam + ends[1]])

    def rates(self, temperatures: ArrayLike, current: float, ambient: float) -> Floats:
        """Return the rate of change of each temperature, K/s, shape (4,).

        Parameters
        ----------
        temperatures : array_like, shape (4,)
            °C.
        current : float
            A, positive heats.
        ambient : float
            Temperature of the air, °C.

        Raises
        ------
        ValueError
            If the shape is wrong, a number is not finite or the current exceeds what the glue can carry.
        """
        matrix, forcing = self._system(_checks.number("current", current), _air(ambient))
        return np.asarray(matrix @ (_nodes("temperatures", temperatures) - ambient) + forcing)

    def _system(self, current: float, ambient: float) -> tuple[Floats, Floats]:
        """Return M and b: the rises above ambient change at M @ rises + b."""
        joule, peltier = self._forcing(current)
        return self._matrix(current), joule + (ambient - ABSOLUTE_ZERO) * peltier

    def _forcing(self, current: float) -> tuple[Floats, Floats]:
        """Return the rates due to the current at rest: by Joule heat, K/s, and by Peltier heat, per kelvin of air."""
        joule, peltier = 0.5 * self.electrical_resistance * current**2, self.seebeck * current
        back = 1.0 / self._node_conductance(current)
        both = np.zeros((2, 4))
        both[:, _BLOCK_FRONT] = np.array([joule, -peltier]) * back / self.glue_resistance
        both[:, _BASE] = np.array([joule, -peltier]) * back / self.tec_resistance + (joule, peltier)
        both /= self.capacities
        return both[0], both[1]

    def _node_conductance(self, current: float) -> float:
        """Return the conductance at the massless node, 1/R_c + 1/R_th + alpha i, W/K."""
        total = 1.0 / self.glue_resistance + 1.0 / self.tec_resistance + self.seebeck * current
        if not total > 0.0:
            limit = -(1.0 / self.glue_resistance + 1.0 / self.tec_resistance) / self.seebeck
            raise ValueError(
                f"current: expected more than {limit:.3g} A, got {current:g}; the glue carries no more heat"
            )
        return total

    def _matrix(self, current: float) -> Floats:
        flows = np.zeros((4, 4))
        for one, other, resistance in (
            (_BLOCK_END, _BLOCK_FRONT, self.block_resistance),
            (_BASE, _TIP, self.beam_resistance),
        ):
            flows[[one, other], [other, one]] += 1.0 / resistance
            flows[[one, other], [one, other]] -= 1.0 / resistance
        flows[np.diag_indices(4)] -= self.air_conductances
        # The massless node is a star of two branches; its Peltier heat is proportional to its temperature.
        glue, cooler = 1.0 / self.glue_resistance, 1.0 / self.tec_resistance
        total = self._node_conductance(current)
        flows[_BLOCK_FRONT, _BLOCK_FRONT] += glue**2 / total - glue
        flows[_BLOCK_FRONT, _BASE] += glue * cooler / total
        flows[_BASE, _BLOCK_FRONT] += glue * cooler / total
        flows[_BASE, _BASE] += cooler**2 / total - cooler + self.seebeck * current
        return np.asarray(flows / self.capacities[:, None])

    def _back_face(self, temperatures: Floats, current: float) -> float:
        """Return the absolute temperature of the massless node, K."""
        absolute = temperatures - ABSOLUTE_ZERO
        joule = 0.5 * self.electrical_resistance * current**2
        flow = joule + absolute[_BASE] / self.tec_resistance + absolute[_BLOCK_FRONT] / self.glue_resistance
        return float(flow / self._node_conductance(current))

    def steady_rises(self, current: float, ambient: float = 22.0) -> Floats:
        """Return the steady rise of each node above the air under a constant current, K, shape (4,).

        One linear solve: no iteration, and exactly 0 without current. Raises ValueError if a number is not finite or
        the current heats without end.
        """
        matrix, forcing = self._system(_checks.number("current", current), _air(ambient))
        if np.linalg.eigvals(matrix).real.max() >= 0.0:
            raise ValueError(
                f"current: at {current:g} A the base heats faster than it cools; there is no steady state"
            )
        return np.asarray(np.linalg.solve(matrix, -forcing))

    def steady_state(self, current: float, ambient: float = 22.0) -> Floats:
        """Return the temperatures under a constant current, °C, shape (4,); see `steady_rises`."""
        return ambient + self.steady_rises(current, ambient)

    def linearise(self, current: float = 0.0, ambient: float = 22.0) -> tuple[Floats, Floats]:
        """Return A (shape (4, 4), 1/s) and B (shape (4,), K/(A s)) of small changes about a steady state.

        Changes of the temperatures follow A @ temperatures + B * current. Raises ValueError as `steady_rises`.
        """
        temperatures = self.steady_state(current, ambient)
        back = self._back_face(temperatures, current)
        joule = self.electrical_resistance * current
        back_by_current = (joule - self.seebeck * back) / self._node_conductance(current)
        heat = np.zeros(4)
        heat[_BLOCK_FRONT] = back_by_current / self.glue_resistance
        front = self.seebeck * (temperatures[_BASE] - ABSOLUTE_ZERO)
        heat[_BASE] = front + joule + back_by_current / self.tec_resistance
        return self._matrix(current), heat / self.capacities

    def bandwidth(self, node: Node = "tip", current: float = 0.0, ambient: float = 22.0) -> float:
        """Return the frequency at which small changes of a temperature have fallen by 3 dB, Hz.

        The lowest such frequency, relative to constant changes of the current. The bandwidth of the tip is also that
        of the thermal deflection, which follows it without lag (Rakotondrabe and Ivan 2010, eq. 11).

        Parameters
        ----------
        node : {"block end", "block front", "base", "tip"}
            Node of the temperature.
        current : float
            Constant current about which it changes, A.
        ambient : float
            Temperature of the air, °C.

        Raises
        ------
        ValueError
            If there is no such node; as `steady_rises`.
        """
        from scipy.optimize import brentq

        if node not in NODES:
            raise ValueError(f"node: expected one of {', '.join(NODES)}, got {node!r}")
        at = NODES.index(node)
        matrix, column = self.linearise(current, ambient)
        steady = abs(np.linalg.solve(matrix, column)[at])

        def excess(logarithm: float) -> float:
            response = np.linalg.solve(1j * math.exp(logarithm) * np.eye(4) - matrix, column)
            return float(abs(response[at]) / steady - math.sqrt(0.5))

        rates = np.abs(np.linalg.eigvals(matrix))
        grid = np.arange(math.log(rates.min()) - 3.0, math.log(rates.max()) + 3.0, 0.05)
        below = int(np.argmax([excess(x) < 0.0 for x in grid]))
        return float(math.exp(brentq(excess, grid[below - 1], grid[below])) / (2.0 * math.pi))

    def simulate(
        self, currents: ArrayLike, dt: float, ambient: ArrayLike = 22.0, *, start: ArrayLike | None = None
    ) -> Floats:
        """Return the temperatures under currents that are held for dt each, exactly.

        Shape (N, 4), °C; row k is at time k dt, before current k has acted.

        Parameters
        ----------
        currents : array_like, shape (N,)
            A, positive heats; number k is held from k dt to (k + 1) dt.
        dt : float
            Time step, s, > 0.
        ambient : array_like, scalar or shape (N,)
            Temperature of the air, °C, held likewise.
        start : array_like, shape (4,), or None
            Temperatures at time 0; default the ambient.

        Raises
        ------
        ValueError
            If a shape is wrong, a number is not finite, or dt is not positive.
        """
        i = _checks.samples("currents", currents)
        step = _checks.positive("dt", dt)
        air = _ambients(ambient, i.size)
        result = np.empty((i.size, 4))
        now = np.full(4, air[0]) if start is None else _nodes("start", start)
        stretches = list(_runs(i, air))
        transitions = self._transitions(tuple(dict.fromkeys(i[[first for first, _ in stretches]].tolist())), step)
        for first, stop in stretches:
            # At rest without current the rises stay exactly 0.
            state = np.concatenate([now - air[first], [1.0, air[first] - ABSOLUTE_ZERO]])
            path = _powers(transitions[float(i[first])], state, stop - first)[:, :4] + air[first]
            result[first:stop] = path[:-1]
            now = path[-1]
        return result

    def air_weights(self, currents: ArrayLike, dt: float, weights: ArrayLike) -> Floats:
        """Return by how much weighted sums of the temperatures change with the air's at each sample, shape (n, N).

        The air is held for dt each, as in `simulate`, and all nodes have its temperature at the first sample.

        Parameters
        ----------
        currents : array_like, shape (N,)
            A, positive heats.
        dt : float
            Time step, s, > 0.
        weights : array_like, shape (n, N, 4)
            Of each temperature in each of n sums.

        Raises
        ------
        ValueError
            If the currents are no finite numbers, or dt is not positive.
        """
        i, weight = _checks.samples("currents", currents), np.asarray(weights, dtype=np.float64)
        levels, at = np.unique(i, return_inverse=True)
        steps = np.array([*self._transitions(tuple(levels.tolist()), _checks.positive("dt", dt)).values()])
        nodes, air = steps[:, :4, :4], 1.0 - steps[:, :4, :4].sum(axis=2) + steps[:, :4, 5]
        found, behind = np.empty(weight.shape[:2]), np.zeros((len(weight), 4))
        # From the last sample to the first: each temperature acts on all later ones.
        for k in range(i.size - 1, -1, -1):
            found[:, k] = behind @ air[at[k]]
            behind = behind @ nodes[at[k]] + weight[:, k]
        found[:, 0] += behind.sum(axis=1)
        return found

    def _transitions(self, currents: Sequence[float], dt: float) -> dict[float, Floats]:
        """Return the exact step by dt of the rises, a 1 and the air's absolute temperature, (6, 6), by current."""
        from scipy.linalg import expm

        systems = np.zeros((len(currents), 6, 6))
        for system, current in zip(systems, currents, strict=True):
            system[:4, :4] = self._matrix(current)
            system[:4, 4], system[:4, 5] = self._forcing(current)
        # All at once: a single call costs several times as much as its matrix.
        return dict(zip(currents, np.asarray(expm(dt * systems)), strict=True))

    def to_json(self) -> dict[str, Any]:
        """Return the network as a JSON object."""
        return {"type": "thermal-network", **asdict(self)}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> ThermalNetwork:
        """Return the network that `to_json` wrote.

        Raises ValueError if a key is missing or wrong.
        """
        return cls(**{each.name: _checks.json_field(document, each.name, "thermal network") for each in fields(cls)})


def _powers(step: Floats, start: Floats, count: int) -> Floats:
    """Return the state after 0 to `count` steps, shape (count + 1, states), by doubling."""
    path = np.empty((count + 1, start.size))
    path[0] = start
    known = 1
    while known <= count:
        more = min(known, count + 1 - known)
        path[known : known + more] = path[:more] @ step.T
        known += more
        if known <= count:
            step = step @ step
    return path


def _runs(currents: Floats, ambient: Floats) -> Iterator[tuple[int, int]]:
    """Yield first and stop of each stretch with constant current and air."""
    edges = np.flatnonzero((np.diff(currents) != 0.0) | (np.diff(ambient) != 0.0)) + 1
    bounds = [0, *edges.tolist(), currents.size]
    yield from pairwise(bounds)


def _nodes(name: str, values: ArrayLike) -> Floats:
    return _checks.counted(name, values, len(NODES), f"values ({', '.join(NODES)})")


def _ambients(ambient: ArrayLike, count: int) -> Floats:
    if np.ndim(ambient) == 0:
        return np.full(count, _air(ambient))
    air = _checks.samples("ambient", ambient)
    if air.size != count:
        raise ValueError(f"ambient: expected one value or {count}, one for each current, got {air.size}")
    _air(air.min())
    return air


def _air(ambient: ArrayLike) -> float:
    value = _checks.number("ambient", ambient)
    if value <= ABSOLUTE_ZERO:
        raise ValueError(f"ambient: expected °C above absolute zero, got {value}")
    return value
