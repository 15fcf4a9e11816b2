"""Parameters that no plant can have."""

import math

import pytest
from cases import cases

from sim_devices.plants.coiled_polymer import CoiledPolymerParameters
from sim_devices.plants.hybrid_parameters import HybridParameters
from sim_devices.plants.mckibben import McKibbenParameters
from sim_devices.plants.sma import SMAParameters
from sim_devices.plants.vo2 import VO2Parameters


@cases(
    ("kind", "wrong"),
    [
        (SMAParameters, {"grain_count": 0}),
        (SMAParameters, {"unoriented_share": 1.5}),
        (SMAParameters, {"orient_correlation": -1.1}),
        (SMAParameters, {"ambient_sd": -0.1}),
        (SMAParameters, {"martensite_modulus": 60e9}),
        (VO2Parameters, {"relay_count": 0}),
        (VO2Parameters, {"step": math.nan}),
        (VO2Parameters, {"loop_damping": 1.0}),
        (VO2Parameters, {"correlation": -1.0}),
        (VO2Parameters, {"minor_share": 1.5}),
        (VO2Parameters, {"wander_sd": -0.1}),
        (VO2Parameters, {"maximum_current": 7.0}),
        (VO2Parameters, {"ambient_temperature": math.nan}),
        (HybridParameters, {"step": 0.0}),
        (HybridParameters, {"convection": math.nan}),
        (HybridParameters, {"convection_share": 1.5}),
        (HybridParameters, {"ambient_sd": -0.1}),
        (HybridParameters, {"hysteresis_skew": 0.04}),
        (HybridParameters, {"creep_times": (1.0, 1.0, 100.0)}),
        (HybridParameters, {"creep_times": (1.0, 10.0)}),
        (HybridParameters, {"creep_times": (0.0, 1.0, 10.0)}),
        (HybridParameters, {"resonance_offset": 0.6}),
        (HybridParameters, {"resonance_decay": 1e4}),
        (HybridParameters, {"ambient_temperature": -300.0}),
        (HybridParameters, {"straight_temperature": -300.0}),
        (HybridParameters, {"maximum_current": 1.5}),
        (McKibbenParameters, {"friction_jam": 1.0}),
        (McKibbenParameters, {"rest_length": 70e-3}),
        (McKibbenParameters, {"rest_length": 140e-3}),
        (CoiledPolymerParameters, {"friction_load": 1.0}),
        (CoiledPolymerParameters, {"friction_coils": 1.0}),
        (CoiledPolymerParameters, {"hot_stiffness": 2e3}),
    ],
)
def test_wrong_parameters_are_refused(kind, wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        kind(**wrong)
