"""The control socket: truth, faults, lines, time; and what it refuses."""

import json
import socket
from contextlib import suppress

import pytest
from cases import cases

from bench.base import ConfigurationError, DeviceConnectionError
from bench.rig import AttachedClock, ControlClient
from sim_devices.serving.clock import LONGEST_STEP, ServedClock, make_served_clock
from sim_devices.serving.process import serve
from sim_devices.serving.requests import REQUESTS, parse_request

pytestmark = pytest.mark.usefixtures("warm_popen")

IDENTIFY = b"#0115AA?IF257D\r"
IDENTITY = b"!0115AA8065-TEC SW"
LONG = 60.0
SILENCE = 0.5
"""Wall-clock time (s) that a busy machine may take for an answer, and after which there is none."""


@pytest.fixture
def tec(vo2, opened):
    """Ask the TEC controller for its identity; an answer that does not begin within `patience` (s) is empty."""
    line = opened(vo2.port("tec"))

    def ask(patience=LONG):
        line.reset_input_buffer()
        line.write(IDENTIFY)
        line.timeout = patience
        begin = line.read(1)
        line.timeout = 0.5
        return begin and begin + line.read_until(b"\r")

    yield ask
    vo2.control.plug_in("tec")


def answered(ask):
    """Whether an answer comes; a busy machine may need several questions."""
    return any(ask(1.0).startswith(IDENTITY) for _ in range(60))


def test_the_true_state_has_units(vo2):
    values = vo2.control.request("state")["values"]
    assert values["plate_temperature"]["unit"] == "°C"
    assert 15.0 < values["plate_temperature"]["value"] < 100.0
    assert {each["unit"] for each in values.values()} == {"°C", "1/m", "m", "A", "V", ""}


def test_a_weight_is_hung_and_a_forgotten_one_is_not():
    with serve("sma") as rig:
        rig.control.operate("load", 4.9)
        rig.control.advance(1.0)
        assert rig.control.state()["force"] == pytest.approx(4.9, rel=1e-4)
        rig.control.fault("heavy-load", factor=1.5)
        rig.control.operate("load", 4.0)
        rig.control.advance(1.0)
        assert rig.control.state()["force"] == pytest.approx(6.0, rel=1e-4)
        rig.control.fault("forgotten-load")
        rig.control.operate("load", 1.0)
        rig.control.advance(1.0)
        assert rig.control.state()["force"] == pytest.approx(6.0, rel=1e-4)
        rig.control.operate("stage", 0.0)


def test_time_is_advanced_on_a_scaled_clock_and_passes_by_itself(vo2):
    begun = vo2.control.time()
    vo2.control.advance(30.0)
    assert vo2.control.time() >= begun + 30.0
    until = vo2.control.time() + 0.3
    assert vo2.control.wait(until) >= until


def test_a_cut_resets_connections_and_turns_new_ones_away(vo2, connect):
    connection = connect(vo2.port("psd"))
    vo2.control.fault("psd.cut")
    connection.sendall(bytes.fromhex("000100000006 01 03 ea60 0002"))
    received = b""
    try:
        while piece := connection.recv(100):
            received += piece
    except ConnectionError:
        pass
    assert len(received) < 13
    with suppress(ConnectionError):
        assert connect(vo2.port("psd")).recv(1) == b""
    vo2.control.plug_in("psd")
    again = connect(vo2.port("psd"))
    again.sendall(bytes.fromhex("000100000006 01 03 ea60 0002"))
    assert len(again.recv(100)) > 0


def test_an_answer_is_delayed_doubled_and_readdressed_on_a_served_line(vo2, tec, opened):
    right = tec()
    line = opened(vo2.port("tec"), timeout=60.0)
    vo2.control.fault("tec.delay", seconds=1.5)
    begun = vo2.control.time()
    line.write(IDENTIFY)
    assert line.read_until(b"\r") == right
    assert vo2.control.time() >= begun + 1.5
    vo2.control.fault("tec.double")
    line.write(IDENTIFY)
    assert line.read(2 * len(right)) == 2 * right
    vo2.control.fault("tec.readdress")
    line.write(IDENTIFY)
    assert line.read_until(b"\r")[1:3] == b"02"
    last = vo2.control.events()[-6:]
    assert [(each["fault"], each["what"]) for each in last] == [
        (f"tec.{kind}", what) for kind in ("delay", "double", "readdress") for what in ("begins", "ends")
    ]


