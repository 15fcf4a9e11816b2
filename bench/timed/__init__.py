"""Models with time, and their identification."""

from bench.timed.by_name import identify_in_time
from bench.timed.hammerstein import Hammerstein, HammersteinState
from bench.timed.linear_parts import FilterState, LinearPart, logarithmic_creep
from bench.timed.oscillator import BoucWenOscillator, OscillatorState
from bench.timed.preisach_oscillator import PreisachOscillator, PreisachOscillatorState
from bench.timed.rate_dependent_plays import PlaysState, RateDependentPlays

__all__ = [
    "BoucWenOscillator",
    "FilterState",
    "Hammerstein",
    "HammersteinState",
    "LinearPart",
    "OscillatorState",
    "PlaysState",
    "PreisachOscillator",
    "PreisachOscillatorState",
    "RateDependentPlays",
    "identify_in_time",
    "logarithmic_creep",
]
