"""The driver of text instruments against the emulated one, and against lines that fail in known ways."""

import math
import socket
from contextlib import ExitStack

import pytest
from cases import cases
from hypothesis import given, settings, strategies as st
from text_laboratory import SUPPLY, Laboratory

from bench.base import ConfigurationError, DeviceConnectionError, DeviceError, VirtualClock
from bench.contracts import ActuatorContract, SilentInstrumentContract
from drivers.scpi import SCPIActuator, SCPISensor, SCPIVoltageSupply
from sim_devices import protocol_emulated
from sim_devices.wire.text import TextServer


@pytest.fixture
def stack():
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def lab(stack):
    return Laboratory(stack)


def test_connecting_checks_the_identity_and_moves_nothing(lab):
    device = lab.connect()
    assert str(device.identity) == "EXAMPLE PS-3005, serial number emulated, firmware unknown"
    assert lab.delivered[-1] == 0.0
    assert not lab.instrument.on


def test_another_instrument_is_refused(stack):
    lab = Laboratory(stack)
    lab.answer = lambda data, usual: b"OTHER,METER,7,1.0\n" if b"IDN" in data else usual(data)
    with pytest.raises(DeviceConnectionError, match=r"is 'OTHER,METER,7,1\.0', expected 'EXAMPLE,PS-3005,{any}'"):
        lab.connect()
    assert lab.requests == ["*IDN?"]


def test_errors_from_before_are_forgotten_and_those_of_setup_are_raised(stack):
    lab = Laboratory(stack)
    lab.instrument.report('-410,"Query INTERRUPTED"')
    lab.connect()
    lab.answer = lambda data, usual: usual(data.replace(b"VOLT:PROT", b"VOLT:PROTECT"))
    with pytest.raises(DeviceError, match='reports after the messages of setup: -113,"Undefined header"'):
        lab.connect()


def test_a_set_point_is_read_back_before_the_output_goes_on(lab):
    device = lab.connect()
    device.set(12.3456).wait()
    assert lab.requests == [
        "VOLT:PROT 31", "VOLT 12.346", "*OPC?", "VOLT?", "CURR 1.0", "OUTP ON", "SYST:ERR?", "OUTP?",
    ]  # fmt: skip
    assert lab.delivered[-1] == 12.346
    lab.requests.clear()
    device.set(3.0)
    assert lab.requests == ["OUTP?", "VOLT 3.000", "*OPC?", "VOLT?", "SYST:ERR?"]
    assert device.measure() == {"supply_voltage": 3.0, "supply_current": pytest.approx(0.25)}


def test_a_set_point_that_the_instrument_does_not_take_is_an_error_and_stays_off(lab):
    device = lab.connect()
    lab.answer = lambda data, usual: usual(data.replace(b"VOLT 5.000", b"VOLT 50"))
    with pytest.raises(DeviceError, match=r"reads its set-point back as 0 V, not 5 V .*Data out of range"):
        device.set(5.0)
    assert not lab.instrument.on


def test_all_errors_of_the_queue_stand_in_one_message(lab):
    device = lab.connect()
    lab.instrument.report('-310,"System error"')
    lab.instrument.report('-330,"Self-test failed"')
    with pytest.raises(DeviceError, match=r'measuring: -310,"System error"; -330,"Self-test failed"$'):
        device.measure()
    device.measure()


def test_a_queue_without_end_is_read_so_far(lab):
    device = lab.connect()
    lab.answer = lambda data, usual: b'-1,"again"\n' if b"ERR" in data else usual(data)
    with pytest.raises(DeviceError, match="again"):
        device.measure()
    assert lab.requests.count("SYST:ERR?") == 32


def test_a_glance_leaves_the_queue_alone(lab):
    device = lab.connect()
    device.glance()
    assert lab.requests == ["MEAS:VOLT?", "MEAS:CURR?"]


