"""A MeCom host for the tests, written from the maker's specification alone and from none of the code under test.

Source: Meerstetter 5117C (MeCom protocol specification), 5136AL (TEC controller communication protocol, chapter 5).
A frame is `#` from the host or `!` from the device, address (2 hexadecimal digits), sequence number (4), payload,
CRC (4) and a carriage return. The CRC is CRC-16 with polynomial 0x1021 and initial value 0 over everything before it.
An acknowledge carries the CRC of the request; a payload of `+` and two digits is a server error.
"""

import struct

import serial

TRIALS = 3
SHORTEST = 12  # characters of an acknowledge


class MeComError(Exception):
    """The device refuses, or what arrives is no answer; `code` is the server error, 0 if there is none."""

    def __init__(self, message, code=0):
        super().__init__(message)
        self.code = code


def checksum(text):
    """Return the CRC of the characters of a frame, by the bits."""
    crc = 0
    for byte in text:
        for bit in range(7, -1, -1):
            out = crc >> 15 ^ byte >> bit & 1
            crc = crc << 1 & 0xFFFF ^ (0x1021 if out else 0)
    return crc


class MeComClient:
    """One device on a line that pyserial opens by its address, such as a path or `socket://host:port`."""

    def __init__(self, url, address=1, *, baudrate=57600, timeout=20.0):
        self.line = serial.serial_for_url(url, baudrate=baudrate, timeout=timeout)
        self.address = address
        self.sequence = 0x15AA

    def close(self):
        self.line.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def frame(self, payload):
        """Return the next request, with a sequence number of its own."""
        self.sequence = self.sequence + 1 & 0xFFFF
        head = f"#{self.address:02X}{self.sequence:04X}{payload}".encode("ascii")
        return head + f"{checksum(head):04X}\r".encode("ascii")

    def answer(self, request):
        """Read the answer to a request and return its payload; None for an acknowledge."""
        received = self.line.read_until(b"\r")
        if len(received) < SHORTEST or received[:1] != b"!" or received[-1:] != b"\r":
            raise MeComError(f"no answer to {request!r} but {received!r}")
        if received[1:7] != request[1:7]:
            raise MeComError(f"{received!r} belongs to another request than {request!r}")
        if len(received) == SHORTEST:
            if received[7:11] != request[-5:-1]:
                raise MeComError(f"{received!r} acknowledges another request than {request!r}")
            return None
        if received[-5:-1] != f"{checksum(received[:-5]):04X}".encode("ascii"):
            raise MeComError(f"{received!r} is damaged")
        payload = received[7:-5].decode("ascii")
        if payload.startswith("+"):
            raise MeComError(f"server error {payload} to {request!r}", int(payload[1:], 16))
        return payload

    def exchange(self, payload):
        """Send a payload; resend it with the same sequence number when nothing or nothing whole comes back."""
        request = self.frame(payload)
        for trial in range(1, TRIALS + 1):
            self.line.write(request)
            try:
                return self.answer(request)
            except MeComError as error:
                if error.code or trial == TRIALS:
                    raise
                self.line.reset_input_buffer()
        raise AssertionError("unreachable")

    def identify(self):
        return self.exchange("?IF")

    def integer(self, parameter, instance=1):
        return int.from_bytes(self._value(parameter, instance), "big", signed=True)

    def real(self, parameter, instance=1):
        return struct.unpack(">f", self._value(parameter, instance))[0]

    def limits(self, parameter, kind, instance=1):
        """Return lowest and highest value of a parameter; `kind` is `i` or `f`."""
        raw = bytes.fromhex(self.exchange(f"?VL{parameter:04X}{instance:02X}"))
        return struct.unpack(f">{kind}{kind}", raw[1:9])

    def set_integer(self, parameter, value, instance=1):
        self._set(parameter, instance, struct.pack(">i", value))

    def set_real(self, parameter, value, instance=1):
        self._set(parameter, instance, struct.pack(">f", value))

    def reset(self):
        self._expect_acknowledge("RS")

    def emergency_stop(self):
        self._expect_acknowledge("ES")

    def _value(self, parameter, instance):
        raw = bytes.fromhex(self.exchange(f"?VR{parameter:04X}{instance:02X}"))
        if len(raw) != 4:
            raise MeComError(f"parameter {parameter}: expected 4 bytes, got {raw.hex()}")
        return raw

    def _set(self, parameter, instance, raw):
        self._expect_acknowledge(f"VS{parameter:04X}{instance:02X}{raw.hex().upper()}")

    def _expect_acknowledge(self, payload):
        answer = self.exchange(payload)
        if answer is not None:
            raise MeComError(f"expected an acknowledge of {payload}, got {answer!r}")
