"""How messages reach a text instrument: through pyserial (serial ports, TCP sockets), or through VISA (pyvisa)."""

from __future__ import annotations

import importlib.util
from contextlib import suppress
from typing import Annotated, Any, ClassVar, Literal, Protocol, Self

from pydantic import AfterValidator, Field, model_validator

from bench.base import DeviceConnectionError, how_to_install
from drivers.serial_line import RESENDS, SerialSettings, forget_received, lost_line, open_port, settle_line

TCP = "tcp://"
VISA = "visa://"

LATEST = 3.0
"""Time-outs after a question by which even a late answer has come."""

_ADDRESS = "{address}"

LONGEST_ANSWER = 1024
"""Bytes after which an answer without an end is none."""


def _port(port: str) -> str:
    if port.startswith(TCP):
        host, _, number = port.removeprefix(TCP).rpartition(":")
        if not (host and number.isdigit() and 0 < int(number) < 65536):
            raise ValueError("expected tcp://HOST:PORT, such as tcp://192.0.2.5:5025")
    if port.startswith(VISA) and importlib.util.find_spec("pyvisa") is None:
        raise ValueError(f"needs pyvisa; install it by: {how_to_install('visa')}")
    return port


def _addressed(value: Any, address: str) -> Any:  # noqa: ANN401 - any TOML
    """Return a value of a rig file with the address in the place of its placeholder in every text."""
    if isinstance(value, dict):
        return {key: _addressed(each, address) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_addressed(each, address) for each in value)
    return value.replace(_ADDRESS, address) if isinstance(value, str) else value


class TextLineSettings(SerialSettings):
    """Where a text instrument is."""

    address_key: ClassVar[str] = "address"

    address: str = Field(
        default="",
        coerce_numbers_to_str=True,
        description="address on a line that it shares; {address} in a message or a form stands for it",
    )
    port: Annotated[str, AfterValidator(_port)] = Field(
        min_length=1,
        description="address: a serial port (/dev/ttyUSB0, COM3), tcp://HOST:PORT, visa://RESOURCE such as "
        "visa://TCPIP0::192.0.2.5::INSTR or visa://USB0::0x1234::0x5678::SN::INSTR, or emulated://NAME",
    )
    baudrate: int = Field(default=9600, gt=0, description="speed of a serial line, Bd")
    parity: Literal["N", "E", "O"] = Field(default="N", description="parity of a serial line: N, E or O")
    stop_bits: Literal[1, 2] = Field(default=1, description="stop bits of a serial line: 1 or 2")
    flow_control: Literal["none", "xon-xoff", "rts-cts", "dtr-dsr"] = Field(
        default="none", description="handshake of a serial line"
    )
    timeout: float = Field(
        default=1.0, gt=0, le=60, description="wait for an answer, s; a query is sent three times at most"
    )
    visa_library: str = Field(
        default="", description="library of a visa:// address, such as @py; the one that pyvisa finds if empty"
    )

    @model_validator(mode="before")
    @classmethod
    def _with_address(cls, content: Any) -> Any:  # noqa: ANN401 - any TOML
        if not isinstance(content, dict):
            return content
        address = content.get("address")
        if address is None and _addressed(content, "") != content:
            raise ValueError(f"{_ADDRESS} stands in its messages, so the key address is needed")
        return content if address is None else _addressed(content, str(address))

    @model_validator(mode="after")
    def _shares_no_resource(self) -> Self:
        if self.line and self.port.startswith(VISA):
            raise ValueError(f"line = {self.line!r}: a VISA resource cannot be shared; expected a serial port")
        return self

    @property
    def longest_turn(self) -> float:
        """Longest time that a question and its repetitions keep the line while nothing answers, s.

        Before each repetition the line has to be silent for a time-out, and at the end until no late answer can come.
        """
        return (1 + 2 * RESENDS + LATEST - 1) * self.timeout


class Transport(Protocol):
    """A line on which messages go out, and answers come in order.

    Each method raises `DeviceConnectionError` when the line is lost.

    Attributes
    ----------
    unfinished : bytes
        What came since the last answer without a terminator.
    """

    unfinished: bytes

    def write(self, message: bytes) -> None:
        """Send a message with its terminator."""

    def read(self) -> bytes | None:
        """Return the next answer without its terminator, or None when none has come within the time-out."""

    def discard(self) -> None:
        """Forget what was received."""

    def leave(self) -> None:
        """Wait until no late answer can come, so that a neighbour on the line does not take it for its own."""

    def close(self) -> None:
        """Release the line."""


def open_transport(device: str, settings: TextLineSettings, terminator: bytes) -> Transport:
    """Open a line whose answers end with a terminator.

    Raises `DeviceConnectionError` if it cannot be opened.
    """
    kind = VisaTransport if settings.port.startswith(VISA) else SerialTransport
    return kind(device, settings, terminator)


