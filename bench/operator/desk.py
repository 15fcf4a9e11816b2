"""What an operator does by hand: commands to a rig that another thread carries out."""

from __future__ import annotations

import math
import queue
import re
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from bench.base import ConfigurationError, is_quantity, read_quantity
from bench.devices import Limits, Signal
from bench.rig import Interlock, rate_unit

_MOST_LINES = 500
"""Lines of the log that are kept for the display; the journal has all events."""

_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
_BEGINS = re.compile(r"[+-]?[.,]?\d", re.ASCII)


@dataclass(frozen=True)
class SetPoint:
    """Send a set-point, at once or by a ramp.

    Attributes
    ----------
    device : str
        Device that takes it.
    value : float
        Set-point, in the unit of the device.
    rate : float
        Change per second, in this unit; infinite for at once.
    """

    device: str
    value: float
    rate: float = math.inf


@dataclass(frozen=True)
class HoldAll:
    """Stop every ramp where it is."""


@dataclass(frozen=True)
class Tare:
    """Make the present force of a load cell read zero."""

    device: str


@dataclass(frozen=True)
class Rest:
    """Bring every device into its safe state; the next set-point switches an output on again."""


@dataclass(frozen=True)
class Remark:
    """Write a note into the record."""

    text: str


@dataclass(frozen=True)
class Leave:
    """End in the safe state."""


Command = SetPoint | HoldAll | Tare | Rest | Remark | Leave

SYNTAX: Mapping[str, str] = {
    "set": "set DEVICE VALUE",
    "ramp": "ramp DEVICE VALUE RATE (its unit per s, or 2 K/min)",
    "hold": "hold (stop all ramps)",
    "tare": "tare DEVICE (a load cell)",
    "zero": "zero SIGNAL (on the screen only; again: off)",
    "safe": "safe (all outputs off)",
    "note": "note TEXT",
    "quit": "quit",
}


def parse_command(line: str, limits: Mapping[str, Limits] | None = None) -> Command:
    """Return what a line of the operator stands for; numbers may have units where the `limits` of devices are known.

    Raises ConfigurationError if it stands for nothing; says what is expected.
    """
    word, *rest = line.split() or [""]
    word = word.lower()
    try:
        if word in ("set", "ramp"):
            device, *words = rest
            unit = limits[device].unit if limits is not None and device in limits else ""
            value, *rate = map(_number, _numbers(words), (unit, unit and rate_unit(unit)))
            if len(rate) == (word == "ramp") and (not rate or rate[0] > 0):
                return SetPoint(device, value, *rate)
        elif word == "tare" and len(rest) == 1:
            return Tare(rest[0])
        elif word == "note" and rest:
            return Remark(" ".join(rest))
        elif not rest and word in ("hold", "safe", "off", "quit", "q"):
            commands: dict[str, Command] = {"hold": HoldAll(), "safe": Rest(), "off": Rest()}
            return commands.get(word, Leave())
    except ValueError:
        pass
    expected = SYNTAX.get(word)
    raise ConfigurationError(f"{line!r}: expected {expected or '; '.join(SYNTAX.values())}")


def _numbers(words: Sequence[str]) -> Sequence[str]:
    """Return one or two numbers, with the units that stand behind them."""
    found: list[str] = []
    for word in words:
        if found and not _BEGINS.match(word):
            found[-1] += f" {word}"
        else:
            found.append(word)
    if len(found) > 2:
        raise ValueError(found)
    return found


def _number(text: str, unit: str) -> float:
    """Return the number in a text; raise ValueError for what Python alone takes for one, such as `nan` or `1_0`."""
    if unit and is_quantity(text):
        return read_quantity(text, unit)
    value = float(text.replace(",", ".")) if _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise ValueError(text)
    return value


@dataclass(frozen=True)
class Shown:
    """What is shown of a rig.

    Attributes
    ----------
    rig : str
        Its name.
    signals : tuple of Signal
        Its signals.
    limits : mapping of str to Limits
        The set-points that are allowed, of each device that takes one.
    interlocks : tuple of Interlock
        What its signals may not do.
    """

    rig: str
    signals: tuple[Signal, ...]
    limits: Mapping[str, Limits]
    interlocks: tuple[Interlock, ...]


@dataclass
class Desk:
    """Between an operator's display and the thread that has the rig: commands one way, readings the other.

    Attributes
    ----------
    shown : Shown or None
        The rig, once it is connected.
    ticks : deque of (float, mapping)
        The newest readings: laboratory time in s, values by signal.
    lines : deque of str
        What happened, oldest first.
    """

    shown: Shown | None = None
    ticks: deque[tuple[float, Mapping[str, float]]] = field(default_factory=lambda: deque(maxlen=240))
    lines: deque[str] = field(default_factory=lambda: deque(maxlen=_MOST_LINES))
    _commands: queue.SimpleQueue[Command] = field(default_factory=queue.SimpleQueue)
    over: threading.Event = field(default_factory=threading.Event)

    def send(self, command: Command) -> None:
        """Have a command carried out."""
        self._commands.put(command)

    def take(self) -> Command | None:
        """Return the next command, None if there is none."""
        try:
            return self._commands.get_nowait()
        except queue.Empty:
            return None

    def say(self, text: str) -> None:
        """Show a line."""
        self.lines.append(text)
