"""What data sheets state of the sensors in the packaged laboratories.

Lags and latencies are 0: those of PSD (rise time 3 µs), displacement and position sensor are shorter than the time
between two samples of any loop; that of a thermistor is part of the heat capacity at its place in the plant; the
filter of the load cell is that of its amplifier, `sim_devices.instruments.flintec_dad141`.
"""

from __future__ import annotations

from sim_devices.transducers.imperfect import SensorErrors
from sim_devices.transducers.specimens import DataSheet

PSD = DataSheet((-100e-6, 100e-6), SensorErrors(nonlinearity=0.0027), gain_tolerance=5e-3, offset_tolerance=0.1e-6)
"""In deflection of the tip, m.

Nonlinearity: Hamamatsu S3931/S3932/S3270, "Electrical and optical characteristics": position detection error of the
S3270 ±100 µm typical (±400 µm at most) on 37 mm. Gain: the lever from beam to detector, 14 mm, measured with a
calliper to 0.07 mm. Offset: the spot is set to zero on a display of 10 mV, at 0.1 V/µm.
"""

DISPLACEMENT = DataSheet(
    (-200e-6, 200e-6), SensorErrors(nonlinearity=5e-4), gain_tolerance=1e-3, offset_tolerance=80e-9
)
"""In m.

Class of laser displacement sensors of this range with steps of 10 nm. Nonlinearity: ±0.05 % of full scale. Offset:
0.01 % of full scale for a kelvin, within 2 K after it was set to zero. Gain: its axis is within 2.5° of the
direction of the motion, cos 2.5° = 0.999.
"""

THERMISTOR = DataSheet((-40.0, 80.0), SensorErrors(), offset_tolerance=0.1)
"""In °C and K. Class of interchangeable precision thermistors of 10 kΩ: ±0.1 °C between 0 and 70 °C."""

GONIOMETER = DataSheet((-45.0, 45.0), SensorErrors(), gain_tolerance=2.2e-4, offset_tolerance=0.01)
"""The true angle of a mirror where its goniometer shows one, in °.

Class of goniometer stages with a scale of 0.01°. Offset: the mirror is parallel to the chip within one division.
Gain: one division over 45°.
"""

SETTING = 0.005
"""Largest error of one setting of the goniometer, °: half a division of its scale."""

MICROMETER = DataSheet((-20e-3, 20e-3), SensorErrors(), gain_tolerance=1e-4, offset_tolerance=2e-6)
"""The true place of a detector where the micrometer of its stage shows one, in m.

Class of micrometer heads of ±2 µm (25 mm); gain of the same size over the stroke.
"""

WEIGHTS = DataSheet((0.0, 20.0), SensorErrors(), gain_tolerance=5e-5)
"""The true weight where a set of weights states one, in N. Class M1 (OIML R 111-1, table 1: 50 mg in 1 kg)."""

GAUGE_BLOCKS = DataSheet((-17.5e-3, 17.5e-3), SensorErrors(), offset_tolerance=2e-6)
"""The true place of the magnet where gauge blocks state one, in m.

Blocks of grade 2 (ISO 3650) are true to 0.5 µm; the surface that they stand on is set to within 2 µm.
"""

LOAD_CELL = DataSheet((0.0, 20.0), SensorErrors(nonlinearity=2e-4), gain_tolerance=1.6e-4, offset_tolerance=1.7e-3)
"""In N.

Class C3 of OIML R 60 (3000 intervals). Nonlinearity: combined error 0.02 % of full scale, as data sheets of that
class state. Gain: adjusted with weights of class M2 (OIML R 111-1, table 1: 160 mg in 1 kg). Offset: zero is set to
a quarter of an interval (OIML R 76-1, 4.5.2).
"""

POSITION = DataSheet((0.0, 35e-3), SensorErrors(nonlinearity=4e-3), gain_tolerance=2e-3, offset_tolerance=20e-6)
"""In m along its stroke.

Class of magnetoresistive linear sensors such as the Honeywell SPS-L035-LATS. Nonlinearity: ±0.4 % of full scale.
Gain: half of that. Offset: it is set to zero to half of its steps of 0.04 mm.
"""
