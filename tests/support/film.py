"""A model near the emulated film, made of the paper's numbers rather than of a campaign."""

import numpy as np

from bench.models import Preisach, ThermalExpansion, uniform_levels


def film_model() -> Preisach:
    """Return the model, of 1/m over °C."""
    levels = uniform_levels(30.0, 70.0, 20)
    middle = 0.5 * (levels[1:] + levels[:-1])
    rows, columns = np.tril_indices(20)
    alpha, width = middle[rows], middle[rows] - middle[columns]
    density = np.exp(-0.5 * ((alpha - 63.5) / 3.0) ** 2 - 0.5 * ((width - 4.0) / 2.0) ** 2)
    density *= 2034.0 / 2.0 / (density @ Preisach(levels, density).cell_areas())
    term = ThermalExpansion(3.0, 4.3, 30.0, 70.0, 20.0)
    return Preisach(levels, density, 1025.0, term, (21.0, 84.0), "°C", "1/m")
