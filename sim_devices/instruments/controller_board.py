"""A controller board whose firmware is the C that `bench model deploy --controller` writes, compiled here."""

from __future__ import annotations

import ctypes
import shutil
import tempfile
import weakref
from collections.abc import Callable
from pathlib import Path

from bench.base import ConfigurationError
from bench.deployment import compile_library
from sim_devices.wire.text import AttendedLine
from sim_devices.world import World

_ANSWER = 80
"""Bytes that an answer has room for."""


class ControllerBoard(AttendedLine):
    """A board that reads a specimen and sets its input each period; see `board.c` in the folder of its firmware.

    Parameters
    ----------
    firmware : Path
        The folder.
    read : callable
        Returns readings of input and output of the specimen.
    drive : callable
        Takes what the board sets the input to.

    Raises
    ------
    ConfigurationError
        If there is no compiler of C, or the folder holds no firmware.
    DataError
        If the firmware cannot be compiled.
    """

    def __init__(
        self,
        world: World,
        firmware: Path,
        read: Callable[[], tuple[float, float]],
        drive: Callable[[float], None],
    ) -> None:
        self.world = world
        self._read, self._drive = read, drive
        self._library = _compiled(self, firmware)
        self._period: float = self._library.board_period()
        self._due: float = world.time + self._period
        self._library.board_init()
        world.add(self)

    def power_cycle(self) -> None:
        """Switch the board off and on: the controller is off."""
        with self.world.at_present():
            self._library.board_init()

    def deadline(self) -> float:
        """Return the instant of the next set-point, s."""
        return self._due

    def expire(self) -> None:
        """Read, and set the input."""
        self._due += self._period
        self._drive(self._library.board_tick(self._period, *self._read()))

    def answer(self, message: str) -> str | None:
        """Let the firmware obey a line."""
        answer = ctypes.create_string_buffer(_ANSWER)
        self._library.board_line(message.strip().encode("ascii", "replace"), answer, ctypes.c_size_t(_ANSWER))
        return answer.value.decode("ascii") or None


def _compiled(board: object, firmware: Path) -> ctypes.CDLL:
    """Return the firmware as a library of its own, so that two boards share nothing."""
    if not (firmware / "board.c").is_file():
        raise ConfigurationError(
            f"firmware {firmware}: there is no board.c; expected a folder of bench model deploy --c --controller"
        )
    folder = tempfile.mkdtemp()
    weakref.finalize(board, shutil.rmtree, folder, ignore_errors=True)
    file = Path(folder, "board.so")
    compile_library(
        f"firmware {firmware}", [each for each in sorted(firmware.glob("*.c")) if each.name != "main.c"], file
    )
    library = ctypes.CDLL(str(file))
    library.board_period.restype = library.board_tick.restype = ctypes.c_double
    library.board_tick.argtypes = [ctypes.c_double] * 3
    return library
