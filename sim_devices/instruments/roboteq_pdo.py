"""The process data objects (PDO) of a Roboteq controller: which frames carry which objects, and when.

Source: Roboteq CANBus Networking Manual V2.0, tables 3-1 and 3-2, chapters PDO Mapping and PDO Transmission Type.
As delivered, the TPDOs carry the user variables 1 to 8 and the RPDOs write the variables 9 to 16, two each. A mapping
is changed while its PDO is destroyed (bit 31 of the identifier set) and its number of entries is 0.

Assumptions: TPDOs of type 254 and 255 are sent at their send rate (`^CTPS`), those of type 0 after each SYNC; the
types 241 to 253 are refused, and a remote frame is not answered; an RPDO counts on arrival, whatever its type.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from sim_devices.instruments.emulated import RequestRefusedError
from sim_devices.instruments.roboteq_objects import (
    DICTIONARY,
    FORMATS,
    MOST_MAPPED,
    PDOS,
    RECEIVE_MAPPING,
    TRANSMIT_MAPPING,
    TRANSMIT_PARAMETERS,
    AbortCode,
)

_DESTROYED = 1 << 31
_NO_REMOTE = 1 << 30
_LAST_SYNCHRONOUS, _FIRST_BY_TIME = 240, 254
_BITS = 64


Objects = tuple[tuple[int, int], ...]
"""Index and subindex of the objects that a PDO carries."""


@dataclass
class _Pdo:
    """One process data object."""

    transmitted: bool
    cob_id: int
    entries: list[int]
    kind: int = 255
    count: int = 2
    interval: float = 0.0
    due: float = math.inf
    syncs: int = field(default=0)
    _objects: Objects | None = field(default=None, init=False)

    @property
    def exists(self) -> bool:
        return not self.cob_id & _DESTROYED

    @property
    def identifier(self) -> int:
        return self.cob_id & 0x7FF

    @property
    def objects(self) -> Objects:
        """Index and subindex of what it carries, in order."""
        if self._objects is None:
            self._objects = tuple((entry >> 16, entry >> 8 & 0xFF) for entry in self.entries[: self.count])
        return self._objects

    def map(self, place: int, entry: int) -> None:
        """Map an object to a place from 0 on, which does not count before `count` is set."""
        self.entries[place] = entry
        self._objects = None

    def carry(self, count: int) -> None:
        """Carry the first objects that are mapped, so many."""
        self.count, self._objects = count, None


class ProcessDataObjects:
    """The configuration of the four TPDOs and the four RPDOs of a node.

    Parameters
    ----------
    node : int
        CANopen node.
    send_rates : sequence of int
        Interval of each TPDO of type 254 or 255, ms; 0 for never (`^CTPS`).
    now : float
        Laboratory time, s.
    """

    def __init__(self, node: int, send_rates: Sequence[int], now: float) -> None:
        self._node = node
        self._intervals = [1e-3 * milliseconds for milliseconds in send_rates]
        self._asked_always: tuple[tuple[int, Objects], ...] | None = None
        self._received: dict[int, Objects] = {}
        self.reset(now)

    def reset(self, now: float) -> None:
        """Return to the configuration as delivered."""
        self._transmit = [_pdo(True, number, self._node, 0x2106, 0x180) for number in range(PDOS)]
        self._receive = [_pdo(False, number, self._node, 0x2005, 0x200) for number in range(PDOS)]
        self._scheduled = []
        self._changed()
        for pdo, interval in zip(self._transmit, self._intervals, strict=True):
            if interval:
                pdo.interval, pdo.due = interval, now + interval
                self._scheduled.append(pdo)

    def read(self, index: int, sub: int) -> int:
        """Return an object of the configuration, which must be in the dictionary."""
        pdo, mapping = self._at(index)
        if mapping:
            return pdo.entries[sub - 1] if sub else pdo.count
        return (2, pdo.cob_id, pdo.kind)[sub]

    def write(self, index: int, sub: int, value: int) -> None:
        """Set an object of the configuration, which must be in the dictionary.

        Raises `RequestRefusedError` if the value makes no sense, or the PDO must be destroyed first.
        """
        self._changed()
        pdo, mapping = self._at(index)
        if mapping:
            if pdo.exists or (sub and pdo.count):
                raise RequestRefusedError(AbortCode.UNSUPPORTED)
            if sub:
                pdo.map(sub - 1, value)
            else:
                _check_mapping(pdo, value)
                pdo.carry(value)
        elif sub == 1:
            if value & ~(_DESTROYED | _NO_REMOTE | 0x7FF):
                raise RequestRefusedError(AbortCode.VALUE)
            pdo.cob_id = value
        else:
            if _LAST_SYNCHRONOUS < value < _FIRST_BY_TIME:
                raise RequestRefusedError(AbortCode.VALUE)
            pdo.kind, pdo.syncs = value, 0

    def take_due(self, now: float) -> list[tuple[int, Objects]]:
        """Return identifier and objects of each TPDO that is due by its interval, once each."""
        due = []
        for pdo in self._scheduled:
            if pdo.due <= now:
                pdo.due += pdo.interval * (math.floor((now - pdo.due) / pdo.interval + 1e-6) + 1)
                if pdo.exists and pdo.kind >= _FIRST_BY_TIME:
                    due.append((pdo.identifier, pdo.objects))
        return due

    def next_due(self) -> float:
        """Return when the next TPDO is due by its interval, s; infinity if none is."""
        return min(
            (pdo.due for pdo in self._scheduled if pdo.exists and pdo.kind >= _FIRST_BY_TIME), default=math.inf
        )

    def take_synchronous(self) -> tuple[tuple[int, Objects], ...]:
        """Count a SYNC; return identifier and objects of each TPDO that it asks for."""
        if self._asked_always is not None:
            return self._asked_always
        asked = []
        for pdo in self._transmit:
            if pdo.kind <= _LAST_SYNCHRONOUS and pdo.exists:
                pdo.syncs += 1
                if pdo.syncs >= pdo.kind:
                    pdo.syncs = 0
                    asked.append((pdo.identifier, pdo.objects))
        answer = tuple(asked)
        if all(pdo.kind <= 1 or pdo.kind > _LAST_SYNCHRONOUS for pdo in self._transmit):
            self._asked_always = answer
        return answer

    def received(self, identifier: int) -> Objects:
        """Return the objects that a frame with an identifier writes, none if it is no RPDO."""
        known = self._received.get(identifier)
        if known is None:
            existing = (pdo for pdo in self._receive if pdo.exists)
            known = next((pdo.objects for pdo in existing if pdo.identifier == identifier), ())
            self._received[identifier] = known
        return known

    def _changed(self) -> None:
        """Forget what is kept of the configuration."""
        self._asked_always = None
        self._received.clear()

    def _at(self, index: int) -> tuple[_Pdo, bool]:
        """Return the PDO that an object configures, and whether the object is its mapping."""
        base, number = index & ~0xFF, index & 0xFF
        pdos = self._transmit if base in (TRANSMIT_PARAMETERS, TRANSMIT_MAPPING) else self._receive
        return pdos[number], base in (TRANSMIT_MAPPING, RECEIVE_MAPPING)


def _pdo(transmitted: bool, number: int, node: int, index: int, identifier: int) -> _Pdo:
    first = 2 * number + (1 if transmitted else 9)
    mapped = [index << 16 | variable << 8 | 32 for variable in (first, first + 1)]
    cob_id = _NO_REMOTE * transmitted | (identifier + 0x100 * number + node)
    return _Pdo(transmitted, cob_id, mapped + [0] * (MOST_MAPPED - 2))


def _check_mapping(pdo: _Pdo, count: int) -> None:
    if count > MOST_MAPPED:
        raise RequestRefusedError(AbortCode.VALUE)
    total = 0
    for entry in pdo.entries[:count]:
        index, sub, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        row = DICTIONARY.get((index, sub))
        first = 0x2100 if pdo.transmitted else 0x2000
        if row is None or not first <= index < first + 0x100 or bits != 8 * FORMATS[row.kind].size:
            raise RequestRefusedError(AbortCode.NOT_MAPPABLE)
        total += bits
    if total > _BITS:
        raise RequestRefusedError(AbortCode.MAPPING_TOO_LONG)
