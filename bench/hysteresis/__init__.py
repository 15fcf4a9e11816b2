"""Hysteresis operators: immutable models, explicit memory, numbers only."""

from bench.hysteresis.density import Density
from bench.hysteresis.memory import MemoryCurve
from bench.hysteresis.operator import Operator, operator_from_json
from bench.hysteresis.polynomial import Polynomial
from bench.hysteresis.prandtl_ishlinskii import DeadZones, PrandtlIshlinskii
from bench.hysteresis.preisach import Preisach, Segment, uniform_levels
from bench.hysteresis.regressor import Regressor
from bench.hysteresis.reversible import (
    PolynomialTerm,
    QuadraticTerm,
    Reversible,
    ThermalExpansion,
    reversible_from_json,
)
from bench.hysteresis.two_stage import Coupled, Linear, Summed, TwoStage, TwoStageState, coupled_from_json

__all__ = [
    "Coupled",
    "DeadZones",
    "Density",
    "Linear",
    "MemoryCurve",
    "Operator",
    "Polynomial",
    "PolynomialTerm",
    "PrandtlIshlinskii",
    "Preisach",
    "QuadraticTerm",
    "Regressor",
    "Reversible",
    "Segment",
    "Summed",
    "ThermalExpansion",
    "TwoStage",
    "TwoStageState",
    "coupled_from_json",
    "operator_from_json",
    "reversible_from_json",
    "uniform_levels",
]
