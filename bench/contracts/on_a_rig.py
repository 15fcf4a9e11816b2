"""Options, collection and fixtures for the contracts of devices on a rig; loaded by `bench.contracts.plugin`."""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from bench.base import BenchError, Clock, VirtualClock, WallClock
from bench.contracts import roles
from bench.devices import Actuator, Device
from bench.rig import DeviceEntry, Rig, RigFile, load_rig


@dataclass(frozen=True)
class _Subject:
    """The devices whose contracts run, and the rig that they are on."""

    file: RigFile
    entries: tuple[DeviceEntry, ...]


_SUBJECT = pytest.StashKey[_Subject]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options."""
    group = parser.getgroup("bench", "contracts of the bench")
    group.addoption("--device", metavar="MODULE:CLASS", help="class of the device, or its name in the rig file")
    group.addoption("--rig", help="name of a rig that is installed, or path/to/rig.toml")
    group.addoption(
        "--set-points",
        nargs=2,
        type=float,
        metavar=("FIRST", "SECOND"),
        help="between which an actuator moves; on an emulated rig a quarter and three quarters of its range",
    )


def pytest_sessionstart(session: pytest.Session) -> None:
    """Find the devices.

    Raises pytest.UsageError if an option is missing, the rig cannot be read, or it has no such device.
    """
    device, rig, set_points = (session.config.getoption(name) for name in ("device", "rig", "set_points"))
    if device is None or rig is None:
        raise pytest.UsageError(
            "the contracts need a device and its rig: --device MODULE:CLASS (or a name in the rig file) --rig RIG"
        )
    try:
        file = load_rig(rig)
    except BenchError as error:
        raise pytest.UsageError(str(error)) from None
    entries = _entries(file, device)
    if not file.emulated and set_points is None and any(issubclass(entry.driver, Actuator) for entry in entries):
        raise pytest.UsageError(
            f"{file.path} is a real rig, on which {device} will move; "
            "give the two values by --set-points FIRST SECOND"
        )
    session.config.stash[_SUBJECT] = _Subject(file, entries)


def _entries(file: RigFile, device: str) -> tuple[DeviceEntry, ...]:
    """Return the devices of a name or of a class."""
    named = tuple(entry for entry in file.devices if entry.name == device)
    if named:
        return named
    module, _, name = device.partition(":")
    found: tuple[DeviceEntry, ...] = ()
    if name:
        try:
            device_class = getattr(importlib.import_module(module), name)
        # A module of the user's own may fail in any way.
        except Exception as error:
            raise pytest.UsageError(
                f"--device {device}: cannot be loaded: {type(error).__name__}: {error}"
            ) from error
        found = tuple(entry for entry in file.devices if issubclass(entry.driver, device_class))
    if not found:
        known = ", ".join(
            f"{entry.name} ({entry.driver.__module__}:{entry.driver.__qualname__})" for entry in file.devices
        )
        raise pytest.UsageError(f"--device {device}: {file.path} has no such device; it has: {known}")
    return found


class ContractModule(pytest.Module):
    """The contracts of the roles that the devices play."""

    def collect(self) -> Iterable[pytest.Class]:
        """Return one class a contract."""
        subject = self.config.stash[_SUBJECT]
        contracts = {contract: None for entry in subject.entries for contract in roles.contracts_of(entry.driver)}
        for contract in contracts:
            yield pytest.Class.from_parent(self, name=contract.__name__, obj=contract)


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> ContractModule | None:
    """Collect the contracts, in place of a test module."""
    if file_path != Path(roles.__file__):
        return None
    return ContractModule.from_parent(parent, path=file_path)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run each contract for each device that plays its role."""
    if "device" in metafunc.fixturenames:
        names = [
            entry.name
            for entry in metafunc.config.stash[_SUBJECT].entries
            if metafunc.cls in roles.contracts_of(entry.driver)
        ]
        metafunc.parametrize("device", names, indirect=True)


@pytest.fixture
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    """Connect the rig, on the virtual clock if it is emulated; make its devices safe and close them afterwards."""
    file = request.config.stash[_SUBJECT].file
    with Rig(file, VirtualClock() if file.emulated else WallClock(), seed=0) as rig:
        yield rig


@pytest.fixture
def device(rig: Rig, request: pytest.FixtureRequest) -> Device:
    """Return the device under test."""
    return rig.devices[request.param]


@pytest.fixture
def clock(rig: Rig) -> Clock:
    """Return the clock of the rig."""
    return rig.clock
