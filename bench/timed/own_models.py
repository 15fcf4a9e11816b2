"""The bench's own models with time, as entries of `bench.models`."""

from __future__ import annotations

from bench.hysteresis import ModelSpec
from bench.timed.hammerstein import Hammerstein
from bench.timed.hammerstein_fit import identify_hammerstein

HAMMERSTEIN = ModelSpec(
    "an operator, then lag or resonance, delay, creep and drift; needs the time of each row",
    Hammerstein,
    fit_in_time=identify_hammerstein,
)
