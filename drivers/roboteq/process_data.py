"""What a Roboteq controller reports at a SYNC: its state in four process data objects (PDO).

Source: Roboteq CANBus Networking Manual V2.0 (PDO mapping and transmission type), CiA 301 (SYNC).

slcan lines carry no check sum, so a damaged digit looks like a value. Each value comes twice therefore: applied
power, battery voltage, current and fault flags in the TPDOs 1 and 3, channel flags in 2 and 4. TPDO 4 has the command
that the controller obeys as well. TPDO 2 has the mark: user variable 16, into which the host writes another number
after each reading. So process data of an earlier SYNC, late or doubled, are never taken for those of the present one,
and a controller that has restarted is known by its mark of 0. Scripts of the controller must not use that variable.

The configuration lies in RAM. TPDOs that were set up for other listeners are taken over.
"""

from __future__ import annotations

import struct
from binascii import hexlify, unhexlify
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

from bench.base import DeviceConnectionError, DeviceError
from drivers.roboteq.canopen import AbortedError, Entry, NodeLine

_VARIABLE = 16
_MARK = Entry(0x2106, "user variable")
_HIGHEST_MARK = 0x7FFF_FFFF
MOST_READINGS = 4
"""How often the process data are asked for until a whole set has come."""

_DESTROYED, _NO_REMOTE = 1 << 31, 1 << 30
_TPDO, _TPDO_MAPPING, _FIRST_TPDO = 0x1800, 0x1A00, 0x180
_RPDO, _RPDO_MAPPING, _LAST_RPDO = 0x1403, 0x1603, 0x500
_EVERY_SYNC, _ON_ARRIVAL = 1, 255
_REPORT = struct.Struct("<hHhHI")
_COMMAND = struct.Struct("<h")

_Mapping = tuple[tuple[int, int, int], ...]
"""Index, subindex and bits of what a PDO carries."""


class Report(NamedTuple):
    """What a controller reports: power (‰), battery voltage (0.1 V), current (0.1 A), flags, command (‰)."""

    power: int
    battery: int
    current: int
    faults: int
    channel_flags: int
    command: int


class ProcessData:
    """The process data of one channel.

    Parameters
    ----------
    device : str
        Name of the device, for messages.
    node : int
        CANopen node.
    channel : int
        Motor output.
    """

    def __init__(self, device: str, node: int, channel: int) -> None:
        self._device = device
        self._node = node
        self._mark = 0
        self._mark_digits = b""
        self._mark_head = b"t%03X4" % (_LAST_RPDO + node)
        electrical = (0x2102, channel, 16), (0x210D, 2, 16), (0x2100, channel, 16), (0x2112, 0, 16)
        flags = (0x2122, channel, 32)
        self._mappings: tuple[_Mapping, ...] = (
            electrical,
            (flags, (0x2106, _VARIABLE, 32)),
            electrical,
            (flags, (0x2101, channel, 16)),
        )
        self._heads = tuple(
            b"t%03X%d" % (_FIRST_TPDO + 0x100 * number + node, sum(bits for _, _, bits in mapping) // 8)
            for number, mapping in enumerate(self._mappings)
        )

    def configure(self, line: NodeLine) -> bool:
        """Set up the process data; return whether the controller takes the configuration and sends the data.

        Raises `DeviceConnectionError` if a request brings no answer.
        """
        try:
            for number, mapping in enumerate(self._mappings):
                identifier = _FIRST_TPDO + 0x100 * number | _NO_REMOTE
                self._map(line, _TPDO + number, _TPDO_MAPPING + number, identifier, mapping, _EVERY_SYNC)
            self._map(line, _RPDO, _RPDO_MAPPING, _LAST_RPDO, ((0x2005, _VARIABLE, 32),), _ON_ARRIVAL)
        except AbortedError:
            return False
        line.transmit(self.next_mark())
        try:
            self.report(line, 0, lambda: True)
        except DeviceConnectionError:
            return False
        return True

    def next_mark(self) -> bytes:
        """Return the line that writes the mark that the next process data have to carry."""
        self._mark = self._mark % _HIGHEST_MARK + 1
        self._mark_digits = hexlify(self._mark.to_bytes(4, "little")).upper()
        return b"%b%b\r" % (self._mark_head, self._mark_digits)

    def is_marked(self, line: NodeLine) -> bool:
        """Return whether the controller has a mark, which it loses in a restart.

        Raises `DeviceConnectionError` if it does not answer.
        """
        try:
            return line.read(_MARK, _VARIABLE) != 0
        except AbortedError:
            return False

    def report(self, line: NodeLine, command: int, may_write: Callable[[], bool]) -> Report:
        """Ask for the process data.

        Parameters
        ----------
        line : NodeLine
            The line to the node.
        command : int
            The command that the controller is expected to obey, ‰; another one is believed when it comes twice.
        may_write : callable
            Whether a mark may be written, which feeds the controller's watchdog as a command does.

        Raises
        ------
        DeviceConnectionError
            If no whole set of process data with the mark comes.
        DeviceError
            If no two of them agree.
        """
        seen: list[bytes] = []
        odd = False
        before = b""
        for number in range(MOST_READINGS):
            if line.restarted:
                break
            if number:
                line.repeats += 1
            found = line.synchronize(self._heads, before)
            before = b""
            if not (found or line.resends):
                break
            if found and found[1][8:] == self._mark_digits:
                first, second = found[0] + found[1][:8], found[2] + found[3][:8]
                obeyed = _decoded(_COMMAND, found[3][8:])
                expected = obeyed is not None and abs(obeyed[0] - command) <= 1
                agreed = first if first == second and not seen else _most_frequent([*seen, first, second])
                if agreed is not None and obeyed is not None and (expected or odd):
                    report = _decoded(_REPORT, agreed)
                    if report is not None:
                        power, battery, current, faults, flags = report
                        return Report(power, battery, current, faults, flags, obeyed[0])
                odd = odd or (obeyed is not None and not expected)
                seen += [first, second]
            elif may_write():
                before = self.next_mark()
        if seen:
            raise DeviceError(self._device, "its process data do not agree with each other; check the adapter's line")
        line.resends = 0
        raise DeviceConnectionError(
            self._device, "no process data follow a SYNC within the timeout; check power, cable and state of the node"
        )

    def _map(
        self, line: NodeLine, parameters: int, mapping: int, identifier: int, objects: _Mapping, kind: int
    ) -> None:
        """Configure a PDO, which is destroyed meanwhile; raises `AbortedError` if the controller does not take it."""
        cob_id = Entry(parameters, "identifier of a PDO", 4)
        line.write(cob_id, _DESTROYED | identifier + self._node, 1)
        line.write(Entry(mapping, "number of mapped objects", 1), 0, 0)
        for place, (index, sub, bits) in enumerate(objects):
            line.write(Entry(mapping, "mapped object", 4), index << 16 | sub << 8 | bits, 1 + place)
        line.write(Entry(mapping, "number of mapped objects", 1), len(objects), 0)
        line.write(Entry(parameters, "transmission type of a PDO", 1), kind, 2)
        line.write(cob_id, identifier + self._node, 1)


def _most_frequent(copies: Sequence[bytes]) -> bytes | None:
    """Return what has come twice at least, and more often than anything else; None if there is no such thing."""
    (copy, count), *others = Counter(copies).most_common(2)
    return copy if count > 1 and not (others and others[0][1] == count) else None


def _decoded(form: struct.Struct, digits: bytes) -> tuple[int, ...] | None:
    """Return the numbers of some hexadecimal digits, none if a digit is none."""
    try:
        return form.unpack(unhexlify(digits))
    except ValueError:
        return None
