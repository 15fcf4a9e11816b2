"""Identification of hysteresis operators: excitation, constrained least squares, error measures."""

from bench.hysteresis.regressor import Regressor
from bench.identification.excitation import damped_oscillation, ramps, random_validation
from bench.identification.identify import MODELS, Identification, ModelSpec, identify
from bench.identification.least_squares import Certificate, Fit, fit, fit_minimum_norm
from bench.identification.measures import Errors, measure_errors

__all__ = [
    "MODELS",
    "Certificate",
    "Errors",
    "Fit",
    "Identification",
    "ModelSpec",
    "Regressor",
    "damped_oscillation",
    "fit",
    "fit_minimum_norm",
    "identify",
    "measure_errors",
    "ramps",
    "random_validation",
]
