"""Hysteresis models: immutable values with an explicit memory. Numbers in, numbers out.

Operators evaluate a sequence of inputs, step a state, give the regressor of their coefficients and have an inverse.
Models with time (`bench.models.dynamic`) put an operator in a chain with delay, lag, creep and drift.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
