"""The devices of a rig one by one, each with its true port, for what looks after them outside of a run."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from bench.base import Clock, ConfigurationError, make_clock
from bench.devices import Device
from bench.rig.attachment import attach
from bench.rig.file import DeviceEntry, RigFile
from bench.rig.maintenance.locks import EMULATED, Holder, Locks, line_names, port_of

_IN_PROCESS = "in this process"


@dataclass(frozen=True)
class Workplace:
    """The lines of a rig, which this process holds; none is open.

    Attributes
    ----------
    file : RigFile
        The rig.
    entries : tuple of DeviceEntry
        Its devices in the order of the file, wired to their true ports.
    clock : Clock
        The clock of the rig, for any thread.
    """

    file: RigFile
    entries: tuple[DeviceEntry, ...]
    clock: Clock
    _locks: Locks

    @property
    def lines(self) -> dict[str, list[DeviceEntry]]:
        """The devices by line; those that are emulated in this process are on one, as they share a world."""
        found: dict[str, list[DeviceEntry]] = {}
        for entry in self.entries:
            names = line_names(port_of(entry.settings))
            found.setdefault(names[0] if names else _IN_PROCESS, []).append(entry)
        return found

    def only(self, device: str | None) -> tuple[DeviceEntry, ...]:
        """Return the device of a name, or all without one; raises ConfigurationError if there is none."""
        found = tuple(entry for entry in self.entries if device in (None, entry.name))
        if not found:
            names = ", ".join(entry.name for entry in self.entries)
            raise ConfigurationError(f"rig {self.file.name} has no device {device!r}; it has: {names}")
        return found

    def take_instrument(self, device: Device) -> None:
        """Lock an instrument that has been identified, unless it is emulated; raises what `Locks` does."""
        (entry,) = (entry for entry in self.file.devices if entry.name == device.name)
        if not port_of(entry.settings).startswith(EMULATED):
            self._locks.take_instrument(device.identity)


@contextmanager
def opened(
    file: RigFile,
    endpoints: Path | None,
    doing: str,
    report_use: Callable[[str], None] | None = None,
) -> Iterator[Workplace]:
    """Hold the lines of the devices of a rig until the block is left.

    Parameters
    ----------
    file : RigFile
        The rig.
    endpoints : Path, optional
        Endpoints file of `bench rig emulate`, for the instruments that are served there.
    doing : str
        The command, for those who find the lines in use.
    report_use : callable, optional
        Is given the message if the lines are in use, and the block goes on; without it that is an error.

    Raises
    ------
    ConfigurationError
        If another process holds one of the lines, or the rig cannot be served.
    """
    with ExitStack() as stack:
        ports: Mapping[str, str] = {}
        clock: Clock
        if endpoints is not None:
            if not file.emulated:
                raise ConfigurationError(f"rig {file.name} has no emulated laboratory that could be served elsewhere")
            attachment = attach(endpoints, file.name)
            stack.callback(attachment.close)
            ports, clock = attachment.open(), attachment.clock
        else:
            clock = make_clock("virtual" if file.in_process else "wall", in_process=file.in_process)
            if file.laboratory is not None:
                laboratory = file.laboratory(file.laboratory_settings, clock, 0)
                ports = laboratory.open()
                stack.callback(laboratory.close)
        entries = tuple(replace(entry, settings=entry.wired(ports, file.path)) for entry in file.devices)
        locks = stack.enter_context(Locks(Holder.of_this_process(file.name, doing)))
        try:
            locks.take_lines(port_of(entry.settings) for entry in entries)
        except ConfigurationError as error:
            if report_use is None:
                raise
            report_use(str(error))
        yield Workplace(file, entries, clock, locks)
