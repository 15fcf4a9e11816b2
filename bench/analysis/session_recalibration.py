"""Recalibration of a session by the commands: what is asked for, and what the models then give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bench.base import ConfigurationError
from bench.identification import Kind, Recalibration, parse_kinds


@dataclass(frozen=True)
class Session:
    """What is estimated of a session.

    Attributes
    ----------
    kinds : tuple of str
        Some of `offset`, `gain`, `drift`, `input-offset`.
    rows : int or None
        Number of first rows for it; None uses all.
    """

    kinds: tuple[Kind, ...]
    rows: int | None = None

    @classmethod
    def parse(cls, text: str | None, rows: int | None) -> Session | None:
        """Return what two options ask for; None if they ask for nothing.

        Raises ConfigurationError if a kind is unknown, or rows are given without kinds.
        """
        if text is None:
            if rows is not None:
                raise ConfigurationError(f"--recalibrate-rows {rows}: say with --recalibrate what is estimated")
            return None
        try:
            return cls(parse_kinds(text), rows)
        except ValueError as error:
            raise ConfigurationError(f"--{error}") from None


def session_rows(found: Recalibration, size: int, units: tuple[str, str]) -> Sequence[tuple[str, str]]:
    """Return what was estimated as (name, text) pairs, and from which of `size` rows; units of input and output."""
    whole = found.rows >= size
    where = f"all {size} rows, so that errors are of rows it used" if whole else f"first {found.rows} of {size} rows"
    return (*found.texts(*units), ("estimated from", where))
