import pytest
import serial

from sim_devices import protocol_emulated
from sim_devices.wire import WireServer
from sim_devices.wire.modbus_tcp import ModbusTcpInstrument


class Echo(WireServer):
    """Answers every line with itself, reversed."""

    def __init__(self):
        self.received = bytearray()
        self.pieces = []

    def receive(self, data):
        self.pieces.append(data)
        self.received += data
        *lines, rest = bytes(self.received).split(b"\n")
        self.received = bytearray(rest)
        return b"".join(line[::-1] + b"\n" for line in lines)


@pytest.fixture
def echo(clock):
    server = Echo()
    protocol_emulated.register("echo", server, clock)
    yield server
    protocol_emulated.unregister("echo")


@pytest.fixture
def port(echo):
    with serial.serial_for_url("emulated://echo", baudrate=57600, timeout=0.5) as port:
        yield port


class TestAddress:
    def test_of_a_registered_instrument(self, clock):
        try:
            assert protocol_emulated.register("here", Echo(), clock) == "emulated://here"
        finally:
            protocol_emulated.unregister("here")

    @pytest.mark.usefixtures("echo")
    def test_is_not_given_twice(self, clock):
        others = [protocol_emulated.register("echo", Echo(), clock) for _ in range(2)]
        try:
            assert others == ["emulated://echo-2", "emulated://echo-3"]
        finally:
            for other in others:
                protocol_emulated.unregister(other)

    @pytest.mark.usefixtures("echo")
    def test_is_free_again_after_unregistering(self, clock):
        protocol_emulated.unregister("echo")
        protocol_emulated.unregister("echo")
        assert protocol_emulated.register("echo", Echo(), clock) == "emulated://echo"

    @pytest.mark.usefixtures("echo")
    def test_an_unknown_name_lists_the_known(self):
        with pytest.raises(
            serial.SerialException, match=r"no emulated instrument at emulated://ehco; there are: .*emulated://echo"
        ):
            serial.serial_for_url("emulated://ehco")


class TestPort:
    def test_writes_are_answered(self, port, echo):
        assert port.write(b"abc\n") == 4
        assert port.in_waiting == 4
        assert port.read(4) == b"cba\n"
        assert port.in_waiting == 0
        assert echo.pieces == [b"abc\n"]

    def test_pieces_make_one_request(self, port):
        port.write(b"ab")
        assert port.in_waiting == 0
        port.write(b"c\nxy\n")
        assert port.read(100) == b"cba\nyx\n"

    def test_what_was_received_can_be_forgotten(self, port):
        port.write(b"abc\n")
        port.reset_output_buffer()
        assert port.in_waiting == 4
        port.reset_input_buffer()
        assert port.in_waiting == 0
        assert port.read(1) == b""


class TestTime:
    def test_each_byte_costs_ten_bits_both_ways(self, port, clock):
        port.write(b"0123456\n")
        assert clock.now() == pytest.approx(16 * 10 / 57600, rel=1e-12)
        port.baudrate = 9600
        before = clock.now()
        port.write(b"0123456\n")
        assert clock.now() - before == pytest.approx(16 * 10 / 9600, rel=1e-9)

    def test_the_instrument_gets_its_request_when_the_last_byte_has_gone(self, clock):
        class Watch(WireServer):
            def receive(self, _):
                self.at = clock.now()
                return b"12345"

        watch = Watch()
        protocol_emulated.register("watch", watch, clock)
        try:
            with serial.serial_for_url("emulated://watch", baudrate=1000, timeout=1) as port:
                port.write(b"0123456789")
                assert watch.at == pytest.approx(0.1)
                assert clock.now() == pytest.approx(0.15)
        finally:
            protocol_emulated.unregister("watch")

    def test_waiting_in_vain_costs_the_timeout(self, port, clock):
        assert port.read(1) == b""
        assert clock.now() == 0.5
        port.write(b"ab\n")
        before = clock.now()
        assert port.read(10) == b"ba\n"
        assert clock.now() == before + 0.5

    def test_a_line_is_read_whole_however_long_the_machine_takes(self, port, clock, monkeypatch):
        hours = iter(range(10**9))
        monkeypatch.setattr("time.monotonic", lambda: 3600.0 * next(hours))
        port.write(b"abc\ndef\n")
        before = clock.now()
        assert port.read_until(b"\n") == b"cba\n"
        assert port.read_until(b"\n", 2) == b"fe"
        assert port.read_until() == b"d\n"
        assert clock.now() == before
        port.write(b"gh")
        assert port.read_until() == b""
        assert clock.now() >= before + 0.5

    @pytest.mark.parametrize("timeout", [0, None])
    def test_without_a_timeout(self, port, clock, timeout):
        port.timeout = timeout
        port.write(b"ab\n")
        before = clock.now()
        assert port.read(3) == b"ba\n"
        assert clock.now() == before

    def test_waiting_for_ever_for_what_never_comes_is_an_error(self, port):
        # A real port would never return, which no test or rehearsal can use.
        port.timeout = None
        with pytest.raises(serial.SerialException, match="ever"):
            port.read(1)


