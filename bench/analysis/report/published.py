"""Numbers that a paper states, beside those of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Published:
    """One number of a paper.

    Attributes
    ----------
    protocol : str
        Protocol of the bench that measures the same.
    quantity : str
        What it is, in words.
    value, unit : str
        The number as the paper prints it, and its unit.
    source : str
        Where the paper states it: a figure, table or section.
    path : tuple of str
        Where the same is in the result of `bench report`, such as ("tracking", "rms"); empty if a run of this
        protocol alone does not give it.
    where : mapping of str to str
        Parameters that the run must have, such as the controller.
    scale : float
        From the unit of the result to that of the paper.
    """

    protocol: str
    quantity: str
    value: str
    unit: str
    source: str
    path: tuple[str, ...] = ()
    where: Mapping[str, str] = field(default_factory=dict)
    scale: float = 1.0

    def concerns(self, meta: Mapping[str, Any]) -> bool:
        """Return whether it is to be shown beside a run with these metadata."""
        given = meta.get("parameters", {})
        return meta.get("protocol") == self.protocol and all(
            str(given.get(name)) == value for name, value in self.where.items()
        )

    def measured(self, result: Mapping[str, Any]) -> float | None:
        """Return the same of a run in the unit of the paper, from the result of `bench report`; None if not there."""
        found: Any = result
        for key in self.path:
            found = found.get(key) if isinstance(found, Mapping) else None
        return self.scale * float(found) if self.path and isinstance(found, int | float) else None
