"""A rig: connected devices, the signals that they give, and the slots that protocols ask for."""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from enum import StrEnum
from functools import cached_property, partial
from types import TracebackType
from typing import Any, Self, TypeVar

from bench.base import (
    BUSY,
    Clock,
    ConfigurationError,
    DeviceConnectionError,
    DeviceError,
    VirtualClock,
    closest,
    make_clock,
    slowness,
)
from bench.devices import (
    Actuator,
    BlockPlayer,
    Device,
    DeviceDescription,
    DriverSettings,
    Floats,
    JointReader,
    LoadCell,
    Signal,
    check_signal_names,
)
from bench.rig.calibration import Calibrated
from bench.rig.derived import Derived, DerivedSignal
from bench.rig.description import RigDescription
from bench.rig.file import DeviceEntry, Laboratory, RigFile
from bench.rig.interlocks.config import SETPOINT
from bench.rig.maintenance.safe_state import SAFE, make_safe
from bench.rig.readables import ReadableSignal
from bench.rig.slots import check_roles

T = TypeVar("T")


class Look(StrEnum):
    """How the devices of a rig are read."""

    MEASURE = "measure"
    """The best reading of every signal."""
    GLANCE = "glance"
    """A quick reading of every signal."""
    SAMPLE = "sample"
    """The best reading of the signals that are wanted, a quick one of all others."""
    PART = "part"
    """A quick reading of the devices that the signals that are wanted come from, and of no other."""


