"""Programs that some tests use and that pip cannot install. As a script: say which of them are missing here.

Only the standard library is imported, so that the script runs before anything is installed.
"""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

_DRIVERS = Path("/usr/share/vulkan/icd.d")


class Program(NamedTuple):
    """A program, the Debian packages that install it, and a function that returns its path, or None."""

    what: str
    packages: str
    find: Callable[[], str | None]


def _chromium() -> str | None:
    names = ("chromium", "chromium-browser", "google-chrome")
    return next(filter(None, map(shutil.which, names)), None)


def _vulkan() -> str | None:
    # The name that Mesa gives its software renderer, lavapipe.
    return next(map(str, _DRIVERS.glob("lvp_icd*.json")), None)


PROGRAMS = {
    "chromium": Program("a browser", "chromium", _chromium),
    "vulkan": Program(
        "a software Vulkan driver", "mesa-vulkan-drivers libvulkan1 libxkbcommon-x11-0 libgl1", _vulkan
    ),
    "gcc": Program("a compiler of C", "gcc libc6-dev", lambda: shutil.which("gcc")),
    "clang": Program("another compiler of C", "clang", lambda: shutil.which("clang")),
    "arm-none-eabi-gcc": Program(
        "a compiler for microcontrollers",
        "gcc-arm-none-eabi libnewlib-arm-none-eabi",
        lambda: shutil.which("arm-none-eabi-gcc"),
    ),
    "valgrind": Program("a counter of instructions", "valgrind", lambda: shutil.which("valgrind")),
    "mbpoll": Program("an independent Modbus client", "mbpoll", lambda: shutil.which("mbpoll")),
}


def missing() -> dict[str, Program]:
    """Return the programs that are not installed, by name."""
    return {name: program for name, program in PROGRAMS.items() if program.find() is None}


def how_to_install(programs: dict[str, Program]) -> str:
    """Return the command that installs programs on Debian."""
    return " ".join(["apt-get install", *(program.packages for program in programs.values())])


def main() -> None:
    """Print one line for each missing program, and how to install them all."""
    if not (absent := missing()):
        return
    for name, program in absent.items():
        print(f"not installed: {name}, {program.what}; its tests will be skipped", file=sys.stderr)
    print(f"to run them as well: {how_to_install(absent)}", file=sys.stderr)


if __name__ == "__main__":
    main()
