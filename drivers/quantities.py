"""Identity, signals, ranges and arrival of an instrument that the rig file describes."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from bench.base import Clock, DeviceConnectionError, DeviceError, DeviceRestartedError
from bench.devices import Identity, QuantityTable, Signal, Status, TargetTable, template

_ARRIVAL_INTERVAL = 0.1  # s


def signals_of(tables: Mapping[str, QuantityTable]) -> list[Signal]:
    """Return the signals of tables, by their names without that of the device."""
    return [
        Signal(name, table.unit, table.description or name.replace("_", " "), table.precision)
        for name, table in tables.items()
    ]


def check_ranges(device: str, tables: Mapping[str, QuantityTable], values: Mapping[str, float]) -> None:
    """Raise `DeviceError` if a reading is outside of the range of good ones."""
    for name, table in tables.items():
        if table.limits is not None and not table.limits[0] <= values[name] <= table.limits[1]:
            low, high = table.limits
            raise DeviceError(
                device,
                f"{name} is {values[name]:g} {table.unit}, outside of {low:g} to {high:g} {table.unit}; "
                "check instrument and wiring",
            )


def arrival_of(
    device: str, clock: Clock, target: TargetTable, value: float, read: Callable[[], Mapping[str, float]]
) -> Status:
    """Return the status of a set-point that was sent; `read` returns the quantities by name."""
    arrival = target.arrival
    if arrival is None:
        return Status.completed(device, clock)
    return Status(
        device,
        clock,
        lambda: abs(read()[arrival.signal] - value) <= arrival.tolerance,
        timeout=arrival.timeout,
        interval=_ARRIVAL_INTERVAL,
    )


def check_read_back(device: str, target: TargetTable, written: float, found: float, reported: str = "") -> None:
    """Raise `DeviceError` unless a set-point is read back as it was written; `reported` are its errors."""
    if not abs(found - written) <= target.tolerance * (1.0 + 1e-9):
        raise DeviceError(
            device,
            f"reads its set-point back as {found:g} {target.unit}, not {written:g} {target.unit}"
            f"{f' ({reported})' if reported else ''}; was it restarted, or set by another program or by hand?",
        )


def output_lost(device: str, *, setpoint_lost: bool, reported: str = "") -> DeviceError:
    """Return the error for an output that is off without the bench; `reported` are the instrument's own errors.

    An instrument that has also lost its set-point has restarted.
    """
    reported = f" ({reported})" if reported else ""
    if setpoint_lost:
        return DeviceRestartedError(
            device, f"its output is off and its set-point is lost: it has restarted{reported}; connect again"
        )
    return DeviceError(
        device,
        f"its output is off although it was switched on: a protection, a restart, or another program{reported}",
    )


def identity_of(answer: str) -> Identity:
    """Return the identity that an answer to `*IDN?` is: maker, model, serial number, firmware (IEEE 488.2, 10.14)."""
    fields = [field.strip() or "unknown" for field in answer.split(",", 3)]
    return Identity(*fields, *["unknown"] * (4 - len(fields)))


def expected_identity(device: str, port: str, answer: str, form: str) -> Identity:
    """Return the identity that an answer is; raise `DeviceConnectionError` if it has not the form of the rig file."""
    if template(form).match(answer) is None:
        raise DeviceConnectionError(
            device, f"{port} is {answer!r}, expected {form!r}; check the port, the address and the key identity"
        )
    return identity_of(answer)