@pytest.mark.parametrize("cause", ["power_cycle", "protection", "front panel"])
def test_what_happens_without_the_bench_is_found_by_the_next_reading(lab, cause):
    device = lab.connect()
    device.set(5.0)
    if cause == "power_cycle":
        lab.instrument.power_cycle()
    elif cause == "protection":
        lab.instrument.switch(False)
    else:
        lab.instrument.obey("VOLT 6")
    expected = {
        "power_cycle": "its output is off and its set-point is lost: it has restarted",
        "protection": "its output is off although it was switched on",
        "front panel": "back as 6 V, not 5 V",
    }[cause]
    with pytest.raises(DeviceError, match=expected):
        device.measure()


def test_the_safe_state_is_confirmed(lab):
    device = lab.connect()
    device.set(5.0)
    device.safe()
    assert lab.delivered[-1] == 0.0
    assert math.isnan(device.setpoint)
    device.set(5.0)
    lab.answer = lambda data, usual: usual(data.replace(b"OUTP OFF", b"OUTP"))
    with pytest.raises(
        DeviceError, match=r"does not confirm that its output is off \(supply: says that its output is on"
    ):
        device.safe()


def test_without_a_question_for_the_state_the_instrument_has_to_answer(stack):
    lab = Laboratory(stack, output={"off": ["VOLT 0"]})
    device = lab.connect()
    device.set(5.0)
    device.safe()
    assert lab.delivered[-1] == 0.0
    lab.answer = lambda data, usual: b"" if b"IDN" in data else usual(data)
    lab.requests.clear()
    with pytest.raises(DeviceError, match="does not confirm"):
        device.safe()
    # It is asked once, and once more over another line.
    assert lab.requests.count("*IDN?") == 2
    lab.instrument.unplug()
    with pytest.raises(DeviceError, match="does not confirm"):
        device.safe()


def test_limits_beyond_what_the_instrument_takes_are_refused_on_connecting(stack):
    setpoint = {**SUPPLY["setpoint"], "range_queries": ["VOLT? MIN", "VOLT? MAX"]}
    Laboratory(stack, setpoint=setpoint).connect()
    stack.close()
    lab = Laboratory(stack, setpoint=setpoint)
    lab.answer = lambda data, usual: b"20.0\n" if b"MAX" in data else usual(data)
    with pytest.raises(ConfigurationError, match=r"setpoint\.limits = 0 to 30 V: the instrument takes 0 to 20 V"):
        lab.connect()


class Late:
    """A line whose next answers come later than the time-out: with the answer after so many others, or by itself."""

    def __init__(self, count=1):
        self.count = count
        self.held = b""

    def __call__(self, data, usual):
        answer = usual(data)
        if answer and self.count:
            self.count -= 1
            self.held += answer
            return b""
        answer, self.held = self.held + answer, b""
        return answer


@pytest.mark.parametrize("count", [1, 2])
def test_a_late_answer_is_not_taken_for_that_of_the_next_question(lab, count):
    device = lab.connect()
    device.set(7.0)
    lab.current = 123.0
    lab.answer = Late(count)
    lab.requests.clear()
    assert device.glance() == {"supply_voltage": 7.0, "supply_current": pytest.approx(123.0)}
    assert lab.requests[0] == "MEAS:VOLT?"
    assert "*IDN?" in lab.requests


def test_commands_are_sent_once(lab):
    device = lab.connect()
    lab.instrument.unplug()
    lab.requests.clear()
    with pytest.raises(DeviceConnectionError):
        device.set(5.0)
    assert lab.requests.count("VOLT 5.000") == 1
    lab.instrument.plug_in()
    device.set(5.0)
    assert device.measure()["supply_voltage"] == 5.0


@pytest.mark.parametrize("answer", [b"9.9E37\n", b"9.91E37\n", b"OL\n", b"\n", b"\xff\xfe\n"])
def test_an_answer_that_is_no_number_is_an_error(lab, answer):
    device = lab.connect()
    lab.answer = lambda data, usual: answer if b"MEAS:VOLT" in data else usual(data)
    with pytest.raises(DeviceError, match=r"^supply: answered .* to 'MEAS:VOLT\?', expected '{value}'"):
        device.glance()


