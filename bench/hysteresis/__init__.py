"""Hysteresis operators: immutable models, explicit memory, numbers only."""

from bench.hysteresis.coverage import Coverage
from bench.hysteresis.density import Density
from bench.hysteresis.documents import Model
from bench.hysteresis.inverse import Inverse, Inversion, Policy, Reach
from bench.hysteresis.memory import MemoryCurve
from bench.hysteresis.models import (
    ModelSpec,
    find_model,
    identifiable_models,
    model_class,
    model_from_json,
    timed_models,
)
from bench.hysteresis.operator import Operator, Shape, operator_from_json
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
from bench.hysteresis.timed import TimedModel
from bench.hysteresis.two_stage import Coupled, Linear, Summed, TwoStage, TwoStageState

__all__ = [
    "Coupled",
    "Coverage",
    "DeadZones",
    "Density",
    "Inverse",
    "Inversion",
    "Linear",
    "MemoryCurve",
    "Model",
    "ModelSpec",
    "Operator",
    "Policy",
    "Polynomial",
    "PolynomialTerm",
    "PrandtlIshlinskii",
    "Preisach",
    "QuadraticTerm",
    "Reach",
    "Regressor",
    "Reversible",
    "Segment",
    "Shape",
    "Summed",
    "ThermalExpansion",
    "TimedModel",
    "TwoStage",
    "TwoStageState",
    "find_model",
    "identifiable_models",
    "model_class",
    "model_from_json",
    "operator_from_json",
    "reversible_from_json",
    "timed_models",
    "uniform_levels",
]
