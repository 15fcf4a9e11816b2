"""The thermal network of the thermo-piezoelectric cantilever: from geometry and materials, or fitted to steps.

Source: Rakotondrabe and Ivan, "Development and dynamic modeling of a new hybrid thermo-piezoelectric
micro-actuator", IEEE Transactions on Robotics 26(6), 2010; here "Rakotondrabe and Ivan 2010". A cantilever of PZT
on copper is clamped to one face of a thermoelectric cooler; a block of aluminium is glued to the other.

The network is what Kirchhoff's laws give for the paper's Fig. 10, in absolute temperature and with the Peltier
heat of each face taken at that face's own temperature. The printed equations differ from it in these points:

- c_sf of (15) has one R_c too many: with it, the block rests 40 K below the room without any current.
- One Peltier source, alpha T_act0 i, serves both faces in Fig. 10: the electrical power alpha (T_h - T_c) i is lost.
- Misprints: a sign in (2), (R_vs + 1)/R_s in (5), T_so twice in (6), "+ 1" missing in (7), R_c for R_act in (8).
- R_vsf and R_va2 carry a factor 2 that belongs to surfaces shared by two nodes; an end face has one.
- (10) has h_p for e_p, and its f_s lacks the factor e_p: as printed it is in 1/K.

The sign of the current is the bench's: **positive current heats the cantilever**. The paper's positive current
pumps heat away from it; i here is -i there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from bench.hysteresis import _checks
from bench.hysteresis._checks import Floats
from bench.identification.measures import Errors, measure_errors

Node: TypeAlias = Literal["block end", "block front", "base", "tip"]

NODES: tuple[Node, ...] = ("block end", "block front", "base", "tip")
"""The nodes with a heat capacity, in the order of every array of temperatures.

