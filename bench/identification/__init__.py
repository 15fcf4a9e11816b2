"""Identification of hysteresis operators: excitation, constrained least squares, error measures."""

from bench.hysteresis.regressor import Regressor
from bench.identification.by_name import Identification, Initial, identify
from bench.identification.cross_validation import CrossValidation, Trial, cross_validate
from bench.identification.design import (
    Assessment,
    assess,
    covering_sequence,
    first_order_reversals,
    laboratory_time,
)
from bench.identification.excitation import damped_oscillation, ramps, random_validation
from bench.identification.inspection import check_data
from bench.identification.least_squares import Certificate, Fit, fit, fit_minimum_norm
from bench.identification.measures import Comparison, Errors, compare, measure_errors
from bench.identification.orientation import Orientation
from bench.identification.regularization import Regularization, choose_regularization
from bench.identification.two_stage import (
    CoupledIdentification,
    FirstStage,
    Series,
    identify_first_stage,
    identify_linear,
    identify_second_stage,
    identify_summed,
    identify_two_stage,
    measure_series,
    predict_series,
    voltage_steps,
)

__all__ = [
    "Assessment",
    "Certificate",
    "Comparison",
    "CoupledIdentification",
    "CrossValidation",
    "Errors",
    "FirstStage",
    "Fit",
    "Identification",
    "Initial",
    "Orientation",
    "Regressor",
    "Regularization",
    "Series",
    "Trial",
    "assess",
    "check_data",
    "choose_regularization",
    "compare",
    "covering_sequence",
    "cross_validate",
    "damped_oscillation",
    "first_order_reversals",
    "fit",
    "fit_minimum_norm",
    "identify",
    "identify_first_stage",
    "identify_linear",
    "identify_second_stage",
    "identify_summed",
    "identify_two_stage",
    "laboratory_time",
    "measure_errors",
    "measure_series",
    "predict_series",
    "ramps",
    "random_validation",
    "voltage_steps",
]
