"""Plants whose structure is none of the models': equations of Bouc-Wen and Duhem, and excitations of several classes.

Quasi-static: the equations are integrated over the input, in steps of an eighth of the distance between samples.
"""

import numpy as np

from bench.identification import damped_oscillation, ramps

STEP = 0.04


def bouc_wen(inputs):
    """y = u - h with dh = 0.45 du - 1.6 |du| h + 0.6 du |h|."""
    h, outputs = 0.0, []
    for d in np.diff(_fine(inputs)):

        def slope(value, d=d):
            return 0.45 * d - 1.6 * abs(d) * value + 0.6 * d * abs(value)

        h += slope(h + 0.5 * slope(h))
        outputs.append(h)
    return inputs - np.concatenate([[0.0], outputs])[::8]


def duhem(inputs):
    """dy = 2.2 |du| (tanh 1.8 u + 0.25 u - y) + 0.35 du."""
    fine = _fine(inputs)
    y, outputs = -1.0, [-1.0]
    for d, u in zip(np.diff(fine), 0.5 * (fine[1:] + fine[:-1]), strict=True):

        def slope(value, d=d, u=u):
            return 2.2 * abs(d) * (np.tanh(1.8 * u) + 0.25 * u - value) + 0.35 * d

        y += slope(y + 0.5 * slope(y))
        outputs.append(y)
    return np.array(outputs)[::8]


PLANTS = {"bouc-wen": bouc_wen, "duhem": duhem}


def random_reversals(rng):
    return ramps([-1.0, 1.0, *rng.uniform(-1.0, 1.0, 60).tolist()], STEP)


def damped(rng, center=0.0):
    return damped_oscillation(-1.0, 1.0, center, int(rng.integers(30, 44)), STEP)


def cycles(rng):
    return ramps([-1.0, 1.0, *(12 * [-0.8, 0.8])], STEP)


def measured(plant, inputs, rng, noise=0.01):
    """Return outputs with noise of a part of their range."""
    outputs = PLANTS[plant](inputs)
    return outputs + noise * np.ptp(outputs) * rng.normal(size=outputs.size)


def _fine(inputs):
    parts = np.arange(1, 9) / 8.0
    steps = inputs[:-1, None] + np.diff(inputs)[:, None] * parts
    return np.concatenate([inputs[:1], steps.ravel()])