The insulated end and the front of the block (the paper's T_so, T_sf), the clamped base of the cantilever, which
is also the cooler's face (T_act0), and its tip (T_actL).
"""

FREE_PARAMETERS: tuple[str, ...] = (
    "seebeck",
    "electrical_resistance",
    "tec_resistance",
    "tec_capacity",
    "beam_resistance",
    "beam_side_resistance",
    "block_side_resistance",
)
"""What `identify_network` fits unless told otherwise."""

ABSOLUTE_ZERO = -273.15
_BLOCK_END, _BLOCK_FRONT, _BASE, _TIP = range(4)

# Farthest that a parameter may move from its start, as logarithm: a factor of 20.
_REACH = 3.0
# A parameter of greater relative standard uncertainty counts as not identified.
_UNKNOWN = 0.25
# Nor are any, if the columns of the scaled Jacobian are this close to dependent.
_DEPENDENT = 1e7


def _check_fields(settings: Any, *free: str) -> None:  # noqa: ANN401 - any of the dataclasses below
    """Check that every field is a positive number; those named `free` may have either sign."""
    for each in fields(settings):
        value = _checks.number(each.name, getattr(settings, each.name))
        if each.name not in free and not value > 0.0:
            raise ValueError(f"{each.name}: expected a positive number, got {value}")
        object.__setattr__(settings, each.name, value)


@dataclass(frozen=True)
class Geometry:
    """Lengths in metres, table I of Rakotondrabe and Ivan 2010.

    Parameters
    ----------
    block_length, block_width, block_thickness : float
        L_s, a_s, b_s of the cooling block.
    tec_length, tec_width : float
        Sides of the thermoelectric cooler; S_p is their product.
    glue_thickness : float
        l_c between cooler and block (section III-A).
    beam_length, beam_width : float
        L and l of the cantilever.
    piezo_thickness, copper_thickness : float
        e_pzt and e_cop.

    Raises
    ------
    ValueError
        If a length is not a positive number, or the cooler does not fit on the block.
    """

    block_length: float = 25e-3
    block_width: float = 38e-3
    block_thickness: float = 20e-3
    tec_length: float = 8e-3
    tec_width: float = 5e-3
    glue_thickness: float = 0.1e-3
    beam_length: float = 15e-3
    beam_width: float = 2e-3
    piezo_thickness: float = 0.2e-3
    copper_thickness: float = 0.1e-3

    def __post_init__(self) -> None:
        _check_fields(self)
        if self.tec_area >= self.block_section:
            raise ValueError(
                f"tec_length, tec_width: the cooler ({1e6 * self.tec_area:g} mm²) does not fit on the front of the "
                f"block ({1e6 * self.block_section:g} mm²)"
            )

    @property
    def tec_area(self) -> float:
        """S_p, m²."""
        return self.tec_length * self.tec_width

    @property
    def block_section(self) -> float:
        """S_s, m²."""
        return self.block_width * self.block_thickness

    @property
    def block_perimeter(self) -> float:
        """P_s, m: around the section, 2 (a_s + b_s); the paper's 2 (e_s + l_s) names other sides."""
        return 2.0 * (self.block_width + self.block_thickness)

    @property
    def beam_thickness(self) -> float:
        """Thickness e of the cantilever, m."""
        return self.piezo_thickness + self.copper_thickness

    @property
    def beam_perimeter(self) -> float:
        """P_act, m."""
        return 2.0 * (self.beam_width + self.beam_thickness)


@dataclass(frozen=True)
class Materials:
    """Properties of the materials, table II of Rakotondrabe and Ivan 2010.

    Parameters
    ----------
    air_transfer : float
        Heat transfer coefficient to the air, W/(m² K).
    block_density, block_heat, block_conductivity : float
        kg/m³, J/(kg K), W/(m K). The table's "alumina" has the numbers of aluminium, which the text names.
    copper_density, copper_heat, copper_conductivity : float
        The table prints 7135 kg/m³, the density of zinc; copper's is 8960.
    copper_expansion, copper_compliance : float
        1/K and m²/N.
    piezo_density, piezo_heat, piezo_conductivity : float
        The table prints 138 W/(m K); PZT-5H conducts about 1.4.
    piezo_expansion, piezo_compliance, piezo_coefficient : float
        1/K, m²/N and d31 in m/V. The table's last row, "alpha_cop 3.3e-3", is PZT's 3.3e-6 1/K.
    glue_conductivity : float
        W/(m K). The paper takes the block's; a filled epoxy has about 1.

    Raises
    ------
    ValueError
        If a property is not a number or, but for expansions and d31, not positive.
    """

    air_transfer: float = 30.0
    block_density: float = 2701.0
    block_heat: float = 902.0
    block_conductivity: float = 222.0
    copper_density: float = 8960.0
    copper_heat: float = 386.0
    copper_conductivity: float = 381.5
    copper_expansion: float = 17e-6
    copper_compliance: float = 9.1e-12
    piezo_density: float = 7500.0
    piezo_heat: float = 420.0
    piezo_conductivity: float = 1.4
    piezo_expansion: float = 3.3e-6
    piezo_compliance: float = 15e-12
    piezo_coefficient: float = -100e-12
    glue_conductivity: float = 1.0

    def __post_init__(self) -> None:
        _check_fields(self, "copper_expansion", "piezo_expansion", "piezo_coefficient")


@dataclass(frozen=True)
class Tec:
    """The thermoelectric cooler, table II of Rakotondrabe and Ivan 2010.

    Parameters
    ----------
    seebeck : float
        alpha, V/K: the table's "Peltier coefficient" is the Seebeck coefficient, and goes with absolute temperature.
    conductance : float
        k_p, W/K; the table calls it a thermal capacity in J/(kg K).
    electrical_resistance : float
        R_p, Ohm. Missing from the table; 4.8 gives a figure of merit of 2.5e-3 1/K, usual for bismuth telluride.
    capacity : float
        Heat capacity at the cantilever's face, J/K: plate, clamp, thermistor. The paper has none, and without it
        the bandwidth is 90 mHz; 0.5 gives the 4 mHz of its table III.

    Raises
    ------
    ValueError
        If a property is not a positive number.
    """

    seebeck: float = 12e-3
    conductance: float = 12e-3
    electrical_resistance: float = 4.8
    capacity: float = 0.50

    def __post_init__(self) -> None:
        _check_fields(self)


@dataclass(frozen=True)
class Design:
    """The hybrid actuator as it is built, and what follows from that.

    Parameters
    ----------
    geometry : Geometry
    materials : Materials
    tec : Tec
    """

    geometry: Geometry = field(default_factory=Geometry)
    materials: Materials = field(default_factory=Materials)
    tec: Tec = field(default_factory=Tec)

    @property
    def thermal_sensitivity(self) -> float:
        """f_s, deflection of the tip per kelvin, m/K: negative, as copper expands more than PZT.

        Rakotondrabe and Ivan 2010, eq. 10, with the factor e_p that the printed one lacks.
        """
        m = self.materials
        return (
            3.0
            * self._bending
            * self.geometry.piezo_thickness
            * (m.piezo_expansion - m.copper_expansion)
            * self.geometry.beam_length**2
        )

    @property
    def piezo_sensitivity(self) -> float:
        """d_p, deflection of the tip per volt, m/V (Rakotondrabe and Ivan 2010, eq. 10)."""
        return -3.0 * self._bending * self.materials.piezo_coefficient * self.geometry.beam_length**2

    @property
    def _bending(self) -> float:
        """A B / K of Rakotondrabe and Ivan 2010, eq. 10."""
        s_p, s_c = self.materials.piezo_compliance, self.materials.copper_compliance
        e_p, e_c = self.geometry.piezo_thickness, self.geometry.copper_thickness
        a = s_c * s_p * (s_c * e_p + s_p * e_c)
        b = e_c * (e_p + e_c) / (s_c * e_p + s_p * e_c)
        k = (
            s_c**2 * e_p**4
            + s_p**2 * e_c**4
            + 4.0 * s_c * s_p * e_c * e_p**3
            + 4.0 * s_c * s_p * e_p * e_c**3
            + 6.0 * s_c * s_p * e_c**2 * e_p**2
        )
        return a * b / k

    def network(self) -> ThermalNetwork:
        """Return the thermal network (Rakotondrabe and Ivan 2010, section III)."""
        g, m = self.geometry, self.materials
        piezo = g.piezo_thickness * g.beam_width
        copper = g.copper_thickness * g.beam_width
        conductance = (m.piezo_conductivity * piezo + m.copper_conductivity * copper) / g.beam_length
        heat = m.piezo_density * m.piezo_heat * piezo + m.copper_density * m.copper_heat * copper
        return ThermalNetwork(
            block_capacity=0.5 * m.block_density * m.block_heat * g.block_section * g.block_length,
            block_resistance=g.block_length / (m.block_conductivity * g.block_section),
            block_side_resistance=2.0 / (m.air_transfer * g.block_perimeter * g.block_length),
            block_front_resistance=1.0 / (m.air_transfer * (g.block_section - g.tec_area)),
            glue_resistance=g.glue_thickness / (m.glue_conductivity * g.tec_area),
            seebeck=self.tec.seebeck,
            electrical_resistance=self.tec.electrical_resistance,
            tec_resistance=1.0 / self.tec.conductance,
            tec_capacity=self.tec.capacity,
            beam_capacity=0.5 * heat * g.beam_length,
            beam_resistance=1.0 / conductance,
            beam_side_resistance=2.0 / (m.air_transfer * g.beam_perimeter * g.beam_length),
            beam_end_resistance=1.0 / (m.air_transfer * g.beam_thickness * g.beam_width),
        )


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
        _check_fields(self)

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
        """Return how fast each temperature changes, K/s, shape (4,).

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
        """Return what the current does at rest: rates by Joule heat, K/s, and by Peltier heat, per kelvin of air."""
        joule, peltier = 0.5 * self.electrical_resistance * current**2, self.seebeck * current
        back = 1.0 / self._node_conductance(current)
        both = np.zeros((2, 4))
        both[:, _BLOCK_FRONT] = np.array([joule, -peltier]) * back / self.glue_resistance
        both[:, _BASE] = np.array([joule, -peltier]) * back / self.tec_resistance + (joule, peltier)
        both /= self.capacities
        return both[0], both[1]

    def _node_conductance(self, current: float) -> float:
        """Return what the massless node sees, 1/R_c + 1/R_th + alpha i, W/K."""
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
        # The massless node is a star of two branches; the Peltier heat it takes is proportional to its temperature.
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
        """Return how far above the air each node settles under a constant current, K, shape (4,).

        One linear solve: no iteration, and exactly 0 without current.

        Raises
        ------
        ValueError
            If a number is not finite or the current heats without end.
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

    def heat_to_air(self, temperatures: ArrayLike, ambient: float) -> float:
        """Return the heat flow from all nodes (°C, shape (4,)) to the air, W."""
        rises = _nodes("temperatures", temperatures) - _air(ambient)
        return float(self.air_conductances @ rises)

    def electrical_power(self, temperatures: ArrayLike, current: float) -> float:
        """Return R_p i² + alpha (T_0 - T_x) i, what the cooler takes from its supply, W."""
        nodes, i = _nodes("temperatures", temperatures), _checks.number("current", current)
        difference = nodes[_BASE] - ABSOLUTE_ZERO - self._back_face(nodes, i)
        return float(self.electrical_resistance * i**2 + self.seebeck * difference * i)

    def linearise(self, current: float = 0.0, ambient: float = 22.0) -> tuple[Floats, Floats]:
        """Return A (shape (4, 4), 1/s) and B (shape (4,), K/(A s)) of small changes about a steady state.

        Changes of the temperatures follow A @ temperatures + B * current.

        Raises
        ------
        ValueError
            As `steady_rises`.
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

        The first such frequency, relative to constant changes of the current. That of the tip is also that of
        the thermal deflection, which follows the tip's temperature at once (Rakotondrabe and Ivan 2010, eq. 11).

        Parameters
        ----------
        node : {"block end", "block front", "base", "tip"}
            Where the temperature is taken.
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

        Returns
        -------
        ndarray, shape (N, 4)
            °C; row k is at time k dt, before current k has acted.

        Raises
        ------
        ValueError
            If a shape is wrong, a number is not finite, or dt is not positive.
        """
        i = _checks.samples("currents", currents)
        step = _positive("dt", dt)
        air = _ambients(ambient, i.size)
        result = np.empty((i.size, 4))
        now = np.full(4, air[0]) if start is None else _nodes("start", start)
        for first, stop in _runs(i, air):
            transition = _transition(self, float(i[first]), step)
            # At rest without current the rises stay exactly 0.
            state = np.concatenate([now - air[first], [1.0, air[first] - ABSOLUTE_ZERO]])
            path = _powers(transition, state, stop - first)[:, :4] + air[first]
            result[first:stop] = path[:-1]
            now = path[-1]
        return result

    def to_json(self) -> dict[str, Any]:
        """Return the network as a JSON object."""
        return {"type": "thermal-network", **asdict(self)}

    @classmethod
    def from_json(cls, document: Mapping[str, Any]) -> ThermalNetwork:
        """Return the network that `to_json` wrote.

        Raises
        ------
        ValueError
            If a key is missing or wrong.
        """
        return cls(**{each.name: _checks.json_field(document, each.name, "thermal network") for each in fields(cls)})


@lru_cache(maxsize=4096)
def _transition(network: ThermalNetwork, current: float, dt: float) -> Floats:
    """Return the exact step by dt of the rises, a 1 and the absolute temperature of the air, shape (6, 6)."""
    from scipy.linalg import expm

    system = np.zeros((6, 6))
    system[:4, :4] = network._matrix(current)
    system[:4, 4], system[:4, 5] = network._forcing(current)
    return _checks.frozen(np.asarray(expm(dt * system)))


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
    """Yield first and stop of each stretch over which nothing changes."""
    edges = np.flatnonzero((np.diff(currents) != 0.0) | (np.diff(ambient) != 0.0)) + 1
    bounds = [0, *edges.tolist(), currents.size]
    yield from pairwise(bounds)


def _positive(name: str, value: float) -> float:
    number = _checks.number(name, value)
    if not number > 0.0:
        raise ValueError(f"{name}: expected a positive number, got {number}")
    return number


def _nodes(name: str, values: ArrayLike) -> Floats:
    array = _checks.samples(name, values)
    if array.size != len(NODES):
        raise ValueError(f"{name}: expected {len(NODES)} values ({', '.join(NODES)}), got {array.size}")
    return array


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
    evaluations : int
        Number of simulations, those for derivatives not counted.
    """

    network: ThermalNetwork
    ambient: float
    uncertainties: Mapping[str, float]
    residuals: Floats
    base: Errors
    tip: Errors
    condition: float
    gradient: float
    evaluations: int


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
    which all nodes have at the first sample. Temperatures tell heat capacities, conductances, alpha and R_p up to
    one common factor only; what is held sets it. By default that is what is known best, the heat capacity of the
    block, a solid piece of metal. Held with it are the capacity of the cantilever, and what two thermistors
    cannot tell from the rest: the resistances of glue, along the block and of its front (in parallel with its
    sides), and that of the cantilever's end face (1.7 % of its loss). For the others a series needs steps of both
    signs, since alpha is what is odd in the current and R_p what is even, held for as long as the block takes
    to warm (about 7 min), and sampled within the lag of the tip (about 2 s). The block is seen by its slow share of
    a few kelvin: a room that wanders meanwhile shifts the common factor by more than the uncertainties say, while
    temperatures and bandwidth stay right.

    Parameters
    ----------
    currents : array_like, shape (N,)
        A, positive heats; number k is held from sample k to sample k + 1.
    base, tip : array_like, shape (N,)
        Temperatures at the clamped base and at the tip, °C; the first while everything is at rest.
    dt : float
        Sampling time, s.
    start : ThermalNetwork or None
        Network from which the search starts and which provides what is held; default that of `Design`.
    free : sequence of str
        Names of the parameters to fit.

    Raises
    ------
    ValueError
        If a sequence is wrong, a name unknown, or if the data do not identify the parameters: the Jacobian is
        nearly rank deficient, a relative standard uncertainty exceeds 25 %, or a parameter ends 20 times away
        from its start.
    """
    from scipy.optimize import least_squares

    i = _checks.samples("currents", currents)
    measured = []
    for name, values in (("base", base), ("tip", tip)):
        measured.append(_checks.samples(name, values))
        if measured[-1].size != i.size:
            raise ValueError(f"{name}: expected {i.size} values, one for each current, got {measured[-1].size}")
    step = _positive("dt", dt)
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
        return np.asarray((target - simulated[:, [_BASE, _TIP]]).ravel())

    first = np.append(np.zeros(len(free)), target[0].mean())
    reach = np.append(np.full(len(free), _REACH), np.inf)
    found = least_squares(
        residuals, first, bounds=(first - reach, first + reach), x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12
    )
    names = (*free, "ambient")
    jacobian: Floats = np.asarray(found.jac)
    norms = np.linalg.norm(jacobian, axis=0)
    if (norms == 0.0).any():
        lost = [n for n, norm in zip(names, norms, strict=True) if norm == 0.0]
        raise ValueError(
            f"currents: the temperatures do not depend on {', '.join(lost)}; expected steps of the current"
        )
    scaled = jacobian / norms
    condition = float(np.linalg.cond(scaled))
    if condition > _DEPENDENT:
        raise ValueError(
            f"currents: the data do not tell {', '.join(free)} apart (condition {condition:.1e}); hold one of "
            "them, or measure longer and with steps of both signs"
        )
    fit = np.asarray(found.fun)
    variance = float(fit @ fit) / (fit.size - len(names))
    deviations = np.sqrt(variance * np.diag(np.linalg.inv(scaled.T @ scaled))) / norms
    poor = [
        f"{n} (± {100.0 * deviation:.0f} %)"
        for n, deviation, x in zip(free, deviations, found.x, strict=False)
        if deviation > _UNKNOWN or abs(x) > 0.999 * _REACH
    ]
    if poor:
        raise ValueError(
            f"currents: the data do not identify {', '.join(poor)}; hold it, or measure longer and "
            "with steps of both signs"
        )
    fitted = network(found.x[:-1])
    rows = fit.reshape(-1, 2)
    uncertainties = {n: float(getattr(fitted, n) * s) for n, s in zip(free, deviations, strict=False)}
    errors = [measure_errors(target[:, k], target[:, k] - rows[:, k]) for k in range(2)]
    length = float(np.linalg.norm(fit))
    return NetworkIdentification(
        network=fitted,
        ambient=float(found.x[-1]),
        uncertainties={**uncertainties, "ambient": float(deviations[-1])},
        residuals=rows,
        base=errors[0],
        tip=errors[1],
        condition=condition,
        gradient=float(np.abs(scaled.T @ fit).max() / length) if length else 0.0,
        evaluations=int(found.nfev),
    )
