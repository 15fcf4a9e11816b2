"""Models with time, and their identification."""

from bench.timed.by_name import identify_in_time
from bench.timed.hammerstein import Hammerstein, HammersteinState
from bench.timed.linear_parts import FilterState, LinearPart, logarithmic_creep

__all__ = [
    "FilterState",
    "Hammerstein",
    "HammersteinState",
    "LinearPart",
    "identify_in_time",
    "logarithmic_creep",
]
