"""Identification: from measured inputs and outputs to a model. Numbers only: no device and no clock.

`identify` fits a model by name, `fit` solves the constrained least squares beneath, and `choose` compares models by
held-out errors. Design of experiments, prediction bands and model files are here as well.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
