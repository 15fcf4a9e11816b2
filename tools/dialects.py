"""The languages of the emulated instruments for the fuzzer: requests, a probe, and what is a well-formed answer.

Frames and checks are written here a second time, from the protocols and not with the servers' own functions.
"""

import re
import struct
from abc import ABC, abstractmethod
from binascii import crc_hqx

from sim_devices.instruments.dynamixel_table import ITEMS
from sim_devices.instruments.meerstetter_table import PARAMETERS
from sim_devices.instruments.roboteq import DICTIONARY

WORDS_32 = (0, 1, 2, 3, 3, 100, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
REALS = (0.0, -0.0, 1.0, -1.0, 25.0, 1e5, 1e-45, 3.4e38, -3.4e38, float("inf"), float("-inf"), float("nan"))


class MalformedError(Exception):
    """An answer is no frame of the protocol, or not the right one."""


def word_32(rng):
    """Return 4 bytes: at random, a whole number of meaning, or a real number of meaning; highest first."""
    kind = rng.randrange(4)
    if kind == 0:
        return rng.randbytes(4)
    if kind == 1:
        return struct.pack(">I", rng.choice(WORDS_32))
    if kind == 2:
        return struct.pack(">f", rng.choice(REALS))
    return struct.pack(">f", rng.uniform(-100.0, 100.0))


class Dialect(ABC):
    """One protocol."""

    trials = 1
    """How often a probe is sent."""

    @abstractmethod
    def request(self, rng):
        """Return a request that is whole and makes sense more often than not."""

    @abstractmethod
    def wild(self, rng):
        """Return a whole frame, its check sum right, whose contents are at random."""

    @abstractmethod
    def check(self, answers):
        """Raise `MalformedError` unless these bytes are nothing but whole answers; return how many."""

    def restoring(self, rng):  # noqa: ARG002
        """Return requests after which the instrument is at its address again, and answers."""
        return b""

    @abstractmethod
    def probe(self, rng):
        """Return a request that every state of the instrument answers, and a function that checks the answer."""


class MeCom(Dialect):
    """Meerstetter 5117C."""

    _ANSWER = re.compile(rb"!([0-9A-F]{6})(.*)([0-9A-F]{4})", re.DOTALL)
    _ACTING = (
        *((2000, value) for value in (0, 1, 2)), *((2010, value) for value in (0, 1, 2)),
        (108, 1), (3034, 0), (3034, 1),
        *((50000, value) for value in (0, 1, 1)), (50011, 1), *((50001, amps) for amps in (-4.0, -0.5, 0.5, 4.0)),
        *((50012, celsius) for celsius in (-273.0, 20.0, 60.0, 1000.0)), (2030, 0.1), (2030, 4.0), (4010, -100.0),
        (4011, 500.0), (4012, 1e5), (2060, 1.0), (2060, 0.0),
    )  # fmt: skip
    """Writes that make the device act."""
    _PAYLOAD = re.compile(rb"\+0[1-9]|(?:[0-9A-F]{2})+|[ -~]{20}")

    def _sealed(self, rng, payload, address=None):
        if address is None:
            address = rng.choice((0, 1, 1, 1, 1, 1, 1, 255, rng.randrange(256)))
        head = b"#%02X%04X%b" % (address, rng.randrange(0x10000), payload)
        return head + b"%04X\r" % crc_hqx(head, 0)

    def request(self, rng):
        if rng.random() < 0.4:
            number, value = rng.choice(self._ACTING)
            raw = struct.pack(">i" if isinstance(value, int) else ">f", value)
            return self._sealed(rng, b"VS%04X01%b" % (number, raw.hex().upper().encode()))
        number = rng.choice(tuple(PARAMETERS)) if rng.random() < 0.8 else rng.randrange(0x10000)
        row = b"%04X%02X" % (number, 1 if rng.random() < 0.9 else rng.randrange(256))
        command = rng.choices(
            (b"?VR", b"VS", b"?VL", b"?VM", b"?IF", b"CS", b"ES", b"RS"), (6, 12, 1, 1, 1, 1, 1, 2)
        )[0]
        operand = {b"VS": row + word_32(rng).hex().upper().encode(), b"CS": b"0000E100", b"?IF": b"", b"ES": b""}
        return self._sealed(rng, command + operand.get(command, b"" if command == b"RS" else row))

    def wild(self, rng):
        command = rng.choice((b"", b"?VR", b"VS", b"?VM", b"?VX", b"VX", b"VB", b"?VB", b"SP", b"CS", b"?", b"?IF"))
        alphabet = rng.choice((b"0123456789ABCDEF", b"0123456789abcdefxyz+-#!", bytes(range(256))))
        return self._sealed(rng, command + bytes(rng.choices(alphabet, k=rng.randrange(40))))

    def check(self, answers):
        *lines, rest = answers.split(b"\r")
        if rest:
            raise MalformedError(f"no end: {rest!r}")
        for line in lines:
            match = self._ANSWER.fullmatch(line)
            if match is None:
                raise MalformedError(f"no answer: {line!r}")
            if match[2] and (match[3] != b"%04X" % crc_hqx(line[:-4], 0) or not self._PAYLOAD.fullmatch(match[2])):
                raise MalformedError(f"CRC or payload: {line!r}")
        return len(lines)

    def restoring(self, rng):
        return self._sealed(rng, b"VS08030100000001", 0) + self._sealed(rng, b"RS", 0)

    def probe(self, rng):
        request = self._sealed(rng, b"?VR006401", address=0)

        def check(answer):
            line = answer.split(b"\r")[-2]
            if line[:7] != b"!" + request[1:7] or line[7:-4] != b"%08X" % 1091:
                raise MalformedError(f"{request!r} is answered by {answer!r}")

        return request, check


def reads(address, count):
    """Return the request of function 3."""
    return struct.pack(">BHH", 3, address, count)


def writes(address, form, *values):
    """Return the requests of function 16 that write each of these values."""
    size = struct.calcsize(form)
    return [struct.pack(">BHHB" + form, 16, address, size // 2, size, value) for value in values]


class _Modbus(Dialect):
    """What both transports of Modbus have in common.

    `addresses` are registers that exist, `acting` are requests that make the instrument act.
    """

    def __init__(self, addresses, acting):
        self.addresses = addresses
        self.acting = acting

    def pdu(self, rng):
        if rng.random() < 0.5:
            return rng.choice(self.acting)
        address = rng.choice(self.addresses) if rng.random() < 0.8 else rng.randrange(0x10000)
        function = rng.choices((3, 4, 6, 16), (4, 2, 3, 6))[0]
        if function in (3, 4):
            return struct.pack(">BHH", function, address, rng.choice((1, 2, 2, 4, 28, 125, rng.randrange(0x10000))))
        if function == 6:
            return struct.pack(">BHH", 6, address, rng.choice((0, 1, 2, 8, 0xFFFF, rng.randrange(0x10000))))
        values = b"".join(word_32(rng) for _ in range(rng.choice((1, 1, 1, 2, 5))))
        if rng.random() < 0.1:
            values = values[:-2]
        return struct.pack(">BHHB", 16, address, len(values) // 2, len(values)) + values

    def wild_pdu(self, rng):
        length = rng.choice((0, 1, 4, 5, rng.randrange(60), 251))
        return bytes((rng.choice((3, 4, 6, 16, rng.randrange(256))),)) + rng.randbytes(length)

    def length(self, answer):
        """Return the length of the answer that begins here with its function code."""
        function = answer[0]
        if function & 0x80:
            if not 1 <= answer[1] <= 11:
                raise MalformedError(f"exception {answer[1]}")
            return 2
        if function in (3, 4) and answer[1] and answer[1] % 2 == 0:
            return 2 + answer[1]
        if function in (6, 16):
            return 5
        raise MalformedError(f"no answer: {answer[:16].hex(' ')}")


class ModbusTcp(_Modbus):
    """MODBUS Messaging on TCP/IP V1.0b, and LabJack's function 76: several reads and writes in one request."""

    _FEEDBACK = 76

    def __init__(self, addresses, acting, probed, returned=None):
        """Take a read of registers that always succeeds, and the bytes that it returns if these are constant."""
        super().__init__(addresses, acting)
        self._probed, self._returned = probed, returned

    def pdu(self, rng):
        if rng.random() < 0.8:
            return super().pdu(rng)
        frames = bytes((self._FEEDBACK,))
        for _ in range(rng.choice((1, 2, 5, 30))):
            address = rng.choice(self.addresses) if rng.random() < 0.95 else rng.randrange(0x10000)
            number = rng.choice((1, 2, 2, 2, 4, 28, rng.randrange(256)))
            if rng.random() < 0.5:
                frames += struct.pack(">BHB", 0, address, number)
            else:
                values = b"".join(word_32(rng) for _ in range(number + 1 >> 1))[: 2 * number]
                frames += struct.pack(">BHB", 1, address, number) + values
        return frames[:1030]

    def _sealed(self, rng, pdu):
        return struct.pack(">HHHB", rng.randrange(0x10000), 0, len(pdu) + 1, rng.choice((0, 1, 255))) + pdu

    def request(self, rng):
        return self._sealed(rng, self.pdu(rng))

    def wild(self, rng):
        return self._sealed(rng, self.wild_pdu(rng))

    def check(self, answers):
        count = 0
        while answers:
            if len(answers) < 8:
                raise MalformedError(f"cut off: {answers.hex(' ')}")
            _, protocol, length = struct.unpack_from(">HHH", answers)
            expected = length - 1 if answers[7] == self._FEEDBACK else self.length(answers[7:])
            if protocol or length != 1 + expected or len(answers) < 6 + length:
                raise MalformedError(f"header: {answers[:16].hex(' ')}")
            answers = answers[6 + length :]
            count += 1
        return count

    def probe(self, rng):
        request = self._sealed(rng, self._probed)

        def check(answer):
            size = 2 * request[-1]
            returned = answer[9:] if self._returned is None else self._returned
            head = request[:4] + struct.pack(">HBBB", 3 + size, request[6], 3, size)
            if answer != head + returned or len(returned) != size:
                raise MalformedError(f"{request.hex(' ')} is answered by {answer.hex(' ')}")

        return request, check


class ModbusRtu(_Modbus):
    """MODBUS over Serial Line V1.02."""

    # Without the pauses of a line, a frame that lacks its last byte may be completed by the first one of the next.
    trials = 2

    @staticmethod
    def _crc(frame):
        crc = 0xFFFF
        for byte in frame:
            crc ^= byte
            for _ in range(8):
                crc = crc >> 1 ^ 0xA001 * (crc & 1)
        return struct.pack("<H", crc)

    def _sealed(self, rng, pdu, address=None):
        if address is None:
            address = 1 if rng.random() < 0.9 else rng.randrange(256)
        frame = bytes((address,)) + pdu
        return frame + self._crc(frame)

    def request(self, rng):
        return self._sealed(rng, self.pdu(rng))

    def wild(self, rng):
        return self._sealed(rng, self.wild_pdu(rng))

    def check(self, answers):
        count = 0
        while answers:
            if len(answers) < 5 or answers[0] != 1:
                raise MalformedError(f"cut off, or a foreign address: {answers[:16].hex(' ')}")
            end = 3 + self.length(answers[1:])
            if answers[end - 2 : end] != self._crc(answers[: end - 2]):
                raise MalformedError(f"CRC: {answers[:end].hex(' ')}")
            answers = answers[end:]
            count += 1
        return count

    def probe(self, rng):
        request = self._sealed(rng, struct.pack(">BHH", 3, 0x202C, 2), address=1)

        def check(answer):
            expected = struct.pack(">BBBI", 1, 3, 4, 1410)
            if not answer.endswith(expected + self._crc(expected)):
                raise MalformedError(f"the device identity is answered by {answer.hex(' ')}")

        return request, check


class Dynamixel(Dialect):
    """ROBOTIS e-Manual, Protocol 2.0."""

    _HEADER = b"\xff\xff\xfd\0"
    _BROADCAST = 254
    _ACTING = (
        *((11, "B", value) for value in (1, 3, 4, 16)), *((64, "B", value) for value in (0, 1, 1)), (98, "b", 0),
        (98, "b", 5), *((100, "h", value) for value in (-885, 0, 400)),
        *((104, "i", value) for value in (-300, 0, 20)), (108, "I", 100),
        (108, "I", 0), (112, "I", 1), (112, "I", 0), (63, "B", 0), (20, "i", -1000),
        *((116, "i", value) for value in (0, 2200, 4095, -1_048_575, 1_048_575)), (84, "H", 0), (84, "H", 16383),
    )  # fmt: skip
    """Writes that make the servo act."""
    _ROWS = (*sorted(ITEMS), *range(168, 252), *range(578, 662))

    @staticmethod
    def _crc(frame):
        crc = 0
        for byte in frame:
            crc ^= byte << 8
            for _ in range(8):
                crc = crc << 1 ^ (0x8005 if crc & 0x8000 else 0)
            crc &= 0xFFFF
        return struct.pack("<H", crc)

    def _sealed(self, number, instruction, parameters=b""):
        body = (bytes((instruction,)) + parameters).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        frame = self._HEADER + struct.pack("<BH", number, len(body) + 2) + body
        return frame + self._crc(frame)

    def _id(self, rng):
        return rng.choices((1, self._BROADCAST, rng.randrange(256)), (8, 1, 1))[0]

    def _row(self, rng):
        """Return an address and data for it."""
        address = rng.choice(self._ROWS) if rng.random() < 0.9 else rng.randrange(0x10000)
        if address == 7 and rng.random() < 0.9:
            address = 116
        size = ITEMS[address].size if address in ITEMS and rng.random() < 0.9 else rng.randrange(1, 9)
        kind = rng.randrange(3)
        if kind == 0:
            data = rng.randbytes(size)
        elif kind == 1:
            data = rng.randrange(3).to_bytes(size, "little")
        else:
            data = (rng.randrange(-2000, 4096) & (1 << 8 * size) - 1).to_bytes(size, "little")
        return address, data

    def request(self, rng):
        if rng.random() < 0.5:
            address, form, value = rng.choice(self._ACTING)
            return self._sealed(1, 3, struct.pack("<H" + form, address, value))
        address, data = self._row(rng)
        kind = rng.choices(
            (1, 2, 3, 4, 5, 6, 8, 0x10, 0x82, 0x83, 0x8A, 0x92, 0x93, 0x9A),
            (1, 5, 14, 2, 2, 1, 1, 1, 2, 2, 2, 2, 2, 2),
        )[0]
        ids = rng.sample((0, 1, 1, 2, 252), k=rng.randrange(1, 4))
        read = struct.pack("<HH", address, len(data))
        parameters = {
            2: read,
            3: struct.pack("<H", address) + data,
            4: struct.pack("<H", address) + data,
            6: bytes((rng.choice((1, 2, 255)),)),
            0x10: b"\1DXL\x22",
            0x82: read + bytes(ids),
            0x8A: read + bytes(ids),
            0x83: read + b"".join(bytes((number,)) + data for number in ids),
            0x92: b"".join(bytes((number,)) + read for number in ids),
            0x9A: b"".join(bytes((number,)) + read for number in ids),
            0x93: b"".join(bytes((number,)) + read + data for number in ids),
        }
        number = self._BROADCAST if kind >= 0x80 and rng.random() < 0.9 else self._id(rng)
        return self._sealed(number, kind, parameters.get(kind, b""))

    def wild(self, rng):
        instruction = rng.choice(
            (1, 2, 3, 4, 5, 6, 8, 0x10, 0x55, 0x82, 0x83, 0x8A, 0x92, 0x93, 0x9A, rng.randrange(256))
        )
        number = self._BROADCAST if instruction >= 0x80 else self._id(rng)
        alphabet = rng.choice((bytes(range(256)), b"\xff\xfd\0\1"))
        return self._sealed(number, instruction, bytes(rng.choices(alphabet, k=rng.choice((0, 1, 4, 9, 40, 900)))))

    def check(self, answers):
        count = 0
        while answers:
            if answers[:4] != self._HEADER or len(answers) < 11 or answers[7] != 0x55:
                raise MalformedError(f"header: {answers[:16].hex(' ')}")
            number, length = struct.unpack_from("<BH", answers, 4)
            if number == self._BROADCAST:
                end = self._end_of_fast_answer(answers)
            else:
                end = 7 + length
                body = answers[7 : end - 2]
                if self._HEADER in body or body[1] & 0x7F > 7:
                    raise MalformedError(f"stuffing or error number: {answers[:end].hex(' ')}")
            if len(answers) < end or answers[end - 2 : end] != self._crc(answers[: end - 2]):
                raise MalformedError(f"CRC: {answers[:end].hex(' ')}")
            answers = answers[end:]
            count += 1
        return count

    def _end_of_fast_answer(self, answers):
        """Return where an answer of several servos ends, which may be before the length that it announces."""
        announced = 7 + struct.unpack_from("<H", answers, 5)[0]
        for end in range(min(announced, len(answers)), 11, -1):
            ends = end == len(answers) or answers[end : end + 4] == self._HEADER
            if ends and answers[end - 2 : end] == self._crc(answers[: end - 2]):
                return end
        raise MalformedError(f"no end of a fast answer: {answers.hex(' ')}")

    def restoring(self, rng):  # noqa: ARG002
        torque_off, number = (
            self._sealed(self._BROADCAST, 3, struct.pack("<HB", *pair)) for pair in ((64, 0), (7, 1))
        )
        return torque_off + number + self._sealed(self._BROADCAST, 8)

    def probe(self, rng):  # noqa: ARG002
        request = self._sealed(self._BROADCAST, 1)

        def check(answer):
            # The servo's id may have been changed; model and firmware may not.
            last = answer[-14:]
            if last[:4] != self._HEADER or last[9:12] != struct.pack("<HB", 30, 45) or self.check(last) != 1:
                raise MalformedError(f"a ping is answered by {answer.hex(' ')}")

        return request, check


class SlcanCanopen(Dialect):
    """LAWICEL CAN232 V3 with a CANopen node (CiA 301) on its bus."""

    _ANSWER = re.compile(
        rb"\r|\a|V[0-9A-F]{4}\r|N.{4}\r|F[0-9A-F]{2}\r|[zZ]\r|t[0-7][0-9A-F]{2}(?:%b)\r"
        % b"|".join(b"%d[0-9A-F]{%d}" % (size, 2 * size) for size in range(9))
    )

    _ACTING = (
        *((0x2000, 1, 0x23, value) for value in (-1000, -300, 0, 0, 1, 300, 700, 1000)), (0x2000, 2, 0x23, 500),
        (0x200C, 0, 0x2F, 1), (0x200D, 0, 0x2F, 1), (0x200D, 0, 0x2F, 1), (0x200E, 0, 0x2F, 1), (0x1017, 0, 0x2B, 10),
        (0x1017, 0, 0x2B, 0), (0x1008, 0, 0x40, 0),
    )  # fmt: skip
    """Downloads that make the controller act, and the upload of a text."""

    def _frame(self, identifier, data):
        return b"t%03X%d%b\r" % (identifier, len(data), data.hex().upper().encode())

    def _sdo(self, rng, command=None):
        index, sub = rng.choice(tuple(DICTIONARY))
        if rng.random() < 0.1:
            index, sub = rng.randrange(0x10000), rng.randrange(256)
        if command is None:
            sizes = {"S8": 0x2F, "U8": 0x2F, "S16": 0x2B, "U16": 0x2B, "S32": 0x23, "U32": 0x23}
            right = sizes.get(DICTIONARY[index, sub].kind, 0x23) if (index, sub) in DICTIONARY else 0x23
            command = rng.choice((right, right, right, 0x40, 0x40, 0x20, 0x21, 0x22, 0x60, 0x70, 0x80, 0xA4, 0xC0))
        value = rng.choice((rng.randbytes(4), struct.pack("<i", rng.randrange(-1100, 1101)), struct.pack("<I", 1)))
        return self._frame(0x601, struct.pack("<BHB", command, index, sub) + value)

    def request(self, rng):
        kind = rng.randrange(10)
        if kind < 3:
            index, sub, command, value = rng.choice(self._ACTING)
            return self._frame(0x601, struct.pack("<BHBi", command, index, sub, value))
        if kind < 7:
            return self._sdo(rng)
        if kind == 7:
            return self._frame(0, bytes((rng.choice((1, 1, 1, 2, 128, 129, 130)), rng.choice((0, 1, 5)))))
        if kind == 8:
            return rng.choice(
                (b"C\r", b"O\r", b"L\r", b"S4\r", b"S6\r", b"V\r", b"N\r", b"F\r", b"Z0\r", b"\r", b"Z1\r")
            )
        # What brings the channel into working order again.
        return b"C\rS4\rO\r"

    def wild(self, rng):
        if rng.random() < 0.5:
            return self._sdo(rng, rng.randrange(256))
        size = rng.randrange(9)
        return self._frame(rng.choice((0, 0x601, 0x80, 0x701, 0x581, rng.randrange(0x800))), rng.randbytes(size))

    def check(self, answers):
        position = count = 0
        while position < len(answers):
            match = self._ANSWER.match(answers, position)
            if match is None:
                raise MalformedError(f"no line of the adapter: {answers[position : position + 40]!r}")
            position = match.end()
            count += 1
        return count

    def probe(self, rng):  # noqa: ARG002
        request = b"\rC\rS4\rO\r" + self._frame(0, b"\1\0") + b"t6018400D210300000000\r"

        def check(answer):
            # 0x210D:3 is the 5 V output, mV.
            if b"t58184B0D210388130000\r" not in answer:
                raise MalformedError(f"an SDO upload is answered by {answer!r}")

        return request, check


class Scpi(Dialect):
    """Messages of SCPI-99 that end with a line feed."""

    def __init__(self, questions, messages):
        """Take questions and messages that the instrument knows; `{}` stands for a number."""
        self._questions = questions
        self._messages = messages

    def _number(self, rng):
        return rng.choice(
            ("0", "5", "-1", "11.5", "1e400", "nan", "inf", "9" * 400, "", "12,5", f"{rng.uniform(-20, 20)}")
        )

    def _one(self, rng):
        message = rng.choice((*self._questions, *self._messages, *self._messages, "*RST", "*CLS", "*OPC", "*ESE 255"))
        message = message.replace("{}", self._number(rng))
        return rng.choice((message, message.lower(), f":{message}", f"  {message} ", message[: rng.randrange(9)]))

    def request(self, rng):
        return ";".join(self._one(rng) for _ in range(rng.choice((1, 1, 1, 2, 5)))).encode() + b"\n"

    def wild(self, rng):
        head = self._one(rng).encode()
        filling = rng.choice((b" ", b"\0", b"9", b";", b"\xff", b"+", b"e", b":", b"VOLT "))
        return (
            head
            + filling * rng.choice((1, 10, 300, 5000))
            + rng.randbytes(rng.randrange(8)).replace(b"\n", b"")
            + b"\n"
        )

    def check(self, answers):
        *lines, rest = answers.split(b"\n")
        if rest or not all(line and line.isascii() and line.decode().isprintable() for line in lines):
            raise MalformedError(f"no lines of text: {answers!r}")
        return len(lines)

    def probe(self, rng):  # noqa: ARG002
        request = b"\n*CLS\nSYST:ERR?\n"

        def check(answer):
            if not answer.endswith(b'0,"No error"\n'):
                raise MalformedError(f"no error is answered by {answer!r}")

        return request, check
