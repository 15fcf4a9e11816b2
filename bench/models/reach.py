"""Whether an inverse could meet its target."""

from __future__ import annotations

from enum import Enum


class Reach(Enum):
    """Whether a target could be met."""

    MET = "met"
    TOO_HIGH = "too high"
    TOO_LOW = "too low"

    @classmethod
    def of(cls, met: bool, short: float) -> Reach:
        """Return what is said of a target that is met, or missed by `short`: the target minus the output."""
        if met:
            return cls.MET
        return cls.TOO_HIGH if short > 0.0 else cls.TOO_LOW

    @property
    def opposite(self) -> Reach:
        """What is said of the target of the opposite output."""
        opposites = {Reach.TOO_HIGH: Reach.TOO_LOW, Reach.TOO_LOW: Reach.TOO_HIGH}
        return opposites.get(self, self)
