"""The state of a model of two stages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class TwoStageState:
    """The memories of both stages and where they are now.

    Parameters
    ----------
    voltage, force : float
        Present inputs.
    first, second : object
        States of the two operators.
    blocked : float
        Output of the first stage, the force at resting length, force units.
    argument : float
        Input of the second stage, force - blocked.
    length : float
        Output of the second stage, length units.
    """

    voltage: float
    force: float
    first: Any
    second: Any
    blocked: float
    argument: float
    length: float