def test_a_reading_beyond_its_range_is_an_error(stack):
    signals = {"voltage": {"query": "MEAS:VOLT?", "unit": "V", "limits": [0.0, 4.0]}}
    device = Laboratory(stack, signals=signals).connect()
    device.measure()
    device.set(5.0)
    with pytest.raises(DeviceError, match="voltage is 5 V, outside of 0 to 4 V"):
        device.measure()


def test_signals_of_one_query_are_asked_for_once(stack):
    both = {"query": "MEAS?", "reply": "{voltage:.3f} V, {current:.3f} A"}
    signals = {"current": {**both, "unit": "A"}, "voltage": {**both, "unit": "V"}}
    lab = Laboratory(stack, signals=signals)
    device = lab.connect()
    device.set(2.0)
    lab.requests.clear()
    assert device.glance() == {"supply_current": 0.25, "supply_voltage": 2.0}
    assert lab.requests.count("MEAS?") == 1


def test_messages_keep_their_distance(stack):
    lab = Laboratory(stack, delay=0.5)
    device = lab.connect()
    before = lab.clock.now()
    for _ in range(5):
        device.glance()
    assert lab.clock.now() - before >= 10 * 0.5 - 0.5


def test_arrival_is_when_the_signal_is_there(stack):
    arrival = {"signal": "current", "tolerance": 0.1, "timeout": 5.0}
    lab = Laboratory(stack, setpoint={**SUPPLY["setpoint"], "arrival": arrival})
    device = lab.connect()
    status = device.set(3.0)
    assert not status.update()
    lab.current = 3.05
    assert status.update()
    with pytest.raises(DeviceError, match="did not arrive within 5 s"):
        device.set(4.0).wait()


def test_terminators_and_encoding_are_those_of_the_table(stack):
    lab = Laboratory(stack, write_terminator="\r", read_terminator="\r\n", encoding="latin-1", setup=["UNIT °C"])
    device = lab.connect()
    assert device.measure()["supply_voltage"] == 0.0


def test_a_sensor_has_no_set_point(stack):
    meter = {"identity": "EXAMPLE,DMM,{any}", "signals": {"current": {"query": "READ?", "unit": "A"}}}
    device = Laboratory(stack, meter, SCPISensor).connect()
    assert device.measure() == {"supply_current": pytest.approx(0.25)}
    device.safe()
    assert not hasattr(device, "set")


@cases(
    ("changes", "text"),
    [
        ({"signals": {"voltage": {"query": "V?", "unit": "V"}}}, "signals voltage in V and current in A"),
        ({"setpoint": {**SUPPLY["setpoint"], "limits": [1.0, 30.0]}}, "around 0 V"),
        ({"signals": dict(reversed(SUPPLY["signals"].items()))}, "voltage before current"),
    ],
)
def test_a_voltage_supply_is_set_in_volts(changes, text):
    with pytest.raises(ValueError, match=text):
        SCPIVoltageSupply.Settings(port="COM3", **{**SUPPLY, **changes})


@settings(max_examples=150, deadline=None)
@given(answers=st.lists(st.binary(max_size=40), max_size=6))
def test_whatever_answers_there_is_a_number_or_an_error(answers):
    with ExitStack() as stack:
        lab = Laboratory(stack)
        device = lab.connect()
        left = list(answers)
        lab.answer = lambda data, usual: (left.pop() + b"\n") if left else usual(data)
        try:
            values = device.measure()
        except DeviceError:
            return
        assert all(math.isfinite(value) for value in values.values())


@pytest.fixture
def served(stack, tcp_port):
    """Return a function that serves the supply on a TCP port; return its number and the laboratory."""

    def serve():
        lab = Laboratory(stack)
        return stack.enter_context(tcp_port(TextServer(lab.instrument))), lab

    return serve


