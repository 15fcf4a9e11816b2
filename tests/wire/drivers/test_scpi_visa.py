"""The driver of text instruments against pyvisa-sim, a simulator of other people."""

import pytest

from bench.base import DeviceConnectionError, DeviceError, WallClock
from drivers.scpi import SCPIActuator
from drivers.scpi.transport import TextLineSettings, VisaTransport

pytest.importorskip("pyvisa_sim")

INSTRUMENT = """
spec: "1.1"
devices:
  supply:
    eom:
      ASRL INSTR: {q: "\\r\\n", r: "\\n"}
      USB INSTR: {q: "\\n", r: "\\n"}
      TCPIP INSTR: {q: "\\n", r: "\\n"}
      TCPIP SOCKET: {q: "\\n", r: "\\n"}
      GPIB INSTR: {q: "\\n", r: "\\n"}
    error:
      error_queue:
        - q: "SYST:ERR?"
          default: '0,"No error"'
          command_error: '-113,"Undefined header"'
    dialogues:
      - {q: "*IDN?", r: "ACME,PSU-1,42,2.0"}
      - {q: "*OPC?", r: "1"}
    properties:
      voltage:
        default: 0.0
        getter: {q: "VOLT?", r: "{:+.6E}"}
        setter: {q: "VOLT {:.3f}"}
        specs: {min: 0, max: 20, type: float}
      output:
        default: 0
        getter: {q: "OUTP?", r: "{:d}"}
        setter: {q: "OUTP {:d}"}
        specs: {valid: [0, 1], type: int}
resources:
  ASRL1::INSTR: {device: supply}
  TCPIP0::192.0.2.5::inst0::INSTR: {device: supply}
  TCPIP0::192.0.2.5::5025::SOCKET: {device: supply}
  USB0::0x1234::0x5678::42::INSTR: {device: supply}
  GPIB0::5::INSTR: {device: supply}
"""

TABLE = {
    "identity": "ACME,PSU-1,{any}",
    "error_query": "SYST:ERR?",
    "completion_query": "*OPC?",
    "signals": {"voltage": {"query": "VOLT?", "unit": "V"}},
    "setpoint": {"command": "VOLT {value:.3f}", "query": "VOLT?", "unit": "V", "limits": [0.0, 20.0]},
    "output": {"on": ["OUTP 1"], "off": ["OUTP 0"], "query": "OUTP?"},
}


@pytest.fixture
def connect(tmp_path):
    """Return a function that connects to a resource of the simulator."""
    (tmp_path / "supply.yaml").write_text(INSTRUMENT)
    devices = []

    def at(resource, **changes):
        terminator = "\r\n" if resource.startswith("ASRL") else "\n"
        settings = SCPIActuator.Settings(
            port=f"visa://{resource}",
            visa_library=f"{tmp_path / 'supply.yaml'}@sim",
            write_terminator=terminator,
            **{"timeout": 0.2, **TABLE, **changes},
        )
        devices.append(SCPIActuator.connect("supply", settings, WallClock()))
        return devices[-1]

    yield at
    for device in devices:
        device.close()


@pytest.mark.parametrize(
    "resource",
    [
        "ASRL1::INSTR",
        "TCPIP0::192.0.2.5::inst0::INSTR",
        "TCPIP0::192.0.2.5::5025::SOCKET",
        "USB0::0x1234::0x5678::42::INSTR",
        "GPIB0::5::INSTR",
    ],
)
def test_it_is_set_and_measured_over_each_interface(connect, resource):
    supply = connect(resource)
    assert str(supply.identity) == "ACME PSU-1, serial number 42, firmware 2.0"
    for value in (0.0, 12.5, 20.0):
        supply.set(value).wait()
        assert supply.measure() == supply.glance() == {"supply_voltage": value}
    supply.safe()
    with pytest.raises(DeviceError, match=r"supply: answered 'ACME,PSU-1,42,2\.0' to"):
        connect(resource, signals={"voltage": {"query": "*IDN?", "unit": "V"}}).glance()


def test_its_errors_are_raised(connect):
    with pytest.raises(DeviceError, match=r'reports after the messages of setup: -113,"Undefined header"'):
        connect("GPIB0::5::INSTR", setup=["NONSENSE"])


def test_silence_is_a_connection_error(connect):
    with pytest.raises(DeviceConnectionError, match=r"no answer to 'VOLT\? MIN' within 0\.2 s"):
        connect("GPIB0::5::INSTR", identity_query="", error_query="", setpoint={
            **TABLE["setpoint"], "range_queries": ["VOLT? MIN", "VOLT? MAX"],
        })  # fmt: skip


