"""A rig file: devices, slots, derived signals, interlocks and limits.

A rig file is TOML::

    extends = "bench-rig"                          # optional: another rig, or a file beside this one
    without = ["emulation"]                        # optional: keys of the other that this one leaves out

    [rig]
    title = "a heated plate"
    twin = "twin.toml"                             # optional: the emulated rig on which runs are rehearsed

    [devices.plate]                                # any name; its signals are named after it
    driver = "drivers.meerstetter:MeerstetterTEC"  # module:Class, or a name registered in `bench.devices`
    port = "/dev/ttyUSB0"                          # all other keys are the driver's own
    ...

    [lines.bus]                                    # optional: a serial line that several devices share
    port = "/dev/ttyUSB1"                          # its keys count for each device with line = "bus"
    ...

    [roles.drive]                                  # what protocols ask for; see `bench.rig.slots`
    device = "plate"
    ...

    [protocols.creep]                              # parameters of a protocol on this rig, in place of its defaults
    start = 25.0

    [derived.bending]                              # signals computed from others; see `bench.rig.derived`
    expression = "2 * spot_position / length ** 2"
    ...

    [uncertainty.bending.length]                   # what is known of its uncertainty; see `bench.rig.uncertainty`
    ...

    [[interlocks]]                                 # the run ends in the safe state outside of these; what else
    signal = "plate_sink_temperature"              # an interlock can watch and do is in `bench.rig.interlocks`
    high = 60.0

    [safety]                                       # on hardware; these are the defaults
    rate = 5.0                                     # Hz, at which interlocks are looked at
    reconnect = 10.0                               # s for which a line may be lost
    patience = 10.0                                # s for which a protocol may compute
    order = []                                     # devices in the order of their safe state
    unattended = true                              # false: an operator stays with the rig

    [telemetry]
    period = 1.0                                   # s between two quick readings during holds

    [dashboard]                                    # what the live view draws against what
    input = "plate_temperature"
    output = "bending"
    ...

    [[dashboard.loops]]                            # further loops beside the first
    ...

    [emulation]                                    # only in the rig file of an emulated rig
    laboratory = "heated_plate:PlateLaboratory"    # module:Class, or a name registered in `bench.laboratories`
    ...

Unknown keys are errors. A port `emulated://NAME` is wired to the instrument of that name in the emulated
laboratory, `emulated://NAME+NAME` to several on one line; any other port is the real one.

A rig file is code: reading it imports the modules that it names. They are those of the bench, those of packages that
register a part (`bench.base.registry`), and those in the folder of the rig file; any other is refused.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import date, time
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, Protocol

from pydantic import BaseModel, Field, ValidationError

from bench.base import (
    CheckedTable,
    Clock,
    ConfigurationError,
    closest,
    difference_unit,
    in_si,
    is_quantity,
    parse_toml,
    problems,
    read_quantity,
    reason,
    registry,
)
from bench.devices import Device, DriverSettings
from bench.rig.calibration import read_calibration
from bench.rig.derived import DerivedSignal
from bench.rig.interlocks.config import Interlock
from bench.rig.layout import DashboardLayout
from bench.rig.maintenance.locks import ECHO, EMULATED, JOIN
from bench.rig.shared_lines import with_line, wrong_lines
from bench.rig.slots import RoleTable, rate_unit
from bench.rig.uncertainty import Component, Uncertainties

_DIFFERENCES = ("increment", "tolerance", "resolution", "accuracy", "drift", "noise")
"""Keys of rig files that are no values of a signal but differences of such."""


class RigTable(CheckedTable):
    """The table `[rig]`."""

    title: str = Field(min_length=1, description="what the rig is, in one line")
    description: str = Field(default="", description="more about it, shown on the run card")
    twin: str = Field(
        default="", description="emulated rig on which runs are rehearsed; the one that it extends if not given"
    )


class TelemetryTable(CheckedTable):
    """The table `[telemetry]`."""

    period: float = Field(default=1.0, ge=0.01, le=60, description="s between two quick readings in a hold")


class SafetyTable(CheckedTable):
    """The table `[safety]`: how a rig is guarded while a run goes on."""

    rate: float = Field(
        default=5.0,
        ge=0.1,
        le=50,
        description="looks at the interlocks of hardware, of their own, Hz",
    )
    reconnect: float = Field(
        default=10.0, ge=0, le=600, description="how long a line may be lost before the run ends, s; 0 for not at all"
    )
    patience: float = Field(
        default=10.0, gt=0, le=600, description="how long a protocol may compute between two of its messages, s"
    )
    order: tuple[str, ...] = Field(
        default=(), description="devices that are brought into their safe state one after another, in this order"
    )
    unattended: bool = Field(
        default=True,
        description="whether no operator is present, so that a device that heats needs a watchdog and an interlock",
    )


class _RigFileContent(CheckedTable):
    rig: RigTable
    devices: dict[str, dict[str, Any]] = Field(min_length=1, description="one table a device")
    lines: dict[str, dict[str, Any]] = Field(default_factory=dict, description="one table a line that devices share")
    roles: dict[str, RoleTable] = Field(default_factory=dict, description="one table a role")
    protocols: dict[str, dict[str, Any]] = Field(default_factory=dict, description="parameters by protocol")
    derived: dict[str, dict[str, Any]] = Field(default_factory=dict, description="one table a derived signal")
    uncertainty: dict[str, dict[str, Component]] = Field(
        default_factory=dict, description="components of uncertainty by signal and name"
    )
    interlocks: tuple[Interlock, ...] = ()
    telemetry: TelemetryTable = TelemetryTable()
    safety: SafetyTable = SafetyTable()
    dashboard: DashboardLayout | None = None
    emulation: dict[str, Any] | None = None


class LaboratorySettings(CheckedTable):
    """Base of what the table `[emulation]` may say; a laboratory extends it with its own keys.

    One that has a field `devices` is given the settings of the rig's devices in it, by name.
    """


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


class Driver(Protocol):
    """What a rig file names as a `driver`."""

    Settings: ClassVar[type[DriverSettings]]

    @classmethod
    def connect(cls, name: str, settings: Any, clock: Clock) -> Device:  # noqa: ANN401 - its own Settings
        """Open the instrument, check that it is the right one, and configure it; nothing moves."""

    @classmethod
    def rescue(cls, name: str, settings: Any, clock: Clock) -> None:  # noqa: ANN401 - its own Settings
        """Open the line of an instrument in any state, bring it into its safe state, and release the line.

        Nothing is configured. Raises DeviceError if the safe state is not confirmed.
        """


@dataclass(frozen=True)
class DeviceEntry:
    """One device of a rig file: its driver, which is a `Device` and a `Driver`, and its validated settings."""

    name: str
    driver: Any
    settings: DriverSettings

    def wired(self, ports: Mapping[str, str], path: str) -> DriverSettings:
        """Return the settings with the true port in the place of `emulated://NAME`.

        Parameters
        ----------
        ports : mapping of str to str
            What the laboratory opened, by name.
        path : str
            Of the rig file, for messages.

        Raises
        ------
        ConfigurationError
            If the laboratory has no such instrument.
        """
        port = getattr(self.settings, "port", "")
        if not isinstance(port, str) or not port.startswith(EMULATED):
            return self.settings
        name = port.removeprefix(EMULATED)
        own = {**ports, ECHO: EMULATED + ECHO}
        if name not in ports and all(own.get(each, "").startswith(EMULATED) for each in name.split(JOIN)):
            # Instruments of this process on one line.
            joined = JOIN.join(own[each].removeprefix(EMULATED) for each in name.split(JOIN))
            return self.settings.model_copy(update={"port": EMULATED + joined})
        if name not in ports:
            known = ", ".join(EMULATED + other for other in ports) or "none: the rig has no [emulation]"
            raise ConfigurationError(
                f"{path}: devices.{self.name}.port = {port!r}: the laboratory has no such instrument; "
                f"there are: {known}"
            )
        return self.settings.model_copy(update={"port": ports[name]})


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
    content : mapping
        Everything in it, bases and overrides included.
    bases : tuple of str
        The rigs that it extends, names or paths, the nearest first.
    """

    name: str
    path: str
    text: str
    content: Mapping[str, Any]
    rig: RigTable
    devices: tuple[DeviceEntry, ...]
    roles: Mapping[str, RoleTable]
    protocols: Mapping[str, Mapping[str, Any]]
    derived: Mapping[str, DerivedSignal]
    uncertainty: Uncertainties
    interlocks: tuple[Interlock, ...]
    telemetry: TelemetryTable
    safety: SafetyTable
    dashboard: DashboardLayout | None
    laboratory: Any | None
    laboratory_settings: LaboratorySettings | None
    bases: tuple[str, ...] = ()

    @property
    def emulated(self) -> bool:
        """Whether the rig brings its own emulated laboratory."""
        return self.laboratory is not None

    @property
    def in_process(self) -> bool:
        """Whether every device is emulated in this process, so that time can stand while the process computes."""
        ports = [str(getattr(entry.settings, "port", "")) for entry in self.devices]
        return self.emulated and all(port.startswith(EMULATED) for port in ports)

    def served_by(self, laboratory: Any) -> RigFile:  # noqa: ANN401 - without Settings
        """Return the same rig with a `Laboratory` that is open already in place of its own."""
        return replace(self, laboratory=lambda *_: laboratory)