def test_over_tcp_it_is_the_same(served):
    port, lab = served()
    settings = SCPIActuator.Settings(port=f"tcp://127.0.0.1:{port}", timeout=20.0, **SUPPLY)
    device = SCPIActuator.connect("supply", settings, lab.clock)
    device.set(4.0).wait()
    assert device.measure()["supply_voltage"] == 4.0
    device.safe()
    device.close()
    assert not lab.instrument.on


def test_a_port_where_nothing_listens_is_a_connection_error():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    settings = SCPIActuator.Settings(port=f"tcp://127.0.0.1:{port}", **SUPPLY)
    with pytest.raises(DeviceConnectionError, match=rf"supply: cannot open socket://127.0.0.1:{port}"):
        SCPIActuator.connect("supply", settings, VirtualClock())


class TestPyVISA:
    """The client of pyvisa-py, which knows nothing of the bench, at the emulated instrument."""

    def test_it_finds_an_instrument(self, served):
        pyvisa = pytest.importorskip("pyvisa")
        port, lab = served()
        manager = pyvisa.ResourceManager("@py")
        supply = manager.open_resource(
            f"TCPIP0::127.0.0.1::{port}::SOCKET", read_termination="\n", write_termination="\n", timeout=20_000
        )
        assert supply.query("*IDN?").startswith("EXAMPLE,PS-3005,")
        supply.write(":VOLT 5;OUTP ON")
        assert supply.query_ascii_values("MEAS:VOLT?") == [5.0]
        assert supply.query("OUTP?;VOLT?").startswith("1;+5.0")
        supply.write("VOLT 500")
        supply.write("NONSENSE")
        assert supply.query("SYST:ERR?") == '-222,"Data out of range"'
        assert supply.query("SYST:ERR?") == '-113,"Undefined header"'
        assert supply.query("SYST:ERR?") == '0,"No error"'
        supply.write("*RST")
        assert supply.query("OUTP?") == "0"
        supply.close()
        manager.close()
        assert lab.delivered[-1] == 0.0


class TestSilence(SilentInstrumentContract):
    @pytest.fixture
    def device(self, lab):
        return lab.connect()

    @pytest.fixture
    def set_points(self):
        return 5.0, 10.0

    @pytest.fixture
    def unplug(self, lab):
        return lab.instrument.unplug


class TestContract(ActuatorContract):
    driven = "voltage"

    @pytest.fixture
    def device(self, lab):
        return lab.connect()

    @pytest.fixture
    def clock(self, lab):
        return lab.clock

    @pytest.fixture
    def sent(self, lab):
        return lambda: len(lab.requests)

    @pytest.fixture
    def effects(self, lab):
        return lambda: lab.instrument.output


COMMA = {
    "decimal": ",",
    "signals": {
        "voltage": {"query": "MEAS:VOLT?", "unit": "V", "reply": "{value:.6f} {unit}"},
        "current": {"query": "MEAS:CURR?", "unit": "A", "reply": "I={value:.6e}{unit};{any}"},
    },
    "setpoint": {**SUPPLY["setpoint"], "reply": "{value:.4f}{unit}", "range_queries": ["VOLT? MIN", "VOLT? MAX"]},
}
"""What an instrument with a decimal comma, and units with prefixes, has instead."""


def test_numbers_and_units_are_those_of_the_instrument_both_ways(stack):
    lab = Laboratory(stack, **COMMA)
    answers = []
    lab.answer = lambda data, usual: answers.append(usual(data)) or answers[-1]
    device = lab.connect()
    device.set(0.25).wait()
    assert "VOLT 0,250" in lab.requests
    assert device.glance() == {"supply_voltage": pytest.approx(0.25), "supply_current": pytest.approx(0.25)}
    assert b"250,0000mV\n" in answers
    assert b"250,000000 mV\n" in answers
    assert b"I=2,500000e+02mA;\n" in answers