def test_a_resource_that_is_not_there_is_a_connection_error(connect):
    with pytest.raises(DeviceConnectionError, match="supply: cannot open visa://GPIB0::6::INSTR: "):
        connect("GPIB0::6::INSTR")


class Resource:
    """A resource of a VISA library: what was set and written, and what it does when it is read."""

    def __init__(self, interface):
        self.interface_type = interface
        self.written, self.flushed, self.closed = [], [], 0
        self.answers = []

    def write_raw(self, message):
        self.written.append(message)
        if self.answers and isinstance(self.answers[0], Exception) and message == b"fail":
            raise self.answers.pop(0)

    def read_raw(self):
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def flush(self, buffer):
        self.flushed.append(buffer)
        raise NotImplementedError

    def close(self):
        self.closed += 1


@pytest.fixture
def opened(monkeypatch):
    """Open a transport on a resource of a library that is not there."""
    import pyvisa

    def opened(kind="asrl", resource=None, **changes):
        resource = resource or Resource(getattr(pyvisa.constants.InterfaceType, kind))

        class Manager:
            def __init__(self, library):
                resource.library = library

            def open_resource(self, name, **options):
                resource.name, resource.options = name, options
                return resource

        monkeypatch.setattr(pyvisa, "ResourceManager", Manager)
        settings = TextLineSettings(port="visa://ASRL1::INSTR", **changes)
        return VisaTransport("supply", settings, b"\r\n"), resource

    return opened


@pytest.mark.parametrize(
    ("changes", "parity", "stop_bits", "flow"),
    [
        ({}, "none", "one", "none"),
        ({"parity": "E", "stop_bits": 2, "flow_control": "xon-xoff"}, "even", "two", "xon_xoff"),
        ({"parity": "O", "flow_control": "rts-cts"}, "odd", "one", "rts_cts"),
        ({"flow_control": "dtr-dsr"}, "none", "one", "dtr_dsr"),
    ],
)
def test_a_serial_resource_is_set_up_as_the_rig_file_says(opened, changes, parity, stop_bits, flow):
    from pyvisa import constants

    _, resource = opened(baudrate=19200, timeout=0.25, visa_library="@py", **changes)
    assert (resource.library, resource.name) == ("@py", "ASRL1::INSTR")
    assert resource.options == {"open_timeout": 250, "timeout": 250.0}
    assert resource.baud_rate == 19200
    assert resource.parity == getattr(constants.Parity, parity)
    assert resource.stop_bits == getattr(constants.StopBits, stop_bits)
    assert resource.flow_control == getattr(constants.ControlFlow, flow)
    assert resource.read_termination == "\n"


def test_other_resources_have_no_speed(opened):
    _, resource = opened("tcpip")
    assert not hasattr(resource, "baud_rate")
    assert resource.read_termination == "\n"


def test_what_a_resource_answers(opened):
    from pyvisa.constants import BufferOperation, StatusCode
    from pyvisa.errors import VisaIOError

    transport, resource = opened()
    resource.answers = [b"1.5\r\n", b"1.5", VisaIOError(StatusCode.error_timeout), VisaIOError(StatusCode.error_io)]
    assert [transport.read() for _ in range(3)] == [b"1.5", b"1.5", None]
    with pytest.raises(DeviceConnectionError, match="lost the line visa://ASRL1::INSTR"):
        transport.read()
    resource.answers = [OSError("gone")]
    with pytest.raises(DeviceConnectionError, match="lost the line"):
        transport.write(b"fail")
    transport.discard()
    assert resource.flushed == [BufferOperation.discard_read_buffer]
    transport.close()
    resource.close = lambda: (_ for _ in ()).throw(OSError("gone"))
    transport.close()
    assert resource.closed == 1


def test_a_resource_that_cannot_be_set_up_is_closed(opened):
    import pyvisa

    class Odd(Resource):
        @property
        def baud_rate(self):
            return 0

        @baud_rate.setter
        def baud_rate(self, value):
            raise ValueError(f"no such speed as {value}")

    resource = Odd(pyvisa.constants.InterfaceType.asrl)
    with pytest.raises(DeviceConnectionError, match=r"cannot open visa://ASRL1::INSTR: no such speed as 9600"):
        opened(resource=resource)
    assert resource.closed == 1
