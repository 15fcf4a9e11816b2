"""The driver of text instruments against pyvisa-sim, a simulator of other people."""

import pytest

from bench.clock import WallClock
from bench.errors import DeviceConnectionError, DeviceError
from drivers.scpi import SCPIActuator

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
