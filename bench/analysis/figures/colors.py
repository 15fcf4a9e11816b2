"""Colours of figures: one for each model and controller, the same everywhere.

They can be told apart with the common deficiencies of colour vision as far as so many can (Okabe and Ito, Color
Universal Design, 2008; Tol, Colour schemes, SRON/EPS/TN/09-002).
"""

from __future__ import annotations

import zlib

MEASURED = "#2b2b2b"
"""Colour of what was measured."""
REFERENCE = "#000000"
"""Colour of what was asked for."""
SKIPPED = "#a0a0a0"
"""Colour of what counts in no error."""

_OF_MODELS = {
    "preisach": "#0072b2",
    "preisach-nonmonotonic": "#d55e00",
    "preisach-signed": "#009e73",
    "polynomial": "#cc79a7",
    "linear": "#b8860b",
    "prandtl-ishlinskii": "#3aa0d8",
    "generalized-prandtl-ishlinskii": "#332288",
    "krasnoselskii-pokrovskii": "#117733",
    "bouc-wen": "#882255",
    "duhem": "#8a8a1f",
    "maxwell-slip": "#44aa99",
    "polynomial-plays": "#aa4499",
    "hammerstein": "#a0522d",
    "rate-dependent-plays": "#6b8e23",
    "preisach-oscillator": "#4b6fa5",
    "bouc-wen-oscillator": "#c04070",
    "two-stage": "#d55e00",
    "two-stage-prandtl-ishlinskii": "#6a3d9a",
    "summed": "#0072b2",
}
_OF_CONTROLLERS = {
    "open-loop-inverse": "#e08a00",
    "open-loop": "#e08a00",
    "integral": "#b0529b",
    "proportional-integral": "#b0529b",
    "closed-loop-inverse": "#0072b2",
    "latched": "#009e73",
}
_OTHERS = ("#d55e00", "#0072b2", "#009e73", "#aa4499", "#8a8a1f", "#882255", "#332288", "#117733")


def color_of(name: str) -> str:
    """Return the colour of a model or controller by its registered name; one that is not known here has one, too."""
    known = _OF_MODELS | _OF_CONTROLLERS
    return known.get(name) or _OTHERS[zlib.crc32(name.encode()) % len(_OTHERS)]


def series_color(index: int) -> str:
    """Return the colour of one of several curves of the same kind."""
    return _OTHERS[index % len(_OTHERS)]
