"""What can go wrong in an emulated laboratory, with its quantities; and what has gone wrong."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from bench.base import ConfigurationError


@dataclass(frozen=True)
class Quantity:
    """A number that can be chosen of a fault.

    Attributes
    ----------
    default : float
        Its value where none is chosen.
    unit : str
        Its unit; empty of a count or a share.
    low, high : float
        The range that is allowed.
    description : str
        What it is, as a noun phrase.
    """

    default: float
    unit: str
    low: float
    high: float
    description: str

    def to_json(self) -> dict[str, Any]:
        """Return it for JSON; a bound that is infinite becomes null."""
        low, high = (bound if math.isfinite(bound) else None for bound in (self.low, self.high))
        return {
            "default": self.default, "unit": self.unit, "low": low, "high": high, "is": self.description,
        }  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """Something that can go wrong at any time.

    Attributes
    ----------
    summary : str
        What happens, in one line.
    begin : callable
        Make it happen; takes `values` by name.
    values : mapping of str to Quantity
        What can be chosen.
    undo : callable, optional
        Make it end; without it the fault happens at an instant, and takes no duration.
    lies : bool
        Whether a value is wrong and nothing shows it: what is recorded then is as it was measured.
    """

    summary: str
    begin: Callable[..., None]
    values: Mapping[str, Quantity] = field(default_factory=dict)
    undo: Callable[[], None] | None = None
    lies: bool = False

    def chosen(self, name: str, values: Mapping[str, float], duration: float | None) -> dict[str, float]:
        """Return the values with which it begins: those given, and the defaults of the others.

        Parameters
        ----------
        name : str
            Its name, for messages.
        values : mapping of str to float
            What is chosen.
        duration : float or None
            After which laboratory time it ends, s; None if it does not end by itself.

        Raises
        ------
        ConfigurationError
            If it does not take one of the values, one is out of its range, or it takes no duration.
        """
        for key, value in values.items():
            if key not in self.values:
                raise ConfigurationError(f"fault {name} takes no value {key!r}; it takes: {_listed(self.values)}")
            known = self.values[key]
            if not known.low <= value <= known.high:
                unit = f" {known.unit}" if known.unit else ""
                raise ConfigurationError(
                    f"fault {name}: {key} = {value:g}: allowed are {known.low:g} to {known.high:g}{unit}"
                )
        if duration is not None and self.undo is None:
            raise ConfigurationError(f"fault {name} happens at an instant; it takes no duration")
        if duration is not None and not 0 < duration < math.inf:
            raise ConfigurationError(f"fault {name}: duration = {duration:g}: expected a positive number of seconds")
        return {key: float(values.get(key, known.default)) for key, known in self.values.items()}

    def to_json(self) -> dict[str, Any]:
        """Return what a client has to know of it, for JSON."""
        return {
            "does": self.summary,
            "values": {name: value.to_json() for name, value in self.values.items()},
            "takes_duration": self.undo is not None,
        }


@dataclass(frozen=True)
class FaultEvent:
    """A fault that happened.

    Attributes
    ----------
    time : float
        Laboratory time, s.
    fault : str
        Its name.
    what : {"begins", "ends"}
        What happened; a fault without an end only begins.
    values : mapping of str to float
        The values with which it began; at the end of a disturbance of answers the number of those `disturbed`.
    """

    time: float
    fault: str
    what: str
    values: Mapping[str, float]

    def to_json(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {"time": self.time, "fault": self.fault, "what": self.what, "values": dict(self.values)}


def _listed(names: Mapping[str, object]) -> str:
    return ", ".join(names) or "none"
