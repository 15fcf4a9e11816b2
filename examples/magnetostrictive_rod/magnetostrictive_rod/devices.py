"""The drivers: a coil current source and a strain bridge, each on a serial line; `instruments` lists the bytes."""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field

from bench.clock import Clock
from bench.devices import Identity, Limits, Signal, Status
from bench.errors import DeviceConnectionError, DeviceError
from bench.roles import GeneralActuator, GeneralSensor
from drivers.serial_line import SerialSettings, lost_line, open_port

_MAKER = "Example"


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
        words = self.ask(question)
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


class _Connected:
    """What both drivers share: they open their line, check which instrument answers, and close it again."""

    KIND: str
    _line: AsciiLine

    @classmethod
    def connect(cls, name: str, settings: Any, clock: Clock) -> Self:  # noqa: ANN401 - each has its own
        """Open the line and check the instrument; nothing moves."""
        line = AsciiLine(name, settings)
        try:
            return cls(name, settings, clock, line, line.identify(cls.KIND))  # type: ignore[call-arg]
        except BaseException:
            line.close()
            raise

    def close(self) -> None:
        """Release the line; the instrument keeps its state."""
        self._line.close()


class CoilSource(_Connected, GeneralActuator):
    """A source of the coil's current, A. `set` completes when the current has arrived; safe is the output off."""

    KIND = "coil-source"

    class Settings(AsciiSettings):
        """Keys of its table in the rig file."""

        current_limit: float = Field(gt=0, le=5, description="greatest current of either direction, A")
        tolerance: float = Field(default=2e-3, gt=0, description="distance at which the current has arrived, A")

    def __init__(self, name: str, settings: Settings, clock: Clock, line: AsciiLine, identity: Identity) -> None:
        limits = Limits(-settings.current_limit, settings.current_limit, "A")
        current = Signal("current", "A", "coil current", 4)
        super().__init__(name, clock, identity, [current], limits, description="current set-point")
        self._line, self._tolerance = line, settings.tolerance

    def measure_quantities(self) -> dict[str, float]:
        """Measure the current."""
        return {"current": self._line.numbers("I?", 1)[0]}

    def send(self, value: float) -> Status:
        """Have the source regulate the current to `value`, A."""
        self._line.ask(f"SET {value:.3f}")
        return Status(
            self.name,
            self._clock,
            lambda: abs(self.measure_quantities()["current"] - value) < self._tolerance,
            timeout=5.0,
        )

    def switch_off(self) -> None:
        """Switch the output off, and have the source confirm it."""
        self._line.ask("OFF")
        if self._line.ask("I?")[-1:] != ["OFF"]:
            raise DeviceError(self.name, "does not confirm that its output is off; disconnect the coil")


class StrainBridge(_Connected, GeneralSensor):
    """An amplifier for two strain gauges: the voltages `a` and `b` of their bridges, V."""

    KIND = "strain-bridge"
    Settings = AsciiSettings

    def __init__(self, name: str, _: AsciiSettings, clock: Clock, line: AsciiLine, identity: Identity) -> None:
        voltages = [Signal(f"voltage_{side}", "V", f"bridge voltage, gauge {side}", 6) for side in "ab"]
        super().__init__(name, clock, identity, voltages)
        self._line = line

    def measure_quantities(self) -> dict[str, float]:
        """Measure both bridges."""
        a, b = self._line.numbers("V?", 2)
        return {"voltage_a": a, "voltage_b": b}
