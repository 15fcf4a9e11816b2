"""Identification of hysteresis operators: excitation, constrained least squares, error measures."""

from bench.hysteresis.regressor import Regressor
from bench.identification.design import (
    Assessment,
    assess,
    covering_sequence,
    first_order_reversals,
    laboratory_time,
)
from bench.identification.excitation import damped_oscillation, ramps, random_validation
from bench.identification.identify import MODELS, Identification, Initial, ModelSpec, identify
from bench.identification.inspection import Coverage, check_data, measure_coverage
from bench.identification.least_squares import Certificate, Fit, fit, fit_minimum_norm
from bench.identification.measures import Comparison, Errors, compare, measure_errors
from bench.identification.validation import CrossValidation, Trial, cross_validate

__all__ = [
    "MODELS",
    "Assessment",
    "Certificate",
    "Comparison",
    "Coverage",
    "CrossValidation",
    "Errors",
    "Fit",
    "Identification",
    "Initial",
    "ModelSpec",
    "Regressor",
    "Trial",
    "assess",
    "check_data",
    "compare",
    "covering_sequence",
    "cross_validate",
    "damped_oscillation",
    "first_order_reversals",
    "fit",
    "fit_minimum_norm",
    "identify",
    "laboratory_time",
    "measure_coverage",
    "measure_errors",
    "ramps",
    "random_validation",
]
