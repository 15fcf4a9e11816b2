"""The thermo-piezoelectric cantilever as built: geometry, materials, and the model parameters derived from them.

Source: Rakotondrabe and Ivan, "Development and dynamic modeling of a new hybrid thermo-piezoelectric
micro-actuator", IEEE Transactions on Robotics 26(6), 2010; here "Rakotondrabe and Ivan 2010".
"""

from __future__ import annotations

from dataclasses import dataclass, field

from rigs.hybrid.network import ThermalNetwork, check_fields


@dataclass(frozen=True)
class Geometry:
    """Lengths in metres, table I of Rakotondrabe and Ivan 2010.

    Raises
    ------
    ValueError
        If a length is not a positive number, or the cooler does not fit on the block.
    """

    block_length: float = 25e-3
    block_width: float = 38e-3
    block_thickness: float = 20e-3
    """L_s, a_s, b_s of the cooling block."""
    tec_length: float = 8e-3
    tec_width: float = 5e-3
    """Sides of the thermoelectric cooler; S_p is their product."""
    glue_thickness: float = 0.1e-3
    """l_c between cooler and block (section III-A)."""
    beam_length: float = 15e-3
    beam_width: float = 2e-3
    """L and l of the cantilever."""
    piezo_thickness: float = 0.2e-3
    copper_thickness: float = 0.1e-3
    """e_pzt and e_cop."""

    def __post_init__(self) -> None:
        check_fields(self)
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

    Raises
    ------
    ValueError
        If a property is not a number or, but for expansions and d31, not positive.
    """

    air_transfer: float = 30.0
    """Heat transfer coefficient to the air, W/(m² K)."""
    block_density: float = 2701.0
    block_heat: float = 902.0
    block_conductivity: float = 222.0
    """Density (kg/m³), specific heat (J/(kg K)) and conductivity (W/(m K)). The table's "alumina" has
    the numbers of aluminium, which the text names."""
    copper_density: float = 8960.0
    copper_heat: float = 386.0
    copper_conductivity: float = 381.5
    """The table prints 7135 kg/m³, the density of zinc; copper's is 8960."""
    copper_expansion: float = 17e-6
    copper_compliance: float = 9.1e-12
    """Thermal expansion (1/K) and compliance (m²/N)."""
    piezo_density: float = 7500.0
    piezo_heat: float = 420.0
    piezo_conductivity: float = 1.4
    """The table prints 138 W/(m K); PZT-5H conducts about 1.4."""
    piezo_expansion: float = 3.3e-6
    piezo_compliance: float = 15e-12
    piezo_coefficient: float = -100e-12
    """Thermal expansion (1/K), compliance (m²/N) and d31 (m/V). The table's last row, "alpha_cop 3.3e-3",
    is PZT's 3.3e-6 1/K."""
    glue_conductivity: float = 1.0
    """Conductivity, W/(m K). The paper takes the block's; a filled epoxy has about 1."""

    def __post_init__(self) -> None:
        check_fields(self, "copper_expansion", "piezo_expansion", "piezo_coefficient")


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
        Heat capacity at the cantilever's face, J/K: plate, clamp, thermistor. The paper has none; without it the
        bandwidth is 90 mHz, and 0.5 gives the 4 mHz of its table III.

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
        check_fields(self)


@dataclass(frozen=True)
class Design:
    """The hybrid actuator as built.

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

        Rakotondrabe and Ivan 2010, eq. 10, with e_p for h_p and the missing factor e_p: as printed it is in 1/K.
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
