"""Which protocols fit a rig, as far as its file says; nothing is connected."""

from __future__ import annotations

from bench.devices import Device, Signal
from bench.protocol.parameters import ProtocolDefinition
from bench.rig import RigFile


def fits(definition: ProtocolDefinition, file: RigFile) -> bool:
    """Return whether a rig file binds every slot of a protocol, or has every device that it names."""
    drivers = {entry.name: entry.driver for entry in file.devices}
    return all(_is_bound(slot, kind, file, drivers) for slot, kind in definition.slots.items()) and all(
        any(name == device or name.startswith(f"{device}_") for device in drivers) or name in file.derived
        for name in definition.names
    )


def _is_bound(slot: str, kind: type[Device] | type[Signal], file: RigFile, drivers: dict[str, type[Device]]) -> bool:
    table = file.roles.get(slot)
    if table is None:
        return False
    return kind is Signal or (table.device in drivers and issubclass(drivers[table.device], kind))