def test_a_number_that_is_not_clear_is_refused_and_names_the_key(stack):
    signals = {"voltage": {"query": "MEAS:VOLT?", "unit": "V", "reply": "{value},{any}"}}
    lab = Laboratory(stack, signals=signals)
    device = lab.connect()
    lab.answer = lambda data, usual: b"2,215E+01\n" if b"MEAS:VOLT" in data else usual(data)
    with pytest.raises(DeviceError, match=r"answered '2,215E\+01' .* set the key decimal"):
        device.glance()


# What is asked, and how often


def test_an_answer_for_the_output_that_is_neither_on_nor_off(lab):
    device = lab.connect()
    device.set(5.0)
    lab.answer = lambda data, usual: b"2\n" if data == b"OUTP?\n" else usual(data)
    with pytest.raises(DeviceError, match=r"answered '2' to 'OUTP\?', expected '1' or '0'"):
        device.glance()


@pytest.mark.parametrize(("answer", "is_on"), [(b"1", True), (b"1.0", True), (b"+1E0", True), (b"0.0", False)])
def test_an_answer_for_the_output_may_be_any_form_of_its_number(lab, answer, is_on):
    device = lab.connect()
    device.set(5.0)
    lab.answer = lambda data, usual: answer + b"\n" if data == b"OUTP?\n" else usual(data)
    if is_on:
        device.glance()
    else:
        with pytest.raises(DeviceError, match="its output is off although it was switched on"):
            device.glance()


def test_longest_time_of_the_safe_state(stack):
    device = Laboratory(stack, timeout=2.0, delay=0.5, output={"on": [], "off": ["OUTP OFF", "VOLT 0"]}).connect()
    assert device.safe_within == pytest.approx(2.0 + 4 * 0.6)


def test_a_set_point_in_another_unit_of_the_instrument(stack):
    """The instrument is set in mV, and reads back what it was set to, to a digit of its message."""
    setpoint = {"command": "VOLT {value:.0f}", "query": "VOLT?", "unit": "V", "scale": 1e-3, "limits": [0.0, 0.03]}
    lab = Laboratory(stack, setpoint={**setpoint, "resolution": 1e-4})
    device = lab.connect()
    device.set(0.0254)
    assert "VOLT 25" in lab.requests
    found = 25.11
    lab.answer = lambda data, usual: f"{found}\n".encode() if data == b"VOLT?\n" else usual(data)
    with pytest.raises(DeviceError, match=r"reads its set-point back as 0\.02511 V, not 0\.025 V"):
        device.measure()
    found = 25.09
    device.measure()


def test_an_instrument_without_a_question_for_its_set_point(stack):
    setpoint = {key: value for key, value in SUPPLY["setpoint"].items() if key != "query"}
    lab = Laboratory(stack, setpoint=setpoint)
    device = lab.connect()
    device.set(5.0)
    device.measure()
    device.reconnect()
    assert "VOLT?" not in lab.requests


@pytest.mark.parametrize(
    ("no_error", "answer", "is_error"),
    [
        ("", '0,"No error"', False),
        ("", "+0", False),
        ("", "No error", True),
        ("", '1,"x"', True),
        ("None", "None", False),
        ("None", "0", True),
        ("OK{any}", "OK 17", False),
    ],
)
def test_what_the_queue_answers_when_it_is_empty(stack, no_error, answer, is_error):
    lab = Laboratory(stack, no_error=no_error)
    empty = (no_error or "0").replace("{any}", "")
    lab.answer = lambda data, usual: f"{empty}\n".encode() if b"ERR" in data else usual(data)
    device = lab.connect()
    lab.answer = lambda data, usual: answer.encode() + b"\n" if b"ERR" in data else usual(data)
    if is_error:
        with pytest.raises(DeviceError, match="reports after measuring"):
            device.measure()
    else:
        device.measure()


def test_a_message_that_the_encoding_lacks(lab):
    device = lab.connect()
    with pytest.raises(DeviceError, match="'UNIT °C' cannot be written in ascii"):
        device._line.tell("UNIT °C")


def test_a_line_that_never_falls_silent(lab):
    device = lab.connect()
    lab.answer = lambda *_: b"nonsense\n" * 100
    with pytest.raises(DeviceConnectionError, match="the line emulated://scpi-test does not fall silent"):
        device.glance()


