"""What can be said about a file of measurements instead of being found from it."""

from __future__ import annotations

import codecs
import re
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.analysis.tables.reading.heads import SECONDS, spelled
from bench.base import ConfigurationError, Floats, closest

_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "\\t": "\t", "blank": " ", "blanks": " ", "space": " "}
_DECIMALS = {"point": ".", "comma": ","}

OF_ALL = ("interval", "time_unit", "missing")
"""Options that apply to every kind of file."""


_INTERVAL = re.compile(r"(\d+\.?\d*(?:e[+-]?\d+)?)\s*([a-zµ]+)")


_WORDS = {
    "delimiter": "delimiter", "decimal": "decimal", "encoding": "encoding", "skip_lines": "skip", "table": "table",
    "interval": "interval", "time_unit": "time-unit", "missing": "missing",
}  # fmt: skip
"""The words of `--format`, by option."""

_BETWEEN_WORDS = re.compile(r",(?=[a-z-]+=)")


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
    missing : str, optional
        Text of a cell without a value, such as `nan`, `--`, `-9999` or `empty`; several with `|` between them. A row
        with such a cell in a column that is read is left out.

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
    missing: str | None = None

    def __post_init__(self) -> None:
        delimiter, decimal = self.delimiter, self.decimal
        if delimiter is not None:
            delimiter = _DELIMITERS.get(delimiter, delimiter)
            if len(delimiter) != 1 or delimiter in '\n\r"' or delimiter.isalnum():
                raise ConfigurationError(
                    f"--format delimiter={self.delimiter}: expected a character, or comma, semicolon, tab or blanks"
                )
            object.__setattr__(self, "delimiter", delimiter)
        if decimal is not None:
            decimal = _DECIMALS.get(decimal, decimal)
            if decimal not in (".", ","):
                raise ConfigurationError(f"--format decimal={self.decimal}: expected point or comma")
            object.__setattr__(self, "decimal", decimal)
        if self.encoding is not None:
            try:
                codecs.lookup(self.encoding)
            except (LookupError, ValueError):
                raise ConfigurationError(
                    f"--format encoding={self.encoding} is unknown; for example utf-8, cp1252, utf-16"
                ) from None
        if self.skip_lines < 0:
            raise ConfigurationError(f"--format skip={self.skip_lines}: expected a number of lines ≥ 0")
        if self.table is not None and (not self.table or self.table == "0"):
            raise ConfigurationError(f"--format table={self.table}: expected a number from 1, or a name")
        if self.time_unit is not None and spelled(self.time_unit) not in SECONDS:
            raise ConfigurationError(f"--format time-unit={self.time_unit}: expected d, h, min, s, ms, us or ns")
        _ = self.seconds_between_rows

    @classmethod
    def parse(cls, text: str) -> ReadingOptions:
        """Return the options of a text such as `decimal=comma,skip=3`.

        Raises ConfigurationError for a word that there is not, or comes twice, or a value that is not allowed.
        """
        names = {word: name for name, word in _WORDS.items()}
        given: dict[str, Any] = {}
        for part in filter(None, _BETWEEN_WORDS.split(text)):
            word, _, value = part.partition("=")
            if word not in names:
                raise ConfigurationError(f"--format {part}: there is no such word; {closest(word, names)}")
            if not value or names[word] in given:
                raise ConfigurationError(f"--format {part}: expected {word}=VALUE, once")
            given[names[word]] = value
        if not given.get("skip_lines", "0").isdecimal():
            raise ConfigurationError(f"--format skip={given['skip_lines']}: expected a number of lines ≥ 0")
        return cls(**given | {"skip_lines": int(given.get("skip_lines", 0))})

    @property
    def seconds_between_rows(self) -> float | None:
        """Time between evenly sampled rows, s; None if it is not given."""
        if self.interval is None:
            return None
        match = _INTERVAL.fullmatch(self.interval.strip())
        unit = spelled(match[2]) if match else ""
        if match is None or unit not in SECONDS or float(match[1]) <= 0.0:
            raise ConfigurationError(
                f"--format interval={self.interval}: expected a time > 0 with its unit, such as 0.1s"
            )
        return float(match[1]) * SECONDS[unit]

    @cached_property
    def _missing(self) -> list[str]:
        return [] if self.missing is None else [text.strip().casefold() for text in self.missing.split("|")]

    def is_missing(self, cell: str) -> bool:
        """Return whether a cell without blanks around it is one of the texts for a missing value."""
        return (cell.casefold() or "empty") in self._missing

    def missing_remedy(self, cell: str) -> str:
        """Return the remedy for a cell that may stand for a missing value, such as `nan`."""
        texts = "|".join([*filter(None, [self.missing]), cell.strip() or "empty"])
        return f"; to leave out the rows that have it, say --format missing={texts}"

    def are_missing(self, values: Floats) -> npt.NDArray[np.bool_]:
        """Return which values are missing, shape (N,): nan, and the numbers that stand for a missing value."""
        gone = np.isnan(values)
        for text in self._missing:
            with suppress(ValueError):
                # A file may hold it in single precision.
                gone |= np.isclose(values, float(text), 1e-6, 0.0)
        return gone

    def check_only(self, path: Path, kind: str, *allowed: str) -> None:
        """Check that no option is given beside those that a kind of file allows.

        Raises ConfigurationError that names the option.
        """
        for field in fields(self):
            if field.name not in allowed and getattr(self, field.name) != field.default:
                raise ConfigurationError(f"--format {_WORDS[field.name]} does not apply: {path} is {kind}")
