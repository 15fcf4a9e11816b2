"""A rig file becomes connected devices with limits.

A rig file is TOML::

    [rig]
    title = "VO2 microcantilever"

    [devices.tec]                                  # any name; its signals are named after it
    driver = "drivers.meerstetter:MeerstetterTEC"  # module:class, loaded by name
    port = "/dev/ttyUSB0"                          # all other keys are the driver's own
    ...

    [derived.curvature]                            # signals computed from measured ones
    kind = "cantilever-curvature"
    source = "psd_position"
    length = 300e-6

    [[interlocks]]                                 # the run ends in the safe state outside of these
    signal = "tec_sink_temperature"
    high = 60.0

    [telemetry]
    period = 1.0                                   # s between two quick readings during holds

    [dashboard]                                    # what the live view draws against what
    input = "tec_temperature"
    output = "curvature"
    ...

    [[dashboard.loops]]                            # further loops beside the first
    input = "tec_current"
    output = "curvature"
    ...

    [emulation]                                    # only in the rig file of an emulated rig
    laboratory = "rigs.vo2.laboratory:VO2Laboratory"
    ...

Unknown keys are errors. A port `emulated://NAME` is wired to the instrument of that name in the emulated
laboratory; any other port is the real one.
"""

from __future__ import annotations

import importlib
import tomllib
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, ClassVar, Protocol, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from bench.calibration import DerivedSignal
from bench.clock import Clock
from bench.devices import Actuator, Device, DriverSettings, Signal, role_of
from bench.errors import ConfigurationError
from bench.journal import check_names
from bench.safety import Interlock
from bench.validation import problems


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RigTable(_Table):
    """The table `[rig]`."""

    title: str = Field(min_length=1, description="what the rig is, in one line")
    description: str = Field(default="", description="more about it, shown on the run card")


class TelemetryTable(_Table):
    """The table `[telemetry]`."""

    period: float = Field(default=1.0, ge=0.01, le=60, description="s between two quick readings in a hold")


def _check_range(ends: tuple[float, float]) -> tuple[float, float]:
    if not ends[0] < ends[1]:
        raise ValueError("expected two numbers, the lower one first")
    return ends


_Range = Annotated[tuple[float, float], AfterValidator(_check_range)]


class LoopTable(_Table):
    """A table `[[dashboard.loops]]`: one more loop of the live view."""

    input: str = Field(description="signal on the horizontal axis of the loop")
    output: str = Field(description="signal on the vertical axis of the loop")
    input_range: _Range = Field(description="ends of the horizontal axis")
    output_range: _Range = Field(description="ends of the vertical axis")


class DashboardTable(LoopTable):
    """The table `[dashboard]`: the hysteresis loops and the Preisach plane of the live view."""

    input: str = Field(description="signal on the horizontal axis of the loop, and input of the plane")
    plane: _Range = Field(description="ends of both axes of the Preisach plane")
    levels: int = Field(default=20, ge=2, le=200, description="discretization levels drawn on the plane")
    loops: tuple[LoopTable, ...] = Field(default=(), description="further loops")


class _RigFileContent(_Table):
    rig: RigTable
    devices: dict[str, dict[str, Any]] = Field(min_length=1, description="one table a device")
    derived: dict[str, DerivedSignal] = Field(default_factory=dict)
    interlocks: tuple[Interlock, ...] = ()
    telemetry: TelemetryTable = TelemetryTable()
    dashboard: DashboardTable | None = None
    emulation: dict[str, Any] | None = None


class LaboratorySettings(BaseModel):
    """Base of what the table `[emulation]` may say; a laboratory extends it with its own keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Laboratory(Protocol):
    """An emulated laboratory: a plant and the instruments around it."""

    Settings: ClassVar[type[LaboratorySettings]]

    def __init__(self, settings: Any, clock: Clock, seed: int) -> None:  # noqa: ANN401 - its own Settings
        """Set it up; all that is random comes from `seed`."""

    def open(self) -> Mapping[str, str]:
        """Switch the instruments on; return the port of each by its name in `emulated://NAME`."""

    def operate(self, task: str, value: float) -> None:
        """Do by hand what a protocol's prompt asks for; raise ConfigurationError for a task that it cannot do."""

    def close(self) -> None:
        """Switch everything off."""


