"""The interface between the engine and a rig, which one process holds and another may drive.

A station has the devices, the interlocks and the safe state. The engine promises by when it will be back
(`promise`); a broken promise is the safe state. `LocalStation` has the devices in this process, `RemoteStation` asks
a guardian, which alone opens the lines.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

from bench.base import Clock
from bench.devices import Device, Floats
from bench.rig import InterlockFinding, Look, RigDescription


@dataclass(frozen=True)
class News:
    """Something that happened at the station, for the record."""

    level: str  # `INFO`, `WARN` or `ERROR`
    kind: str  # one word, such as `line`
    text: str  # what happened


@dataclass(frozen=True)
class Arrivals:
    """How far the set-points that were sent last have come."""

    waiting: tuple[str, ...]  # devices that have not arrived
    error: Exception | None  # what ended an arrival


def counted(devices: Iterable[Device], late: Mapping[str, float] = MappingProxyType({})) -> list[News]:
    """Return how often devices on shared lines were asked, and of any other how many requests had to be repeated.

    Parameters
    ----------
    devices : iterable of Device
        The devices.
    late : mapping of str to float, optional
        Longest time for which each has waited for its turn, s.
    """
    news = []
    for device in devices:
        repeats = device.repeats
        if device.requests:
            turn = f"; {late[device.name]:.2f} s late at most" if device.name in late else ""
            news.append(
                News("INFO", "requests", f"{device.name}: {device.requests} requests, {repeats} repeated{turn}")
            )
        elif repeats:
            news.append(
                News("INFO", "requests", f"{device.name}: {repeats} requests repeated, as their answers were lost")
            )
    return news


def news_of(findings: Iterable[InterlockFinding]) -> list[News]:
    """Return what interlocks below the level `safe` have found, for the record."""
    return [
        News("INFO" if each.over else "WARN", "warning" if each.early else "interlock", each.text)
        for each in findings
    ]


class Station(ABC):
    """Devices, interlocks and safe state of one rig during one run.

    Attributes
    ----------
    clock : Clock
        The clock of the run.
    description : RigDescription
        The rig that is connected.
    """

    clock: Clock
    description: RigDescription

    @property
    @abstractmethod
    def has_operator(self) -> bool:
        """Whether an emulated laboratory does what a prompt asks for."""

    @property
    @abstractmethod
    def is_holding(self) -> bool:
        """Whether an interlock of the level `hold` has the set-points stand until its signal is back."""

    @abstractmethod
    def take_pause(self) -> str:
        """Return why an interlock of the level `pause` asks for one, once; empty if none does."""

    @abstractmethod
    def promise(self, seconds: float, why: str) -> None:
        """Promise that each request from now on is followed by the next one within so many seconds.

        Parameters
        ----------
        seconds : float
            Wall-clock time, s.
        why : str
            What goes on meanwhile, for the message when the promise is broken.
        """

    @abstractmethod
    def look(self, look: Look, wanted: Collection[str] = ()) -> dict[str, float]:
        """Read the devices; values by signal name.

        Raises
        ------
        DeviceError
            If a device cannot be read.
        BenchError
            What ended the run, if the station is in the safe state already.
        """

    @abstractmethod
    def quick_reader(self, wanted: Collection[str]) -> Callable[[], dict[str, float]]:
        """Return a function that takes a quick reading of the devices that some signals come from, and of no other.

        It returns what these devices deliver and the derived ones of the signals; set-points are not among them.
        """

    @abstractmethod
    def mover(self, actuators: Sequence[str]) -> Callable[[Sequence[float]], None]:
        """Return a function that sends those of some set-points that have changed, in the order of the devices.

        All are checked before any is sent. It raises LimitError or DeviceError.
        """

    @abstractmethod
    def block_player(
        self, inputs: Sequence[str], actuators: Sequence[str], period: float
    ) -> Callable[[Floats], Floats] | None:
        """Return what has an instrument carry out blocks of samples by itself; None if none can.

        It takes and returns what `bench.devices.BlockPlayer.play` does, of signals and actuators in their order.
        """

    @abstractmethod
    def check(self, setpoints: Mapping[str, Sequence[float]]) -> None:
        """Raise LimitError if a device does not take one of its set-points; nothing is sent."""

    @abstractmethod
    def apply(self, setpoints: Mapping[str, float]) -> None:
        """Send set-points; all are checked before any is sent.

        Raises
        ------
        LimitError
            If a device does not take its set-point; nothing was sent.
        DeviceError
            If a device refuses.
        """

    @abstractmethod
    def rest(self) -> None:
        """Bring every device into its safe state for a while; the next set-point switches an output on again.

        Raises DeviceError if a device did not reach it.
        """

    @abstractmethod
    def tare(self, device: str) -> None:
        """Make the present force of a load cell read zero.

        Raises
        ------
        ConfigurationError
            If the device is no load cell.
        DeviceError
            If it does not take the tare.
        """

    @abstractmethod
    def setpoint(self, device: str) -> float:
        """Return the set-point that was last sent to a device; nan before the first."""

    @abstractmethod
    def arrivals(self) -> Arrivals:
        """Ask the devices that were sent set-points last how far they have come."""

    @abstractmethod
    def judge(self, t: float, values: Mapping[str, float]) -> None:
        """Judge readings that were recorded by the interlocks.

        Raises InterlockError if one trips; whatever else has ended the run at the station is raised here as well.
        """

    @abstractmethod
    def sleep_until(self, instant: float) -> None:
        """Let laboratory time pass up to an instant, s; what the station has to do meanwhile is done."""

    @abstractmethod
    def operate(self, task: str, value: float) -> None:
        """Have done by hand, in an emulated laboratory, what a prompt asks for.

        Raises ConfigurationError for a task that the laboratory cannot do.
        """

    @abstractmethod
    def news(self) -> list[News]:
        """Return what happened since the last call, oldest first."""

    @abstractmethod
    def end(self) -> Mapping[str, str]:
        """Bring every device into its safe state; return by device `safe`, or what went wrong. Raises nothing."""

    @abstractmethod
    def close(self) -> None:
        """Release the lines; each device keeps the state that it is in."""