def test_a_fault_ends_after_its_duration_or_when_it_is_ended(vo2, tec):
    assert answered(tec)
    vo2.control.fault("tec.unplug", duration=0.5)
    assert answered(tec)
    vo2.control.fault("tec.unplug")
    assert tec(SILENCE) == b""
    vo2.control.end_fault("tec.unplug")
    assert answered(tec)
    with pytest.raises(ConfigurationError, match="takes no duration"):
        vo2.control.fault("tec-over-current", duration=1.0)
    with pytest.raises(ConfigurationError, match="allowed are 0 to 3600 s"):
        vo2.control.fault("tec.delay", seconds=-1.0)


def test_a_cut_line_on_raw_tcp_is_reset_and_taken_again_when_it_is_back(emulate, opened, connect):
    with emulate("vo2", "--tcp") as (_, endpoints), ControlClient(endpoints["control"]) as control:
        address = endpoints["instruments"]["tec"]["port"]
        connection = connect(address)
        control.fault("tec.cut")
        connection.sendall(IDENTIFY)
        with suppress(ConnectionError):
            while connection.recv(100):
                pass
        with suppress(ConnectionError):
            assert connect(address).recv(1) == b""
        control.plug_in("tec")
        line = opened(address)
        line.write(IDENTIFY)
        assert line.read_until(b"\r").startswith(IDENTITY)


def test_a_restarted_supply_says_so(sma, opened):
    line = opened(sma.port("supply"))
    line.write(b"\rC\rS4\rO\r")
    assert line.read_until(b"t701105\r").endswith(b"t701105\r")
    sma.control.fault("supply.power-cycle")
    assert line.read_until(b"t701100\r").endswith(b"t701100\r")
    line.write(b"C\r")


@cases(
    ("line", "words"),
    [
        (b"garbage", "not a line of JSON"),
        (b"\xff\xfe", "not a line of JSON"),
        (b'{"do":' * 100_000, "not a line of JSON"),
        (b"[1]", "expected an object"),
        (b'{"do": 3}', "expected an object"),
        (b'{"do": "explode"}', "there is no request 'explode'; there are: help, state,"),
        (b'{"do": "state", "instrument": "tec"}', "state: instrument: there is no such key; there are: rig"),
        (b'{"do": "advance"}', "advance: seconds: is missing (laboratory time that passes, s)"),
        (b'{"do": "advance", "seconds": -1}', "advance: seconds = -1"),
        (b'{"do": "advance", "seconds": "3"}', "advance: seconds = '3'"),
        (b'{"do": "advance", "seconds": true}', "advance: seconds = True"),
        (b'{"do": "wait", "until": NaN}', "wait: until = nan"),
        (b'{"do": "fault", "fault": "x", "values": {"a": "b"}}', "fault: values.a = 'b'"),
        (b"[" * 30_000, "not a line of JSON"),
    ],
)
def test_a_wrong_request_is_one_message(line, words):
    with pytest.raises(ConfigurationError) as caught:
        parse_request(line)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"do": "fault", "fault": "flood"}, "no fault 'flood'; it has: tec-over-current,"),
        ({"do": "fault", "fault": "displaced-spot", "values": {"volts": 1}}, "no value 'volts'; it takes: metres"),
        ({"do": "plug-in", "instrument": "x"}, "rig vo2 has no instrument 'x'; it has: psd, tec"),
        ({"do": "operate", "task": "load", "value": 1}, "cannot carry out 'load'"),
        ({"do": "state", "rig": "sma"}, "rig 'sma' is not served; there are: vo2"),
    ],
)
def test_what_the_laboratory_does_not_have_is_one_message(vo2, request_, words):
    request_ = dict(request_)
    with pytest.raises(ConfigurationError) as caught:
        vo2.control.request(request_.pop("do"), **request_)
    assert words in str(caught.value)