class _Driver(Protocol):
    Settings: ClassVar[type[DriverSettings]]

    @classmethod
    def connect(cls, name: str, settings: Any, clock: Clock) -> Device: ...  # noqa: ANN401


@dataclass(frozen=True)
class DeviceEntry:
    """One device of a rig file: its driver class and that driver's validated settings."""

    name: str
    driver: Any
    settings: DriverSettings


@dataclass(frozen=True)
class RigFile:
    """A rig file that was read and found right; nothing is connected.

    Attributes
    ----------
    name : str
        Name of the packaged rig, or the file's name without its ending.
    path : str
        Where it was read from, for messages.
    text : str
        The file as it is, kept with every run.
    """

    name: str
    path: str
    text: str
    rig: RigTable
    devices: tuple[DeviceEntry, ...]
    derived: Mapping[str, DerivedSignal]
    interlocks: tuple[Interlock, ...]
    telemetry: TelemetryTable
    dashboard: DashboardTable | None
    laboratory: Any | None
    laboratory_settings: LaboratorySettings | None

    @property
    def emulated(self) -> bool:
        """Whether the rig brings its own emulated laboratory."""
        return self.laboratory is not None


def packaged_rigs() -> tuple[str, ...]:
    """Return the names of the rigs that come with the bench."""
    return tuple(sorted(_packaged()))


def _packaged() -> dict[str, Traversable]:
    folders = (folder for folder in resources.files("rigs").iterdir() if folder.is_dir())
    files = (file for folder in folders for file in folder.iterdir() if file.name.endswith(".toml"))
    return {file.name.removesuffix(".toml"): file for file in files}


def load_rig(name: str, overrides: Mapping[str, str] | None = None) -> RigFile:
    """Read a rig file.

    Parameters
    ----------
    name : str
        Name of a packaged rig, or path of a file that ends in `.toml`.
    overrides : mapping of str to str, optional
        Values by dotted key, such as `{"devices.tec.port": "/dev/ttyUSB1"}`, that replace the file's.

    Raises
    ------
    ConfigurationError
        If there is no such rig, or the file is wrong: names file, key, value and what is allowed.
    """
    path, text = _read(name)
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigurationError(f"{path}: not valid TOML: {error}") from None
    for key, value in (overrides or {}).items():
        _override(content, key, value, path)
    return _validate(Path(path).name.removesuffix(".toml"), path, text, content)


