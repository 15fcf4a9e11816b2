"""What can be said about a file of measurements instead of being found from it."""

from __future__ import annotations

import codecs
import re
from dataclasses import dataclass, fields
from pathlib import Path

from bench.analysis.tables.reading.heads import SECONDS, spelled
from bench.base import ConfigurationError

_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "\\t": "\t", "blank": " ", "blanks": " ", "space": " "}
_DECIMALS = {"point": ".", "comma": ","}

OF_TIMES = ("interval", "time_unit")
"""Options that apply to every kind of file."""


_INTERVAL = re.compile(r"(\d+\.?\d*(?:e[+-]?\d+)?)\s*([a-zµ]+)")


@dataclass(frozen=True)
class ReadingOptions:
    """How a file of measurements is read; None is found from the file.

    Parameters
    ----------
    delimiter : str, optional
        A character, or `comma`, `semicolon`, `tab` or `blanks` (runs of blanks and tabs).
    decimal : str, optional
        `point` or `comma`, or the character.
    encoding : str, optional
        As Python names it, such as `utf-8`, `cp1252` or `utf-16`.
    skip_lines : int
        Number of first lines that are left out before anything is looked for.
    table : str, optional
        Number of the table in a file of several, from 1; name of a sheet or of a MATLAB variable; of a run `steps` or
        `telemetry`.
    interval : str, optional
        Time between rows that are evenly sampled and have no column of times, such as `0.1s` or `50 ms`.
    time_unit : str, optional
        Unit of the column of times where its head has none: `d`, `h`, `min`, `s`, `ms`, `us` or `ns`.

    Raises
    ------
    ConfigurationError
        If a value is not allowed.
    """

    delimiter: str | None = None
    decimal: str | None = None
    encoding: str | None = None
    skip_lines: int = 0
    table: str | None = None
    interval: str | None = None
    time_unit: str | None = None

    def __post_init__(self) -> None:
        delimiter, decimal = self.delimiter, self.decimal
        if delimiter is not None:
            delimiter = _DELIMITERS.get(delimiter, delimiter)
            if len(delimiter) != 1 or delimiter in '\n\r"' or delimiter.isalnum():
                raise ConfigurationError(
                    f"--delimiter {self.delimiter!r}: expected a character, or comma, semicolon, tab or blanks"
                )
            object.__setattr__(self, "delimiter", delimiter)
        if decimal is not None:
            decimal = _DECIMALS.get(decimal, decimal)
            if decimal not in (".", ","):
                raise ConfigurationError(f"--decimal {self.decimal!r}: expected point or comma")
            object.__setattr__(self, "decimal", decimal)
        if self.encoding is not None:
            try:
                codecs.lookup(self.encoding)
            except (LookupError, ValueError):
                raise ConfigurationError(
                    f"--encoding {self.encoding!r} is unknown; for example utf-8, cp1252, utf-16"
                ) from None
        if self.skip_lines < 0:
            raise ConfigurationError(f"--skip-lines {self.skip_lines}: expected a number of lines ≥ 0")
        if self.table is not None and (not self.table or self.table == "0"):
            raise ConfigurationError(f"--table {self.table!r}: expected a number from 1, or a name")
        if self.time_unit is not None and spelled(self.time_unit) not in SECONDS:
            raise ConfigurationError(f"--time-unit {self.time_unit!r}: expected d, h, min, s, ms, us or ns")
        _ = self.seconds_between_rows

    @property
    def seconds_between_rows(self) -> float | None:
        """Time between evenly sampled rows, s; None if it is not given."""
        if self.interval is None:
            return None
        match = _INTERVAL.fullmatch(self.interval.strip())
        unit = spelled(match[2]) if match else ""
        if match is None or unit not in SECONDS or float(match[1]) <= 0.0:
            raise ConfigurationError(f"--interval {self.interval!r}: expected a time > 0 with its unit, such as 0.1s")
        return float(match[1]) * SECONDS[unit]

    def check_only(self, path: Path, kind: str, *allowed: str) -> None:
        """Check that no option is given beside those that a kind of file allows.

        Raises ConfigurationError that names the option.
        """
        for field in fields(self):
            if field.name not in allowed and getattr(self, field.name) != field.default:
                raise ConfigurationError(f"--{field.name.replace('_', '-')} does not apply: {path} is {kind}")