def packaged_rigs(problems: list[str] | None = None) -> dict[str, registry.RegisteredPart]:
    """Return the rigs of all installed packages by name, each with the entry that brings it.

    An entry of the group `bench.rigs` is a package; its `*.toml` files are rigs. One that cannot be imported is left
    out, and joins `problems`. Raises ConfigurationError if two packages bring a rig of the same name.
    """
    found: dict[str, registry.RegisteredPart] = {}
    for entry in registry.entries("rigs").values():
        try:
            package = entry.load()
        except ConfigurationError as error:
            if problems is not None:
                problems.append(str(error))
            continue
        for file in resources.files(package).iterdir():
            name = file.name.removesuffix(".toml")
            if name == file.name:
                continue
            if name in found:
                raise ConfigurationError(
                    f"packages {found[name].package} and {entry.package} both bring a rig {name!r}; uninstall one"
                )
            found[name] = entry
    return dict(sorted(found.items()))


def load_rig(name: str, overrides: Mapping[str, str] | None = None) -> RigFile:
    """Read a rig file.

    Parameters
    ----------
    name : str
        Name of a packaged rig, or path of a file that ends in `.toml`.
    overrides : mapping of str to str, optional
        Values by dotted key, such as `{"devices.plate.port": "/dev/ttyUSB1"}`, that replace the file's.

    Raises
    ------
    ConfigurationError
        If there is no such rig, or the file is wrong: names file, key, value and what is allowed.
    """
    path, text = _read(name)
    bases: list[str] = []
    content = _merged(path, text, (_identity(name),), bases)
    for key, value in (overrides or {}).items():
        _override(content, key, value, path)
    return replace(_validate(path, text, content), bases=tuple(bases))