class Rig:
    """Connected devices, and the signals that they give.

    Use it as a context manager: leaving it closes every line that still can be closed. It does not bring the
    devices into their safe state; whoever moves them does (the engine, always).

    Parameters
    ----------
    file : RigFile
        What to connect.
    clock : Clock
        The clock of the run.
    seed : int
        Seed of everything random in an emulated laboratory.

    Raises
    ------
    DeviceConnectionError
        If a device does not answer; those connected before are closed again.
    """

    def __init__(self, file: RigFile, clock: Clock, seed: int) -> None:
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
            for entry in file.devices:
                settings = _wired(entry, ports, file.path)
                device: Device = entry.driver.connect(entry.name, settings, clock)
                stack.callback(_close, device)
                self.devices[entry.name] = device
            self.signals = self._signals()
            self._check_references()
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    @property
    def actuators(self) -> dict[str, Actuator]:
        """The devices that take a set-point, by name."""
        return {name: device for name, device in self.devices.items() if isinstance(device, Actuator)}

    def measure(self) -> dict[str, float]:
        """Take the best reading of every signal; raises what the devices raise."""
        return self._collect(lambda device: device.measure())

    def glance(self) -> dict[str, float]:
        """Take a quick reading of every signal; raises what the devices raise."""
        return self._collect(lambda device: device.glance())

    def sample(self, wanted: Collection[str]) -> dict[str, float]:
        """Take the best reading of the signals that are wanted, and a quick one of all others."""
        sources = self._sources(wanted)
        return self._collect(
            lambda device: (
                device.measure() if any(signal.name in sources for signal in device.signals) else device.glance()
            )
        )

    def quick_reader(self, wanted: Collection[str]) -> Callable[[], dict[str, float]]:
        """Return a function that takes a quick reading of the devices that some signals come from, and of no other.

        It returns what these devices deliver and the derived ones of the signals; set-points are not among them.
        """
        sources = self._sources(wanted)
        readers = [
            device.glance
            for device in self.devices.values()
            if any(signal.name in sources for signal in device.signals)
        ]
        derived = [(name, each) for name, each in self.file.derived.items() if name in sources]

        def read() -> dict[str, float]:
            values: dict[str, float] = {}
            for reader in readers:
                values.update(reader())
            for name, each in derived:
                values[name] = each.compute(name, values)
            return values

        return read

    def _sources(self, wanted: Collection[str]) -> set[str]:
        """Return signals, and those that the derived ones among them come from."""
        sources = {*wanted}
        # Each derived signal comes from what stands before it.
        for name, derived in reversed(list(self.file.derived.items())):
            if name in sources:
                sources.add(derived.source)
        return sources

    def check_needs(self, protocol: str, needs: Sequence[str]) -> None:
        """Check that everything a protocol needs is there.

        Raises
        ------
        ConfigurationError
            If a device or a signal is missing.
        """
        have = {*self.devices, *(signal.name for signal in self.signals)}
        missing = [need for need in needs if need not in have]
        if missing:
            raise ConfigurationError(
                f"protocol {protocol} needs {', '.join(missing)}, which rig {self.file.name} does not have; "
                f"it has: {', '.join(sorted(have))}"
            )

    def _collect(self, ask: Callable[[Device], dict[str, float]]) -> dict[str, float]:
        values: dict[str, float] = {}
        for name, device in self.devices.items():
            values.update(ask(device))
            if isinstance(device, Actuator):
                values[f"{name}_setpoint"] = device.setpoint
        for name, derived in self.file.derived.items():
            values[name] = derived.compute(name, values)
        return values

    def _signals(self) -> tuple[Signal, ...]:
        signals: list[Signal] = []
        for device in self.devices.values():
            if isinstance(device, Actuator):
                signals.append(device.setpoint_signal)
            signals.extend(device.signals)
        signals.extend(derived.signal(name) for name, derived in self.file.derived.items())
        return tuple(signals)

    def _check_references(self) -> None:
        names = [signal.name for signal in self.signals]
        try:
            check_names(names)
        except ConfigurationError as error:
            raise ConfigurationError(f"{self.file.path}: {error}") from None
        known = ", ".join(names)
        used = [(f"interlocks.{i}.signal", lock.signal) for i, lock in enumerate(self.file.interlocks)]
        if self.file.dashboard is not None:
            loops: dict[str, LoopTable] = {"dashboard": self.file.dashboard}
            loops |= {f"dashboard.loops.{i}": loop for i, loop in enumerate(self.file.dashboard.loops)}
            for key, loop in loops.items():
                used += [(f"{key}.input", loop.input), (f"{key}.output", loop.output)]
        for key, signal in used:
            if signal not in names:
                raise ConfigurationError(
                    f"{self.file.path}: {key} = {signal!r}: there is no such signal; there are: {known}"
                )
        # They are computed in their order in the file, each from what is there by then.
        units = {signal.name: signal.unit for signal in self.signals if signal.name not in self.file.derived}
        for name, derived in self.file.derived.items():
            key = f"{self.file.path}: derived.{name}.source = {derived.source!r}"
            if derived.source not in units:
                raise ConfigurationError(
                    f"{key}: there is no such signal, or it is derived further down; there are: {', '.join(units)}"
                )
            if units[derived.source] != derived.source_unit:
                raise ConfigurationError(
                    f"{key}: is in {units[derived.source]}; a {derived.kind} is computed from {derived.source_unit}"
                )
            units[name] = derived.signal(name).unit


def _read(name: str) -> tuple[str, str]:
    if name.endswith(".toml"):
        try:
            return name, Path(name).read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigurationError(f"rig file {name} cannot be read: {error}") from None
    if name not in packaged_rigs():
        raise ConfigurationError(
            f"there is no rig {name!r}; there are: {', '.join(packaged_rigs())} "
            "(or a file of your own, path/to/rig.toml)"
        )
    return f"{name}.toml", _packaged()[name].read_text(encoding="utf-8")