class SerialTransport:
    """A serial port, or a TCP socket in its place."""

    def __init__(self, device: str, settings: TextLineSettings, terminator: bytes) -> None:
        self._device, self._settings, self._terminator = device, settings, terminator
        self.unfinished = b""
        url = settings.port
        if url.startswith(TCP):
            url = f"socket://{url.removeprefix(TCP)}"
        flow = settings.flow_control
        self.port = open_port(
            device,
            settings.model_copy(update={"port": url}),
            parity=settings.parity,
            stopbits=settings.stop_bits,
            xonxoff=flow == "xon-xoff",
            rtscts=flow == "rts-cts",
            dsrdtr=flow == "dtr-dsr",
        )

    def write(self, message: bytes) -> None:
        """Send a message with its terminator."""
        try:
            self.port.write(message)
        except OSError as error:  # pyserial's errors among them
            raise lost_line(self._device, self._settings.port, error) from None

    def read(self) -> bytes | None:
        """Return the next answer without its terminator, or None when none has come within the time-out."""
        try:
            answer: bytes = self.port.read_until(self._terminator, LONGEST_ANSWER)
        except OSError as error:
            raise lost_line(self._device, self._settings.port, error) from None
        if answer.endswith(self._terminator):
            self.unfinished = b""
            return answer.removesuffix(self._terminator)
        self.unfinished = answer or self.unfinished
        return None

    def discard(self) -> None:
        """Forget what was received."""
        try:
            forget_received(self.port)
        except OSError as error:
            raise lost_line(self._device, self._settings.port, error) from None

    def leave(self) -> None:
        """Wait until no late answer can come, so that a neighbour on the line does not take it for its own."""
        if self._settings.line:
            try:
                settle_line(self.port, (LATEST - 1) * self._settings.timeout)
            except OSError as error:
                raise lost_line(self._device, self._settings.port, error) from None

    def close(self) -> None:
        """Release the line."""
        self.port.close()


class VisaTransport:
    """A VISA resource: TCP (INSTR, SOCKET), USB-TMC, GPIB or serial, by pyvisa and the library that it finds."""

    def __init__(self, device: str, settings: TextLineSettings, terminator: bytes) -> None:
        import pyvisa

        self._device, self._settings, self._terminator = device, settings, terminator
        self.unfinished = b""
        self._errors = (pyvisa.errors.Error, OSError)
        self._timed_out = pyvisa.constants.StatusCode.error_timeout
        self._discard_buffer = pyvisa.constants.BufferOperation.discard_read_buffer
        self._resource: Any = None
        try:
            manager = pyvisa.ResourceManager(settings.visa_library)
            self._resource = manager.open_resource(
                settings.port.removeprefix(VISA),
                open_timeout=round(1e3 * settings.timeout),
                timeout=1e3 * settings.timeout,
            )
            self._configure(pyvisa.constants)
        # Each library fails in a way of its own.
        except Exception as error:
            if self._resource is not None:
                self.close()
            raise DeviceConnectionError(device, f"cannot open {settings.port}: {error}") from None

    def _configure(self, constants: Any) -> None:  # noqa: ANN401 - a module
        settings, resource = self._settings, self._resource
        # The library ends an answer at its last character; what comes with END is whole without it.
        resource.read_termination = self._terminator[-1:].decode("latin-1")
        if resource.interface_type == constants.InterfaceType.asrl:
            resource.baud_rate = settings.baudrate
            resource.parity = {"N": constants.Parity.none, "E": constants.Parity.even, "O": constants.Parity.odd}[
                settings.parity
            ]
            resource.stop_bits = constants.StopBits.one if settings.stop_bits == 1 else constants.StopBits.two
            resource.flow_control = {
                "none": constants.ControlFlow.none,
                "xon-xoff": constants.ControlFlow.xon_xoff,
                "rts-cts": constants.ControlFlow.rts_cts,
                "dtr-dsr": constants.ControlFlow.dtr_dsr,
            }[settings.flow_control]

    def write(self, message: bytes) -> None:
        """Send a message with its terminator."""
        try:
            self._resource.write_raw(message)
        except self._errors as error:
            raise lost_line(self._device, self._settings.port, error) from None

    def read(self) -> bytes | None:
        """Return the next answer without its terminator, or None when none has come within the time-out."""
        try:
            answer: bytes = self._resource.read_raw()
        except self._errors as error:
            if getattr(error, "error_code", None) == self._timed_out:
                return None
            raise lost_line(self._device, self._settings.port, error) from None
        return answer.removesuffix(self._terminator)

    def discard(self) -> None:
        """Forget what was received."""
        # Not every interface of every library has it; the question for the identity comes after a time-out anyway.
        with suppress(*self._errors, NotImplementedError):
            self._resource.flush(self._discard_buffer)

    def leave(self) -> None:
        """Do nothing: a VISA resource is not shared."""

    def close(self) -> None:
        """Release the line."""
        with suppress(*self._errors):
            self._resource.close()
