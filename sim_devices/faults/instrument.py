"""The faults of an instrument itself: it restarts, or its values stand still."""

from __future__ import annotations

from functools import partial
from typing import Protocol, runtime_checkable

from sim_devices.faults.fault import Fault
from sim_devices.faults.line import Cable, FaultyLine


@runtime_checkable
class PowerCycled(Protocol):
    """An instrument that can be switched off and on."""

    def power_cycle(self) -> None:
        """Switch it off and on again."""


@runtime_checkable
class Freezable(Protocol):
    """An instrument whose measured values can stand still."""

    def freeze(self) -> None:
        """Let what it measures stand still; it answers and obeys as ever."""

    def thaw(self) -> None:
        """Undo `freeze`."""


@runtime_checkable
class Exchangeable(PowerCycled, Protocol):
    """An instrument that has a serial number."""

    serial_number: int


def instrument_faults(name: str, instrument: object, line: FaultyLine) -> dict[str, Fault]:
    """Return what any instrument of this kind can suffer, by `INSTRUMENT.FAULT`."""
    found: dict[str, Fault] = {}
    if isinstance(instrument, PowerCycled):
        found[f"{name}.power-cycle"] = Fault(
            f"{name} is switched off and on again; connections on TCP are lost", partial(_restart, instrument, line)
        )
        found[f"{name}.power-loss"] = Fault(
            f"{name} has no power: its output is off and its line dead; at the end it starts again",
            partial(_lose_power, instrument, line),
            undo=partial(_regain_power, instrument, line),
        )
    if isinstance(instrument, Exchangeable):
        number = instrument.serial_number
        found[f"{name}.exchange"] = Fault(
            f"another instrument of its kind, with the next serial number, stands in the place of {name}",
            partial(_exchange, instrument, line, number + 1),
            undo=partial(_exchange, instrument, line, number),
        )
    if isinstance(instrument, Freezable):
        found[f"{name}.freeze"] = Fault(
            f"{name} answers and obeys, but what it measures stands still",
            instrument.freeze,
            undo=instrument.thaw,
            lies=True,
        )
    return found


def _restart(instrument: PowerCycled, line: FaultyLine) -> None:
    instrument.power_cycle()
    line.restart()


def _exchange(instrument: Exchangeable, line: FaultyLine, serial_number: int) -> None:
    instrument.serial_number = serial_number
    _restart(instrument, line)


def _lose_power(instrument: PowerCycled, line: FaultyLine) -> None:
    instrument.power_cycle()
    line.break_off(Cable.CUT)


def _regain_power(instrument: PowerCycled, line: FaultyLine) -> None:
    instrument.power_cycle()
    line.mend()