def _override(content: dict[str, Any], key: str, value: str, path: str) -> None:
    *parents, last = key.split(".")
    table: Any = content
    for part in parents:
        table = table.get(part) if isinstance(table, dict) else None
    if not isinstance(table, dict):
        raise ConfigurationError(f"{path}: there is no table {'.'.join(parents)!r} in which {last!r} could be set")
    try:
        table[last] = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        table[last] = value


def _validate(name: str, path: str, text: str, content: Mapping[str, Any]) -> RigFile:
    found: list[str] = []
    try:
        tables = _RigFileContent.model_validate(content)
    except ValidationError as error:
        raise ConfigurationError("\n".join(f"{path}: {line}" for line in problems(error, _RigFileContent))) from None
    entries: list[DeviceEntry] = []
    for device, table in tables.devices.items():
        options = dict(table)
        try:
            driver = _load(options.pop("driver", None), f"devices.{device}.driver", DriverSettings, "connect")
            try:
                role_of(driver)
            except TypeError as error:
                raise ConfigurationError(f"devices.{device}.driver = {table['driver']!r}: {error}") from None
            entries.append(DeviceEntry(device, driver, driver.Settings.model_validate(options)))
        except ValidationError as error:
            found.extend(problems(error, driver.Settings, f"devices.{device}."))
        except ConfigurationError as error:
            found.append(str(error))
    laboratory: Any = None
    settings: LaboratorySettings | None = None
    if tables.emulation is not None:
        options = dict(tables.emulation)
        try:
            laboratory = _load(options.pop("laboratory", None), "emulation.laboratory", LaboratorySettings, "open")
            settings = laboratory.Settings.model_validate(options)
        except ValidationError as error:
            found.extend(problems(error, laboratory.Settings, "emulation."))
        except ConfigurationError as error:
            found.append(str(error))
    if found:
        raise ConfigurationError("\n".join(f"{path}: {line}" for line in found))
    return RigFile(
        name=name,
        path=path,
        text=text,
        rig=tables.rig,
        devices=tuple(entries),
        derived=tables.derived,
        interlocks=tables.interlocks,
        telemetry=tables.telemetry,
        dashboard=tables.dashboard,
        laboratory=laboratory,
        laboratory_settings=settings,
    )


def _load(reference: object, key: str, settings: type[BaseModel], method: str) -> Any:  # noqa: ANN401 - any class
    if not isinstance(reference, str) or reference.count(":") != 1:
        raise ConfigurationError(
            f"{key} = {reference!r}: expected module:class, such as drivers.meerstetter:MeerstetterTEC"
        )
    module, _, name = reference.partition(":")
    try:
        imported = importlib.import_module(module)
    # A module of the user's own may fail in any way.
    except Exception as error:
        raise ConfigurationError(
            f"{key} = {reference!r}: the module cannot be loaded: {type(error).__name__}: {error}"
        ) from error
    loaded = getattr(imported, name, None)
    if loaded is None:
        raise ConfigurationError(f"{key} = {reference!r}: module {module} has no {name}")
    kind = getattr(loaded, "Settings", None)
    if not (isinstance(loaded, type) and isinstance(kind, type) and issubclass(kind, settings)):
        raise ConfigurationError(
            f"{key} = {reference!r}: is not a class with Settings that extend {settings.__name__}, "
            "so a rig file cannot use it"
        )
    if not callable(getattr(loaded, method, None)):
        raise ConfigurationError(f"{key} = {reference!r}: class {name} has no method {method}")
    return loaded


def _close(device: Device) -> None:
    # A line that is gone cannot be closed either; that must not hide how the run ended.
    with suppress(Exception):
        device.close()


def _wired(entry: DeviceEntry, ports: Mapping[str, str], path: str) -> DriverSettings:
    port = getattr(entry.settings, "port", "")
    scheme = "emulated://"
    if not isinstance(port, str) or not port.startswith(scheme):
        return entry.settings
    name = port.removeprefix(scheme)
    if name not in ports:
        known = ", ".join(scheme + other for other in ports) or "none: the rig has no [emulation]"
        raise ConfigurationError(
            f"{path}: devices.{entry.name}.port = {port!r}: the laboratory has no such instrument; there are: {known}"
        )
    return entry.settings.model_copy(update={"port": ports[name]})