def test_help_names_everything(vo2):
    found = vo2.control.request("help")
    assert set(found["requests"]) == set(REQUESTS)
    assert all(each["does"] for each in found["requests"].values())
    assert found["rigs"]["vo2"]["instruments"] == ["psd", "tec"]
    metres = found["rigs"]["vo2"]["faults"]["displaced-spot"]["values"]["metres"]
    assert (metres["default"], metres["unit"]) == (20e-6, "m")
    assert metres["low"] < 0.0 < metres["high"]


def test_control_clients_do_not_disturb_each_other(vo2):
    host, port = control_address(vo2)
    with (
        socket.create_connection((host, port), timeout=60) as endless,
        socket.create_connection((host, port)) as late,
    ):
        endless.sendall(b"x" * 200_000)
        late.settimeout(60)
        late.sendall(b'{"do": "wait", "until": 1e9}\n{"do": "time"}\n')
        assert b"too long" in endless.recv(1000)
        assert vo2.control.time() > 0
        late.settimeout(2.0)
        # One that waits is not read without bound.
        with pytest.raises(TimeoutError):
            late.sendall(3_000_000 * b'{"do": "time"}\n')
        late.settimeout(0.3)
        with pytest.raises(TimeoutError):
            late.recv(1)


def control_address(rig):
    address = json.loads(rig.endpoints_file.read_text())["control"]
    host, port = address.removeprefix("tcp://").rsplit(":", 1)
    return host, int(port)


def test_the_server_ends_with_the_connection_that_asked_for_it(emulate):
    with emulate("vo2") as (process, endpoints):
        control = ControlClient(endpoints["control"])
        control.request("end-with-connection")
        control.close()
        assert process.wait(60) == 0
        with pytest.raises(DeviceConnectionError):
            ControlClient(endpoints["control"])


def test_the_wall_clock_is_not_advanced(emulate):
    with emulate("vo2") as (process, endpoints):
        control = ControlClient(endpoints["control"])
        with pytest.raises(ConfigurationError, match="serve with --clock x1"):
            control.advance(1.0)
        control.request("stop")
        assert process.wait(60) == 0
        control.close()


class CountingClient:
    """A control connection to a clock that stands where it was waited for; counts what it is asked."""

    def __init__(self):
        self.at, self.asked = 5.0, []

    def request(self, do, **_keys):
        self.asked.append(do)
        return {"time": self.at, "factor": 1.0, "epoch": "2026-01-01T00:00:00+00:00"}

    def time(self):
        return self.request("time")["time"]

    def wait(self, until):
        self.at = max(self.at, until)
        return self.request("wait")["time"]


def test_an_instant_that_has_passed_is_not_asked_for():
    client = CountingClient()
    clock = AttachedClock(lambda: client, "vo2")
    clock.sleep_until(4.0)
    assert client.asked == ["time"]
    clock.sleep_until(5.05)
    assert client.asked == ["time", "wait"]
    assert clock.now() == 5.05
    with pytest.raises(ValueError, match="instant: expected a finite number, got inf"):
        clock.sleep_until(float("inf"))


def test_a_stalled_server_loses_time_and_says_so():
    clock = ServedClock(1e9)
    clock.start()
    clock.follow()
    clock.follow()
    assert clock.now() <= 2 * LONGEST_STEP
    assert clock.factor_reached < 1e9


def test_what_takes_an_instrument_time_is_ahead_of_the_wall_clock():
    clock = ServedClock(1e-9)
    clock.start()
    clock.sleep(3.0)
    clock.follow()
    assert clock.is_ahead
    assert clock.now() == 3.0
    clock.skip(5.0)
    assert not clock.is_ahead
    assert clock.now() >= 5.0


@cases("name", ["virtual", "x", "x0", "x-1", "xinf", "xnan", "20", ""])
def test_a_clock_that_cannot_serve_is_refused(name):
    with pytest.raises(ValueError, match="wall, or xN"):
        make_served_clock(name)
