"""The specimen of a twin as C: its operator with actuator, lag, wander, unevenness, creep and drift."""

from __future__ import annotations

import math

import numpy as np

from bench.deployment.c_source import Source, constants, parts_of, rendered
from bench.deployment.operators import operator_source
from bench.models import split_delay
from bench.specimen import TwinTable

_INFINITE = 1e300
"""Faster than any actuator. Derivation: below the greatest number of `double`, 1.8e308."""
_POLE = 0.1
"""Greatest part of the time of a pole that a step takes. Source: `bench.models.actuator_kernels.move`."""


def specimen_source(table: TwinTable, name: str) -> Source:
    """Return the specimen of a twin as C, in `double`; raises DataError if its operator cannot be exported."""
    operator, dynamics = table.operator, table.dynamics
    cold = operator.initial_state()
    hysteresis = operator_source(operator, (cold, cold, cold, cold), "double", f"{name}_h", name)
    actuator, response, step = dynamics.actuator, dynamics.response, dynamics.step
    wander, uneven, gain = dynamics.wander, dynamics.unevenness, abs(actuator.gain)
    late, newer = split_delay(actuator.delay, step)
    parts = max(1, math.ceil(actuator.frequency * max(1.0, 2.0 * actuator.damping) * step / _POLE))
    decay = math.exp(-step / wander.time)
    shares, times = np.array(response.shares), np.array(response.times)
    declared, size = constants(
        {
            "rest": (table.drive.rest - actuator.offset) / actuator.gain, "gain": actuator.gain,
            "offset": actuator.offset, "order": actuator.order, "frequency": actuator.frequency,
            "damping": actuator.damping, "rate": min(actuator.rate, _INFINITE), "grid": step, "parts": parts,
            "part": step / parts, "share": 1.0 - math.exp(-actuator.frequency * step),
            "newer": newer if actuator.order else 1.0,
            "lags": math.exp(-step / response.lag) if response.lag else 0.0,
            "power": float(response.power), "prompt": response.gain, "shares": np.append(shares, 0.0),
            "remains": np.append(np.exp(-step / times), 0.0), "wander": wander.deviation / gain, "decay": decay,
            "kick": wander.deviation / gain * math.sqrt(1.0 - decay**2), "uneven": uneven.deviation / gain,
            "length": uneven.length / gain, "drift": dynamics.drift * math.sqrt(step),
            "session": table.session_offset,
        },
        "double",
    )  # fmt: skip
    words = {"late": late, "creep": times.size, "period": f"{step:g}"}
    own = {part: text.replace("/*@constants*/\n", declared) for part, text in parts_of("specimen.c.in").items()}
    head, functions, code = (
        rendered(own[part], "double", f"{name}_of", name, words) for part in ("head", "functions", "code")
    )
    return Source(
        hysteresis.states + hysteresis.functions + head,
        functions,
        hysteresis.code + code,
        hysteresis.constants + size,
        hysteresis.state + 8 * (late + 12 + times.size),
        hysteresis.machine,
        hysteresis.step,
        "",
    )