class Beating(WireServer):
    """Sends a beat by itself every 0.3 s from 0.3 s on, and answers nothing."""

    def __init__(self, clock):
        self.clock = clock
        self.sent = 0

    def receive(self, data):  # noqa: ARG002
        return b""

    def unsolicited(self):
        due = int(self.clock.now() / 0.3 + 1e-9) - self.sent
        self.sent += due
        return b"b" * due

    def next_unsolicited(self):
        return 0.3 * (self.sent + 1)


class TestUnsolicited:
    @pytest.fixture
    def port(self, clock):
        address = protocol_emulated.register("heart", Beating(clock), clock)
        with serial.serial_for_url(address, baudrate=1e6, timeout=1.0) as port:
            yield port
        protocol_emulated.unregister(address)

    def test_a_read_waits_for_it_and_no_longer(self, port, clock):
        assert port.read(1) == b"b"
        assert clock.now() == pytest.approx(0.3)
        assert port.read(2) == b"bb"
        assert clock.now() == pytest.approx(0.9)

    def test_a_read_without_a_timeout_waits_for_what_will_come(self, port, clock):
        port.timeout = None
        assert port.read(4) == b"bbbb"
        assert clock.now() == pytest.approx(1.2)

    def test_a_question_forgets_what_came_before_and_keeps_what_comes_meanwhile(self, port, clock):
        clock.sleep(0.7)
        port.baudrate = 100
        port.reset_input_buffer()
        port.write(b"1234")
        assert port.read_all() == b"b"
        assert clock.now() == pytest.approx(1.1)
        assert port.in_waiting == 0


class Bank:
    """A bank of registers that read as their addresses."""

    def read_registers(self, address, count):
        return list(range(address, address + count))

    def write_registers(self, address, values):
        pass


class TestConnection:
    READ = bytes.fromhex("0001 0000 0006 01 03 0005 0001")
    REPLY = bytes.fromhex("0001 0000 0005 01 03 02 0005")

    @pytest.fixture
    def address(self, clock):
        address = protocol_emulated.register("meter", ModbusTcpInstrument(Bank()), clock)
        yield address
        protocol_emulated.unregister(address)

    def test_bytes_take_no_time(self, address, clock):
        with serial.serial_for_url(address, timeout=1.0) as port:
            port.write(self.READ[:3])
            assert port.in_waiting == 0
            port.write(self.READ[3:])
            assert port.read(len(self.REPLY)) == self.REPLY
            assert clock.now() == 0.0
            assert port.read(1) == b""
            assert clock.now() == 1.0

    def test_the_instrument_accepts_two(self, address):
        first, second = (serial.serial_for_url(address) for _ in range(2))
        with pytest.raises(serial.SerialException, match=r"emulated://meter: connection refused"):
            serial.serial_for_url(address)
        second.close()
        with serial.serial_for_url(address) as third:
            third.write(self.READ)
            assert third.in_waiting == len(self.REPLY)
        first.close()

    def test_a_foreign_frame_ends_it(self, address):
        with serial.serial_for_url(address) as port:
            for _ in range(2):
                with pytest.raises(serial.SerialException, match="emulated://meter ended the connection"):
                    port.write(b"\xff" * 8)

    def test_it_does_not_outlive_the_instrument(self, address, clock):
        with serial.serial_for_url(address) as port:
            protocol_emulated.unregister(address)
            assert protocol_emulated.register("meter", ModbusTcpInstrument(Bank()), clock) == address
            with pytest.raises(serial.SerialException, match="emulated://meter was unplugged"):
                port.write(self.READ)


class TestLine:
    @pytest.mark.usefixtures("echo")
    def test_a_port_that_is_not_open(self):
        port = serial.serial_for_url("emulated://echo", do_not_open=True)
        assert not port.is_open
        for use in (
            port.read,
            lambda: port.write(b"x"),
            port.flush,
            port.reset_input_buffer,
            lambda: port.in_waiting,
        ):
            with pytest.raises(serial.PortNotOpenError):
                use()
        port.open()
        assert port.is_open
        port.close()
        with pytest.raises(serial.PortNotOpenError):
            port.read()

    def test_unplugged(self, port):
        port.write(b"abc\n")
        protocol_emulated.unregister("echo")
        for use in (port.read, lambda: port.write(b"x"), lambda: port.in_waiting):
            with pytest.raises(serial.SerialException, match="emulated://echo was unplugged"):
                use()
        port.close()
