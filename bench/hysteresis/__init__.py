"""Hysteresis operators: immutable models, explicit memory, numbers only."""

from bench.hysteresis.bouc_wen import BoucWen
from bench.hysteresis.coverage import Coverage
from bench.hysteresis.density import Density
from bench.hysteresis.documents import Model
from bench.hysteresis.duhem import Duhem
from bench.hysteresis.generalized_prandtl_ishlinskii import Envelope, GeneralizedPrandtlIshlinskii
from bench.hysteresis.inverse import Inverse, Inversion, Policy
from bench.hysteresis.krasnoselskii_pokrovskii import KrasnoselskiiPokrovskii
from bench.hysteresis.maxwell_slip import MaxwellSlip
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
from bench.hysteresis.polynomial_plays import PolynomialPlays
from bench.hysteresis.prandtl_ishlinskii import DeadZones, PrandtlIshlinskii
from bench.hysteresis.preisach import Preisach, Segment, uniform_levels
from bench.hysteresis.reach import Reach
from bench.hysteresis.regressor import Regressor
from bench.hysteresis.reversible import (
    PolynomialTerm,
    QuadraticTerm,
    Reversible,
    ThermalExpansion,
    reversible_from_json,
)
from bench.hysteresis.timed import TimedModel
from bench.hysteresis.two_stage import Coupled, Linear, Summed, TwoStage
from bench.hysteresis.two_stage_state import TwoStageState

__all__ = [
    "BoucWen",
    "Coupled",
    "Coverage",
    "DeadZones",
    "Density",
    "Duhem",
    "Envelope",
    "GeneralizedPrandtlIshlinskii",
    "Inverse",
    "Inversion",
    "KrasnoselskiiPokrovskii",
    "Linear",
    "MaxwellSlip",
    "MemoryCurve",
    "Model",
    "ModelSpec",
    "Operator",
    "Policy",
    "Polynomial",
    "PolynomialPlays",
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