def rig_of(path: str, content: Mapping[str, Any]) -> RigFile:
    """Return the rig of a content that was put together; `path` says for messages from what.

    Raises ConfigurationError as `load_rig`.
    """
    return _validate(path, "", content)


def rig_of_content(name: str, text: str, content: Mapping[str, Any]) -> RigFile:
    """Return a rig from what `RigFile.name`, `text` and `content` of it were, as the record of a run keeps them.

    Raises ConfigurationError if something in it is wrong, or no longer there.
    """
    return _validate(f"{name}.toml", text, content)


def _read(name: str) -> tuple[str, str]:
    if name.endswith(".toml"):
        try:
            text = Path(name).read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigurationError(f"rig file {name} cannot be read: {reason(error)}") from None
        registry.import_beside(Path(name))
        return name, text
    left_out: list[str] = []
    packaged = packaged_rigs(left_out)
    if name not in packaged:
        known = f"{closest(name, packaged, '`bench list`')} (or a file of your own, path/to/rig.toml)"
        raise ConfigurationError("\n".join([f"there is no rig {name!r}; {known}", *left_out]))
    return f"{name}.toml", (resources.files(packaged[name].load()) / f"{name}.toml").read_text(encoding="utf-8")


def _identity(name: str) -> str:
    """Return what tells a rig from all others: the full path of a file, the name of a packaged rig."""
    return str(Path(name).resolve()) if name.endswith(".toml") else name


def _merged(path: str, text: str, extending: tuple[str, ...], bases: list[str]) -> dict[str, Any]:
    """Return the content of a file over those that it extends, which join `bases`; `extending` led to it."""
    try:
        content = _without_dates(parse_toml(text))
    except ValueError as error:
        raise ConfigurationError(f"{path}: not valid TOML: {error}") from None
    if isinstance(rig := content.get("rig"), dict) and str(rig.get("twin", "")).endswith(".toml"):
        rig["twin"] = str(Path(path).parent / rig["twin"])
    _inline_calibrations(path, content)
    base, without = content.pop("extends", None), content.pop("without", [])
    if base is None and not without:
        return content
    if not isinstance(base, str) or not isinstance(without, list):
        raise ConfigurationError(
            f"{path}: extends = {base!r}, without = {without!r}: expected the name of a rig (or a file beside this "
            'one, such as "other.toml") and a list of its keys to leave out'
        )
    # A file beside the one that names it; a packaged rig by its name.
    beside = str(Path(path).parent / base) if base.endswith(".toml") else base
    identity = _identity(beside)
    if identity in extending:
        raise ConfigurationError(f"{path}: extends = {base!r}: the rigs extend each other in a circle")
    bases.append(beside)
    base_path, base_text = _read(beside)
    merged = _merged(base_path, base_text, (*extending, identity), bases)
    for key in without:
        *parents, last = str(key).split(".")
        table = _table(merged, parents)
        if table is None or last not in table:
            raise ConfigurationError(f"{path}: without = {key!r}: {base_path} has no such key")
        del table[last]
    return _over(merged, content)


