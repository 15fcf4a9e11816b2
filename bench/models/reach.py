"""Whether an inverse could meet its target."""

from __future__ import annotations

from enum import Enum


class Reach(Enum):
    """Whether a target could be met."""

    MET = "met"
    TOO_HIGH = "too high"
    TOO_LOW = "too low"
