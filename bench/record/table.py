"""Columns of measurements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.base import ConfigurationError, aligned, counted, header_with_unit, html_table
from bench.record.rows import StepRecord

_ROWS_SHOWN = 5
"""Rows of a table at either end that its text shows."""


@dataclass(frozen=True, repr=False)
class Table:
    """Columns of equal length.

    Attributes
    ----------
    columns : mapping of str to ndarray
        Float columns by signal or column name, shape (rows,).
    units : mapping of str to str
        Unit by the same names.
    """

    columns: Mapping[str, npt.NDArray[np.float64]]
    units: Mapping[str, str] = field(default_factory=dict)

    def ticks_of(self, step: StepRecord) -> Table:
        """Return the ticks of a step, of a telemetry; without those of an attempt that its run's death ended."""
        rows = (self["step"] == step.step) & (self["t"] >= step.started) & (self["t"] <= step.finished)
        return Table({name: column[rows] for name, column in self.columns.items()}, self.units)

    def __getitem__(self, name: str) -> npt.NDArray[np.float64]:
        return self.columns[name]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def to_pandas(self) -> Any:  # noqa: ANN401 - pandas is optional
        """Return a pandas `DataFrame`, with the units in its `attrs`.

        Raises ConfigurationError if pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise ConfigurationError("pandas is not installed; `pip install pandas`") from None
        frame = pd.DataFrame(dict(self.columns))
        frame.attrs["units"] = dict(self.units)
        return frame

    def _shown(self) -> tuple[list[str], list[list[str]]]:
        """Return column heads with units, and the first and last rows."""
        count = len(self)
        heads = [
            header_with_unit(name, unit if (unit := self.units.get(name, "")) != "1" else "") for name in self.columns
        ]
        shown = list(range(count)) if count <= 2 * _ROWS_SHOWN else [*range(_ROWS_SHOWN), *range(-_ROWS_SHOWN, 0)]
        rows = [[f"{column[i]:.6g}" for column in self.columns.values()] for i in shown]
        if len(shown) < count:
            rows.insert(_ROWS_SHOWN, ["…"] * len(heads))
        return heads, rows

    def _repr_html_(self) -> str:
        return html_table(*self._shown(), counted(len(self), "row"))

    def __repr__(self) -> str:
        """Return size, column heads with units, and the first and last rows."""
        heads, rows = self._shown()
        return "\n".join([*aligned([heads, *rows], numbers_from=0), counted(len(self), "row")])