def _inline_calibrations(path: str, content: dict[str, Any]) -> None:
    """Put the content of calibration files, which stand beside the rig file, in the place of their names."""
    derived = content.get("derived")
    for table in derived.values() if isinstance(derived, dict) else ():
        if isinstance(table, dict) and isinstance(name := table.get("calibration"), str):
            table["calibration"] = read_calibration(Path(path).parent / name).model_dump(mode="json")


def _over(base: dict[str, Any], content: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with the values of `content` in place of its own, table by table."""
    merged = dict(base)
    for key, value in content.items():
        below = merged.get(key)
        merged[key] = _over(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged


def _without_dates(content: dict[str, Any]) -> dict[str, Any]:
    """Return the content of a file with its days as text, as the record of a run keeps it as JSON."""

    def text_of(value: Any) -> Any:  # noqa: ANN401 - any TOML
        if isinstance(value, dict):
            return {key: text_of(each) for key, each in value.items()}
        if isinstance(value, list):
            return [text_of(each) for each in value]
        return value.isoformat() if isinstance(value, date | time) else value

    return {key: text_of(value) for key, value in content.items()}


def _table(content: Any, parents: Sequence[str]) -> dict[str, Any] | None:  # noqa: ANN401 - any TOML
    for part in parents:
        content = content.get(part) if isinstance(content, dict) else None
    return content if isinstance(content, dict) else None


def _override(content: dict[str, Any], key: str, value: str, path: str) -> None:
    *parents, last = key.split(".")
    if parents in (["telemetry"], ["safety"]) or (len(parents) == 2 and parents[0] == "emulation"):
        # Tables with defaults for every key, which a file may leave out.
        below = content if len(parents) == 1 else content.get("emulation")
        if isinstance(below, dict):
            below.setdefault(parents[-1], {})
    table = _table(content, parents)
    if table is None:
        raise ConfigurationError(f"{path}: there is no table {'.'.join(parents)!r} in which {last!r} could be set")
    try:
        table[last] = _without_dates(parse_toml(f"value = {value}"))["value"]
    except ValueError:
        number = is_quantity(value) and not isinstance(table.get(last), str)
        table[last] = _in_unit_of(content, parents, key, value) if number else value


def _in_unit_of(content: Mapping[str, Any], parents: Sequence[str], key: str, text: str) -> float:
    """Return a number with a unit in the unit that its table, or one that this stands in, names; else in SI."""
    tables = [_table(content, parents[:count]) or {} for count in range(len(parents), 0, -1)]
    own = next((table["unit"] for table in tables if isinstance(table.get("unit"), str)), "")
    # Of a difference of temperatures K are °C.
    units = (difference_unit(own),) if key.rpartition(".")[2] in _DIFFERENCES else (own, own and rate_unit(own))
    for unit in filter(None, units):
        with suppress(ValueError):
            return read_quantity(text, unit)
    try:
        return in_si(text)
    except ValueError as error:
        raise ConfigurationError(f"--override {key}: {error}") from None


def _validate(path: str, text: str, content: Mapping[str, Any]) -> RigFile:
    try:
        tables = _RigFileContent.model_validate(content)
    except ValidationError as error:
        wrong = [*problems(error, _RigFileContent), *_wrong_devices(content)]
        raise ConfigurationError("\n".join(f"{path}: {line}" for line in wrong)) from None
    found: list[str] = []
    entries: list[DeviceEntry] = []
    for device, own in tables.devices.items():
        table = with_line(device, own, tables.lines, found)
        loaded = _load_part("devices", table, f"devices.{device}.", "driver", DriverSettings, "connect", found)
        if loaded is not None:
            entries.append(DeviceEntry(device, *loaded))
    # What is missing would be said twice.
    if not found:
        found += wrong_lines(entries, tables.lines, 1.0 / tables.safety.rate if tables.interlocks else 0.0)
    for i, device in enumerate(order := tables.safety.order):
        if device not in tables.devices or device in order[:i]:
            found.append(f"safety.order: {device!r}: expected devices, each once; {closest(device, tables.devices)}")
    derived: dict[str, DerivedSignal] = {}
    for name, table in tables.derived.items():
        key = f"derived.{name}."
        kind: type[DerivedSignal] | None = None
        try:
            kind = _load("derived_signals", table.get("kind", "expression"), f"{key}kind")
            if not (isinstance(kind, type) and issubclass(kind, DerivedSignal)):
                raise ConfigurationError(f"{key}kind = {table['kind']!r}: is not a DerivedSignal")
            derived[name] = kind.model_validate(table)
        except ValidationError as error:
            found.extend(problems(error, kind or DerivedSignal, key))
        except ConfigurationError as error:
            found.append(str(error))
    laboratory, settings = None, None
    if tables.emulation is not None:
        devices = {entry.name: entry.settings for entry in entries}
        loaded = _load_part(
            "laboratories", tables.emulation, "emulation.", "laboratory", LaboratorySettings, "open", found, devices
        )
        laboratory, settings = loaded or (None, None)
    if found:
        raise ConfigurationError("\n".join(f"{path}: {line}" for line in found))
    return RigFile(
        name=Path(path).name.removesuffix(".toml"),
        path=path,
        text=text,
        content=content,
        rig=tables.rig,
        devices=tuple(entries),
        roles=tables.roles,
        protocols=tables.protocols,
        derived=_after_their_sources(derived),
        uncertainty=tables.uncertainty,
        interlocks=tables.interlocks,
        telemetry=tables.telemetry,
        safety=tables.safety,
        dashboard=tables.dashboard,
        laboratory=laboratory,
        laboratory_settings=settings,
    )


def _after_their_sources(derived: Mapping[str, DerivedSignal]) -> dict[str, DerivedSignal]:
    """Return derived signals in their order, but each after those that it comes from."""
    ordered: dict[str, DerivedSignal] = {}

    def place(name: str, before: frozenset[str]) -> None:
        for source in derived[name].sources:
            # One that comes from itself stays where it is; binding it says so.
            if source in derived and source not in before:
                place(source, before | {source})
        ordered.setdefault(name, derived[name])

    for name in derived:
        place(name, frozenset([name]))
    return ordered


def _wrong_devices(content: Mapping[str, Any]) -> list[str]:
    """Return what is wrong with the devices of a file that is wrong elsewhere as well."""
    found: list[str] = []
    devices, lines = content.get("devices"), content.get("lines", {})
    if (
        isinstance(devices, dict)
        and isinstance(lines, dict)
        and all(isinstance(each, dict) for each in lines.values())
    ):
        for device, own in devices.items():
            if isinstance(own, dict):
                table = with_line(device, own, lines, [])
                _load_part("devices", table, f"devices.{device}.", "driver", DriverSettings, "connect", found)
    return found


def _load_part(
    group: registry.Group,
    table: Mapping[str, Any],
    prefix: str,
    key: str,
    base: type[BaseModel],
    method: str,
    found: list[str],
    devices: Mapping[str, DriverSettings] | None = None,
) -> tuple[Any, Any] | None:
    """Return the class that `key` of a table names, and its settings from the other keys; problems go to `found`."""
    options = dict(table)
    reference = options.pop(key, None)
    where = f"{prefix}{key} = {reference!r}"
    try:
        loaded = _load(group, reference, f"{prefix}{key}")
        settings = getattr(loaded, "Settings", None)
        if not (isinstance(loaded, type) and isinstance(settings, type) and issubclass(settings, base)):
            raise ConfigurationError(
                f"{where}: is not a class with Settings that extend {base.__name__}, so a rig file cannot use it"
            )
        if group == "devices" and not issubclass(loaded, Device):
            raise ConfigurationError(f"{where}: class {loaded.__name__} is not a Device")
        if not callable(getattr(loaded, method, None)):
            raise ConfigurationError(f"{where}: class {loaded.__name__} has no method {method}")
    except ConfigurationError as error:
        found.append(str(error))
        return None
    if devices is not None and "devices" in settings.model_fields:
        options["devices"] = devices
    try:
        return loaded, settings.model_validate(options)
    except ValidationError as error:
        found.extend(problems(error, settings, prefix))
        return None


def _load(group: registry.Group, reference: object, key: str) -> Any:  # noqa: ANN401 - any object
    """Return what `module:Class`, or a name of a registered part, stands for."""
    if isinstance(reference, str) and reference in registry.entries(group):
        return registry.load(group, reference)
    if not isinstance(reference, str) or reference.count(":") != 1:
        names = closest(str(reference), registry.entries(group))
        raise ConfigurationError(f"{key} = {reference!r}: expected module:class, or a registered name; {names}")
    module, _, name = reference.partition(":")
    try:
        registry.check_import(module)
    except ConfigurationError as error:
        raise ConfigurationError(f"{key} = {reference!r}: {error}") from None
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
    return loaded