class Rig:
    """Connected devices, and the signals that they give.

    Use it as a context manager: leaving it brings every device into its safe state, then closes every line that
    can still be closed. `close` closes the lines only.

    Parameters
    ----------
    file : RigFile
        What to connect.
    clock : Clock
        The clock of the run.
    seed : int
        Seed of everything random in an emulated laboratory.
    when_built : callable, optional
        Called between the making of an emulated laboratory and the connecting of the first device.

    Raises
    ------
    DeviceConnectionError
        If a device does not answer; those connected before are closed again.
    """

    def __init__(self, file: RigFile, clock: Clock, seed: int, when_built: Callable[[], None] | None = None) -> None:
        self.file = file
        self.clock = clock
        self.devices: dict[str, Device] = {}
        self.laboratory: Laboratory | None = None
        with ExitStack() as stack:
            ports: Mapping[str, str] = {}
            if file.laboratory is not None:
                self.laboratory = file.laboratory(file.laboratory_settings, clock, seed)
                ports = self.laboratory.open()
                stack.callback(self.laboratory.close)
            if when_built is not None:
                when_built()
            for entry in file.devices:
                settings = entry.wired(ports, file.path)
                device = _connected(entry, settings, clock)
                stack.callback(_close, device)
                self.devices[entry.name] = device
            self.derived: dict[str, Derived] = {}
            self.signals = self._bind_signals()
            self._setpoint_names = {name: f"{name}{SETPOINT}" for name in self.actuators}
            self._read_before: dict[tuple[Look, frozenset[str]], dict[str, Callable[[], dict[str, float]]]] = {}
            described = RigDescription(file, self._describe_devices(), self.signals)
            self.signals = tuple(
                replace(each, extent=described.extent(each.name) or each.extent) for each in self.signals
            )
            self.description = replace(described, signals=self.signals)
            self._check_references()
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._make_safe(error)
        finally:
            self.close()

    def _make_safe(self, error: BaseException | None) -> None:
        """Make every device safe; where one is not, raise DeviceError, or note it on an error that is on its way."""
        unsafe = {name: state for name, state in make_safe(self.devices.values()).items() if state != SAFE}
        if unsafe:
            message = "; ".join(f"NOT in its safe state: {state}" for state in unsafe.values())
            failure = DeviceError(", ".join(unsafe), message)
            if error is None:
                raise failure
            error.add_note(str(failure))

    def safely(self, plan: Generator[Any, Any, T]) -> Generator[Any, Any, T]:
        """Return a plan of bluesky that leaves every device safe by whatever way it ends: done, failed, aborted.

        Raises
        ------
        DeviceError
            At the end of the plan, if a device did not confirm its safe state.
        """
        try:
            result = yield from plan
        except BaseException as error:
            self._make_safe(error)
            raise
        self._make_safe(None)
        return result

    def close(self) -> None:
        """Close every line that can still be closed; each device keeps the state that it is in."""
        self._stack.close()

    @cached_property
    def actuators(self) -> dict[str, Actuator]:
        """The devices that take a set-point, by name."""
        return {name: device for name, device in self.devices.items() if isinstance(device, Actuator)}

    def actuator(self, name: str) -> Actuator:
        """Return a device that takes a set-point; raises ConfigurationError if there is none of that name."""
        self.description.limits_of(name)
        return self.actuators[name]

    @cached_property
    def readables(self) -> dict[str, Device | ReadableSignal]:
        """What bluesky can read, by name: the devices, the set-points and the derived signals of the rig.

        A derived signal measures the devices that it comes from each time it is read.
        """
        found: dict[str, Device | ReadableSignal] = dict(self.devices)
        for name, actuator in self.actuators.items():
            signal = actuator.setpoint_signal
            take = partial(getattr, actuator, "setpoint")
            found[signal.name] = ReadableSignal(signal, self.clock, take, f"{name}:setpoint")
        for signal in self.signals:
            if signal.name in self.derived:
                take = partial(self._derive, signal.name)
                found[signal.name] = ReadableSignal(signal, self.clock, take, f"derived:{signal.name}")
        return found

    def _derive(self, name: str) -> float:
        """Measure what a derived signal comes from, and compute it."""
        sources = self.sources([name])
        readings = {}
        for device_name, device in self.devices.items():
            own = {signal.name for signal in device.signals} | {self._setpoint_names.get(device_name, "")}
            if own & sources:
                readings[device_name] = device.measure()
        return self.assembled(readings)[name]

    def load_cell(self, name: str) -> LoadCell:
        """Return a load cell; raises ConfigurationError if there is none of that name."""
        device = self.devices.get(name)
        if not isinstance(device, LoadCell):
            known = closest(name, (key for key, each in self.devices.items() if isinstance(each, LoadCell)))
            raise ConfigurationError(f"{name} is not a load cell; {known}")
        return device

    @property
    def setpoints(self) -> dict[str, float]:
        """The set-points that were last sent, by device; nan before the first."""
        return {name: actuator.setpoint for name, actuator in self.actuators.items()}

    def check(self, setpoints: Mapping[str, Sequence[float]]) -> None:
        """Raise LimitError if a device does not take one of its set-points; nothing is sent."""
        for name, values in setpoints.items():
            actuator = self.actuator(name)
            for value in values:
                actuator.check(value)

    def measure(self) -> dict[str, float]:
        """Take the best reading of every signal; raises what the devices raise."""
        return self._collect(self.readers(Look.MEASURE))

    def glance(self) -> dict[str, float]:
        """Take a quick reading of every signal; raises what the devices raise."""
        return self._collect(self.readers(Look.GLANCE))

    def sample(self, wanted: Collection[str]) -> dict[str, float]:
        """Take the best reading of the signals that are wanted, and a quick one of all others."""
        return self._collect(self.readers(Look.SAMPLE, wanted))

    def readers(self, look: Look, wanted: Collection[str] = ()) -> dict[str, Callable[[], dict[str, float]]]:
        """Return what a look asks of each device, by name; `assembled` takes what they return.

        Devices on different lines may be asked at the same time.
        """
        key = look, frozenset(wanted)
        read = self._read_before.get(key)
        if read is None:
            # The same few looks are taken again and again.
            read = self._read_before[key] = self._make_readers(*key)
        return read

    def _make_readers(self, look: Look, wanted: Collection[str]) -> dict[str, Callable[[], dict[str, float]]]:
        sources = self.sources(wanted)
        read = {}
        for name, device in self.devices.items():
            is_wanted = bool(sources) and any(signal.name in sources for signal in device.signals)
            best = look is Look.MEASURE or (look is Look.SAMPLE and is_wanted)
            if best or is_wanted or look is not Look.PART:
                read[name] = device.measure if best else device.glance
        return read

    def watching(self, signals: Collection[str]) -> dict[str, Callable[[], dict[str, float]]]:
        """Return what a look at the interlocks asks of each device, by name: for signals, and to feed watchdogs."""
        readers = {name: actuator.glance for name, actuator in self.actuators.items()}
        readers.update(self.readers(Look.PART, signals))
        return {name: readers[name] for name in self.devices if name in readers}

    def quick_reader(self, wanted: Collection[str]) -> Callable[[], dict[str, float]]:
        """Return a function that takes a quick reading of the devices that some signals come from, and of no other.

        It returns what these devices deliver and the derived ones of the signals; set-points are not among them.
        """
        sources = self.sources(wanted)
        names = self.readers(Look.PART, wanted)
        readers = _quick_readers([self.devices[name] for name in names])
        derived = [(name, each.compute) for name, each in self.derived.items() if name in sources]
        if len(readers) == 1 and not derived:
            return readers[0]

        first, others = readers[0] if readers else dict[str, float], readers[1:]

        def read() -> dict[str, float]:
            values = first()
            for reader in others:
                values.update(reader())
            for name, compute in derived:
                values[name] = compute(values)
            return values

        return read

    def block_player(
        self, inputs: Sequence[str], actuators: Sequence[str], period: float
    ) -> Callable[[Floats], Floats] | None:
        """Return what has an instrument carry out blocks of samples by itself; None if none can.

        It takes and returns what `bench.devices.BlockPlayer.play` does, of signals and actuators in their order.
        """
        if len(actuators) != 1:
            return None
        player = self.devices[actuators[0]]
        if not isinstance(player, BlockPlayer):
            return None
        for sensor in self.devices.values():
            if tuple(signal.name for signal in sensor.signals) == tuple(inputs) and player.can_play(sensor, period):
                return partial(_play, player, sensor, period)
        return None

    def sources(self, wanted: Collection[str]) -> set[str]:
        """Return signals, and those that the derived ones among them come from."""
        sources = {*wanted}
        # Each derived signal comes from what stands before it.
        for name, derived in reversed(list(self.derived.items())):
            if name in sources:
                sources.update(derived.sources)
        return sources

    def _collect(self, readers: Mapping[str, Callable[[], dict[str, float]]]) -> dict[str, float]:
        return self.assembled({name: read() for name, read in readers.items()})

    def assembled(self, readings: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
        """Return the values of all signals from the readings of some devices, or of all.

        Set-points and readings are those of these devices, derived signals those whose sources are among them.
        """
        values: dict[str, float] = {}
        setpoint_names = self._setpoint_names
        for name, reading in readings.items():
            values.update(reading)
            if name in setpoint_names:
                values[setpoint_names[name]] = self.actuators[name].setpoint
        is_whole = len(readings) == len(self.devices)
        for name, derived in self.derived.items():
            if is_whole or all(source in values for source in derived.sources):
                values[name] = derived.compute(values)
        return values

    def _describe_devices(self) -> dict[str, DeviceDescription]:
        described = {}
        for name, device in self.devices.items():
            try:
                described[name] = DeviceDescription.of(device)
            # Limits in the wrong order, say, which its settings did not check.
            except ValueError as error:
                raise ConfigurationError(f"{self.file.path}: devices.{name}: {error}") from None
        return described

    def _bind_signals(self) -> tuple[Signal, ...]:
        """Return the signals of devices and derived ones, in the order in which they are computed."""
        signals: list[Signal] = []
        for device in self.devices.values():
            if isinstance(device, Actuator):
                signals.append(device.setpoint_signal)
            signals.extend(device.signals)
        units = {signal.name: signal.unit for signal in signals}
        for name, derived in self.file.derived.items():
            key = f"{self.file.path}: derived.{name}"
            for source in derived.sources:
                if source not in units:
                    # The key that names it, or the expression that it stands in.
                    named = {value: field for field, value in derived if isinstance(value, str)}
                    where = f"{named[source]} = {source!r}" if source in named else f"expression: {source!r}"
                    raise ConfigurationError(
                        f"{key}.{where}: there is no such signal, or it comes from this one; {closest(source, units)}"
                    )
            try:
                self._check_instrument(derived)
                self.derived[name] = derived.bind(name, {source: units[source] for source in derived.sources})
            except ValueError as error:
                raise ConfigurationError(f"{key}.{error}") from None
            signals.append(self.derived[name].signal)
            units[name] = signals[-1].unit
        return tuple(signals)

    def _check_instrument(self, derived: DerivedSignal) -> None:
        """Raise ValueError if a calibration is of another instrument than the one that answers."""
        if not isinstance(derived, Calibrated) or not (expected := derived.calibration.serial_number):
            return
        for name, device in self.devices.items():
            identity = device.identity
            is_source = any(signal.name == derived.source for signal in device.signals)
            if is_source and identity.tells_serial_number and identity.serial_number != expected:
                raise ValueError(
                    f"calibration: is of the instrument with serial number {expected}, but {name} has "
                    f"{identity.serial_number}; calibrate {name}, or connect the one that was calibrated"
                )

    def _check_references(self) -> None:
        path = self.file.path
        try:
            check_signal_names([signal.name for signal in self.signals])
        except ConfigurationError as error:
            raise ConfigurationError(f"{path}: {error}") from None
        used = [(f"interlocks.{i}.signal", lock.signal) for i, lock in enumerate(self.file.interlocks)]
        if self.file.dashboard is not None:
            for prefix, plot in self.file.dashboard.plots.items():
                used += [(f"dashboard.{prefix}input", plot.input), (f"dashboard.{prefix}output", plot.output)]
        for key, signal in used:
            if signal not in self.description.by_name:
                known = closest(signal, self.description.by_name)
                raise ConfigurationError(f"{path}: {key} = {signal!r}: there is no such signal; {known}")
        self.description.uncertain()
        check_roles(self.file.roles, self.description.devices, self.description.by_name, path)


def clock_for(file: RigFile, name: str) -> Clock:
    """Make the clock of a run on a rig: `wall`, `virtual` or `xN`; see `bench.base.clock.make_clock`.

    Raises ConfigurationError if there is no such clock, or real devices are asked to follow another than `wall`.
    """
    clock = make_clock(name, in_process=file.in_process)
    if name != "wall" and not file.in_process:
        raise ConfigurationError(f"rig {file.name} has real devices, which know only the wall clock")
    return clock


def _quick_readers(devices: Sequence[Device]) -> list[Callable[[], dict[str, float]]]:
    """Return what takes quick readings of devices in their order; neighbours that can be read in one request are."""
    readers: list[Callable[[], dict[str, float]]] = []
    first = 0
    while first < len(devices):
        device, end = devices[first], first + 1
        reader = device.glance
        if isinstance(device, JointReader):
            while end < len(devices) and device.joins(devices[end]):
                end += 1
            if end > first + 1:
                reader = device.joined(devices[first + 1 : end])
        readers.append(reader)
        first = end
    return readers


def _play(player: BlockPlayer, sensor: Device, period: float, setpoints: Floats) -> Floats:
    return player.play(setpoints[:, 0], period, sensor)


def _connected(entry: DeviceEntry, settings: DriverSettings, clock: Clock) -> Device:
    """Connect a device; while the computer is busy once more if it does not answer, as nothing moves yet."""
    connect: Callable[[], Device] = partial(entry.driver.connect, entry.name, settings, clock)
    try:
        return connect()
    except DeviceConnectionError:
        # On a virtual clock nothing is late.
        if isinstance(clock, VirtualClock) or slowness() < BUSY:
            raise
    return connect()


def _close(device: Device) -> None:
    # A line that is gone cannot be closed either; that must not hide how the run ended.
    with suppress(Exception):
        device.close()
