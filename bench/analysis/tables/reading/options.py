"""What can be said about a file of measurements instead of being found from it."""

from __future__ import annotations

import codecs
from dataclasses import dataclass, fields
from pathlib import Path

from bench.base import ConfigurationError

_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "\\t": "\t", "blank": " ", "blanks": " ", "space": " "}
_DECIMALS = {"point": ".", "comma": ","}


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

    def check_only(self, path: Path, kind: str, *allowed: str) -> None:
        """Check that no option is given beside those that a kind of file allows.

        Raises ConfigurationError that names the option.
        """
        for field in fields(self):
            if field.name not in allowed and getattr(self, field.name) != field.default:
                raise ConfigurationError(f"--{field.name.replace('_', '-')} does not apply: {path} is {kind}")
