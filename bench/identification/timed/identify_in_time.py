"""From measured times, inputs and outputs to a model with time, by name."""

from __future__ import annotations

import inspect
from typing import Any

from numpy.typing import ArrayLike

from bench.identification.by_name import Identification
from bench.models import timed_models


def identify_in_time(
    model_name: str,
    times: ArrayLike,
    inputs: ArrayLike,
    outputs: ArrayLike,
    **options: Any,  # noqa: ANN401 - each model names and types its own
) -> Identification[Any]:
    """Return the model with time of a given name that fits a measured sequence best in the least-squares sense.

    Parameters
    ----------
    model_name : str
        `hammerstein`, or another entry of `bench.models` with time.
    times : array_like, shape (N,)
        s, strictly increasing; the steps need not be even.
    inputs, outputs : array_like, shape (N,)
        The measured sequence, in input and output units.
    **options
        `weights`, `skip`, `initial`, `input_unit`, `output_unit`, and those of the model; see `identify_hammerstein`.

    Raises
    ------
    ValueError
        If the name is unknown, an option does not belong to it, or the data are unfit.
    """
    known = timed_models()
    if model_name not in known:
        raise ValueError(f"model_name: expected one of {', '.join(sorted(known))}, got {model_name!r}")
    fit = known[model_name].fit_in_time
    assert fit is not None
    try:
        inspect.signature(fit).bind(times, inputs, outputs, **options)
    except TypeError as error:
        raise ValueError(f"options of {model_name}: {error}") from None
    found: Identification[Any] = fit(times, inputs, outputs, **options)
    return found
