"""What the commands share about prediction bands and the recalibration of a session."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

from bench.base import print_plain, significant
from bench.cli.printing import console, print_rows, warn

if TYPE_CHECKING:
    from bench.analysis import Applied, BandedPrediction, Session
    from bench.base import Floats

BandOption = Annotated[
    bool,
    typer.Option(
        "--band", help="Calibrate a 90 % prediction band on blocks left out, at ten fits' cost; kept with the model."
    ),
]
BandsOption = Annotated[
    bool, typer.Option("--bands", help="Show how many of the measured outputs each model's prediction band covers.")
]


@dataclass(frozen=True)
class Recalibrating:
    """The options of the recalibration of a session."""

    recalibrate: Annotated[
        str | None,
        typer.Option(
            metavar="KINDS",
            help="What has moved since the model's data, estimated from the measured output: some of offset, gain, "
            "drift, input-offset, with commas.",
        ),
    ] = None
    recalibrate_rows: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="ROWS",
            help="First rows by which that is estimated; errors are those of the others. All if not given.",
        ),
    ] = None

    def session(self) -> Session | None:
        """Return what is estimated; None if nothing is. Raises ConfigurationError as `Session.parse`."""
        from bench.analysis import Session

        return Session.parse(self.recalibrate, self.recalibrate_rows)


def print_band(found: BandedPrediction, residuals: Floats | None = None, name: str = "") -> None:
    """Print a band in a line, with its coverage if there are residuals."""
    print_plain(console, (f"{name}: " if name else "") + found.text(residuals))


def print_applied(found: Applied, name: str = "", *, bands: bool = True) -> None:
    """Print what was estimated of a session, and the band unless it is unwanted; `name` is that of the model."""
    from bench.analysis import session_rows

    for text in found.warnings():
        warn(f"{name}: {text}" if name else text)
    if found.recalibration is not None:
        rows = session_rows(found.recalibration, found.predicted.size, (found.input.unit, found.unit))
        errors = found.errors()
        after = f"max {significant(errors.maximum, 4)}, RMS {significant(errors.rms, 4)} {found.unit}".rstrip()
        title = f"recalibration of {name}" if name else "recalibration"
        print_rows(title, [*rows, ("errors after it", after)])
    if bands and found.band is not None:
        print_band(found.band, found.counted, name)
    elif bands and name:
        warn(f"{name} has no prediction band; `bench identify --band` calibrates one")