def test_an_instrument_without_an_identity_comes_into_step_by_silence(stack):
    lab = Laboratory(stack, identity_query="", identity="{any}")
    device = lab.connect()
    assert str(device.identity) == "unknown text instrument, serial number unknown, firmware unknown"
    answers = [b""]
    lab.answer = lambda data, usual: answers.pop(0) if answers else usual(data)
    begin = lab.clock.now()
    device.glance()
    assert "*IDN?" not in lab.requests
    assert lab.clock.now() - begin == pytest.approx(2.0, abs=0.1)
    assert device.repeats == 1


def test_questions_are_sent_three_times_at_most_and_those_to_reconnect_once(lab):
    device = lab.connect()
    lab.instrument.unplug()
    lab.requests.clear()
    with pytest.raises(DeviceConnectionError, match="after 3 requests"):
        device.glance()
    assert lab.requests.count("MEAS:VOLT?") == 1  # then the identity is asked for
    assert lab.requests.count("*IDN?") == 2
    lab.requests.clear()
    with pytest.raises(DeviceConnectionError, match="after 1 request;"):
        device.reconnect()
    assert lab.requests == ["*IDN?"]


def test_lost_while_reading(lab):
    device = lab.connect()

    def pull_out(data, usual):
        protocol_emulated.unregister("scpi-test")
        return b""

    lab.answer = pull_out
    with pytest.raises(DeviceConnectionError, match="lost the line"):
        device.glance()
    assert device._line.lost
    protocol_emulated.register("scpi-test", lab.server, lab.clock)


@cases(
    ("port", "right"),
    [
        ("tcp://host:1", True),
        ("tcp://host:65535", True),
        ("tcp://host:65536", False),
        ("tcp://host:0", False),
        ("tcp://host", False),
        ("tcp://:5025", False),
        ("tcp://host:scpi", False),
        ("/dev/ttyUSB0", True),
        ("", False),
    ],
)
def test_addresses(port, right):
    if right:
        assert SCPIActuator.Settings(port=port, **SUPPLY).port == port
    else:
        with pytest.raises(ValueError, match="port"):
            SCPIActuator.Settings(port=port, **SUPPLY)


@pytest.mark.parametrize(
    ("changes", "options"),
    [
        ({}, {"parity": "N", "stopbits": 1, "xonxoff": False, "rtscts": False, "dsrdtr": False}),
        ({"parity": "E", "flow_control": "xon-xoff"}, {"parity": "E", "xonxoff": True}),
        ({"stop_bits": 2}, {"stopbits": 2}),
        ({"flow_control": "rts-cts"}, {"rtscts": True, "xonxoff": False, "dsrdtr": False}),
        ({"flow_control": "dtr-dsr"}, {"dsrdtr": True, "rtscts": False}),
        ({"baudrate": 19200, "timeout": 0.5}, {"baudrate": 19200, "timeout": 0.5}),
    ],
)
def test_a_serial_port_is_set_up_as_the_rig_file_says(stack, changes, options):
    port = Laboratory(stack, **changes).connect()._line._transport.port
    assert {key: getattr(port, key) for key in options} == options


def test_the_safe_state_is_asked_for_once_a_line(lab):
    device = lab.connect()
    device.set(5.0)
    lab.answer = lambda data, usual: b"" if data == b"OUTP?\n" else usual(data)
    lab.requests.clear()
    with pytest.raises(DeviceError, match=r"does not confirm .*after 1 request;"):
        device.safe()
    assert lab.requests.count("OUTP?") == 2
    # While the output is on, its state is asked for three times.
    lab.answer = lambda data, usual: usual(data)
    device.set(5.0)
    lab.requests.clear()
    lab.answer = lambda data, usual: b"" if data == b"OUTP?\n" else usual(data)
    with pytest.raises(DeviceConnectionError, match="after 3 requests"):
        device.glance()
    assert lab.requests.count("OUTP?") == 3
