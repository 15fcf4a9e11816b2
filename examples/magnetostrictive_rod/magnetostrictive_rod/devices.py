"""The drivers: a coil current source and a strain bridge, each on a serial line; `instruments` lists the bytes."""

from __future__ import annotations

from pydantic import Field

from bench.base import Clock, DeviceConnectionError, DeviceError, DeviceRestartedError
from bench.devices import GeneralActuator, GeneralSensor, Identity, Limits, Signal, Status
from drivers.device import LineDevice
from drivers.serial_line import SerialSettings, lost_line, open_port

_MAKER = "Example"
_UNKNOWN = Identity(_MAKER, "unknown", "unknown", "unknown")


class AsciiSettings(SerialSettings):
    """What a rig file says of either instrument."""

    baudrate: int = Field(default=115200, gt=0, description="speed of the line, Bd")


class AsciiLine:
    """A serial line to one instrument: one question, one answer."""

    def __init__(self, device: str, settings: SerialSettings) -> None:
        self._device, self._settings = device, settings
        self._port = open_port(device, settings)

    def ask(self, question: str) -> list[str]:
        """Send a question, and return the words of its answer after the first.

        Raises
        ------
        DeviceConnectionError
            If the line is lost, or nothing answers within the timeout.
        DeviceError
            If the instrument refuses, or answers something else.
        """
        try:
            # What a late answer left behind must not pass for the answer to this question.
            self._port.reset_input_buffer()
            self._port.write(f"{question}\n".encode("ascii"))
            answer = self._port.read_until(b"\n").decode("ascii", "replace")
        except Exception as error:  # pyserial passes on system errors that are no OSError
            raise lost_line(self._device, self._settings, error) from None
        if not answer.endswith("\n"):
            raise DeviceConnectionError(self._device, f"no answer at {self._settings.port}; check power and cable")
        first, *words = answer.split() or [""]
        if first != question.split()[0].rstrip("?"):
            raise DeviceError(self._device, f"answered {answer.strip()!r} to {question!r}")
        return words

    def numbers(self, question: str, count: int) -> list[float]:
        """Return the first `count` words of an answer as numbers; errors as `ask`."""
        return self.to_numbers(question, self.ask(question), count)

    def to_numbers(self, question: str, words: list[str], count: int) -> list[float]:
        """Return the first `count` words of an answer as numbers; raise `DeviceError` if they are none."""
        try:
            return [float(words[i]) for i in range(count)]
        except (IndexError, ValueError):
            raise DeviceError(self._device, f"answered {words} to {question!r}: expected {count} numbers") from None

    def identify(self, kind: str) -> Identity:
        """Return the identity of the instrument; raise `DeviceConnectionError` if it is of another kind."""
        words = self.ask("ID?")
        if len(words) != 3 or words[0] != kind:
            raise DeviceConnectionError(self._device, f"{self._settings.port} is {words}, expected a {kind}")
        return Identity(_MAKER, *words)

    def close(self) -> None:
        """Release the line."""
        self._port.close()


class _OnALine(LineDevice[AsciiSettings, AsciiLine]):
    """What both drivers share: how their line is opened, and which instrument is there."""

    KIND: str

    @classmethod
    def _open_line(cls, name: str, settings: AsciiSettings, clock: Clock) -> AsciiLine:  # noqa: ARG003
        return AsciiLine(name, settings)

    def _identify(self) -> Identity:
        return self._line.identify(self.KIND)

    def _start(self) -> None:
        """Do nothing: neither instrument has a set-up."""


class CoilSource(_OnALine, GeneralActuator):
    """A source of the coil's current, A. `set` completes when the current has arrived; safe is the output off.

    Each reading says whether the output is on, so that a restart is found by the next one.
    """

    KIND = "coil-source"

    class Settings(AsciiSettings):
        """Keys of its table in the rig file."""

        current_limit: float = Field(gt=0, le=5, description="greatest current of either direction, A")
        tolerance: float = Field(default=2e-3, gt=0, description="distance at which the current has arrived, A")

    def __init__(self, name: str, settings: Settings, clock: Clock, line: AsciiLine) -> None:
        limits = Limits(-settings.current_limit, settings.current_limit, "A")
        current = Signal("current", "A", "coil current", 4)
        GeneralActuator.__init__(self, name, clock, _UNKNOWN, [current], limits, description="current set-point")
        self._settings, self._line, self._tolerance = settings, line, settings.tolerance
        self._on = self._restarted = False

    def measure_quantities(self) -> dict[str, float]:
        """Measure the current, and check that the output is as it was left."""
        words = ["OFF"] if self._restarted else self._line.ask("I?")
        if self._on and words[-1:] == ["OFF"]:
            self._restarted = True
        if self._restarted:
            raise DeviceRestartedError(self.name, "has restarted: its output is off without the bench; connect again")
        return {"current": self._line.to_numbers("I?", words, 1)[0]}

    def send(self, value: float) -> Status:
        """Have the source regulate the current to `value`, A."""
        self.measure_quantities()
        self._line.ask(f"SET {value:.3f}")
        self._on = True
        return Status(
            self.name,
            self._clock,
            lambda: abs(self.measure_quantities()["current"] - value) < self._tolerance,
            timeout=5.0,
        )

    def switch_off(self) -> None:
        """Switch the output off, over a fresh line if the one in use is gone, and have the source confirm it."""
        self._on = False
        try:
            self._line.ask("OFF")
        except DeviceConnectionError:
            self._renew_line()
            self._line.ask("OFF")
        if self._line.ask("I?")[-1:] != ["OFF"]:
            raise DeviceError(self.name, "does not confirm that its output is off; disconnect the coil")


class StrainBridge(_OnALine, GeneralSensor):
    """An amplifier for two strain gauges: the voltages `a` and `b` of their bridges, V."""

    KIND = "strain-bridge"
    Settings = AsciiSettings

    def __init__(self, name: str, settings: AsciiSettings, clock: Clock, line: AsciiLine) -> None:
        voltages = [Signal(f"voltage_{side}", "V", f"bridge voltage, gauge {side}", 6) for side in "ab"]
        GeneralSensor.__init__(self, name, clock, _UNKNOWN, voltages)
        self._settings, self._line = settings, line

    def measure_quantities(self) -> dict[str, float]:
        """Measure both bridges."""
        a, b = self._line.numbers("V?", 2)
        return {"voltage_a": a, "voltage_b": b}
