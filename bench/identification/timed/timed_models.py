"""The bench's own models with time, as entries of `bench.models`."""

from __future__ import annotations

from bench.identification.timed.hammerstein_fit import identify_hammerstein
from bench.identification.timed.oscillator_fit import identify_bouc_wen_oscillator
from bench.identification.timed.preisach_oscillator_fit import identify_preisach_oscillator
from bench.identification.timed.rate_dependent_plays_fit import identify_rate_dependent_plays
from bench.models import BoucWenOscillator, Hammerstein, ModelSpec, PreisachOscillator, RateDependentPlays

HAMMERSTEIN = ModelSpec(
    "an operator, then lag or resonance, delay, creep and drift; needs the time of each row",
    Hammerstein,
    fit_in_time=identify_hammerstein,
)
BOUC_WEN_OSCILLATOR = ModelSpec(
    "a mass on a spring, a damper and a Bouc-Wen force; needs the time of each row",
    BoucWenOscillator,
    fit_in_time=identify_bouc_wen_oscillator,
)
PREISACH_OSCILLATOR = ModelSpec(
    "a mass on a damper and a Preisach force with a spring; needs the time of each row",
    PreisachOscillator,
    fit_in_time=identify_preisach_oscillator,
)
RATE_DEPENDENT_PLAYS = ModelSpec(
    "weighted plays whose thresholds grow with their rate, for loops that widen with it; needs the time of each row",
    RateDependentPlays,
    fit_in_time=identify_rate_dependent_plays,
)
