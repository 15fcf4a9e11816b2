"""The driver of a twin's devices, against a scripted device at the other end of its line."""

import math

import pytest

from bench.base import DeviceConnectionError, DeviceError, LimitError
from drivers.twin import TwinActuator, TwinSensor
from sim_devices.protocol_emulated import unregister
from sim_devices.wire import WireServer

PORT = "emulated://scripted-twin"
SIGNALS = ({"name": "stage", "unit": "mm"}, {"name": "force", "unit": "N"})
SETPOINT = {"name": "stage_setpoint", "unit": "mm", "limits": (-1.0, 2.0), "tolerance": 0.25}


class Script(WireServer):
    """A device of a few lines: answers by request, what it received, and answers that are lost."""

    def __init__(self):
        self.answers = {
            "identity?": "bench,twin,stage,emulated",
            "measure?": "1.5 -0.25",
            "glance?": "1.25 -0.5",
            "off": "done",
            "output?": "nan",
        }
        self.received = []
        self.lost = 0
        self.end = b"\n"

    def receive(self, data):
        request = data.decode().removesuffix("\n")
        self.received.append(request)
        if self.lost:
            self.lost -= 1
            return b""
        word = request.partition(" ")[0]
        return self.answers.get(request, "done" if word == "set" else "refused").encode() + self.end


def make_settings(**changes):
    return TwinActuator.Settings(**{"port": PORT, "signals": SIGNALS, "setpoint": SETPOINT} | changes)


@pytest.fixture
def connect(script, clock):
    devices = []

    def connect(kind=TwinActuator, **changes):
        devices.append(kind.connect("stage", make_settings(**changes), clock))
        script.received.clear()
        return devices[-1]

    yield connect
    for device in devices:
        device.close()


def test_readings(script, connect):
    sensor = connect(TwinSensor, setpoint=None)
    assert str(sensor.identity) == "bench twin, serial number stage, firmware emulated"
    assert sensor.measure() == {"stage": 1.5, "force": -0.25}
    assert sensor.glance() == {"stage": 1.25, "force": -0.5}
    sensor.safe()
    assert script.received == ["measure?", "glance?"]
    assert [(signal.name, signal.unit) for signal in sensor.signals] == [("stage", "mm"), ("force", "N")]


def test_readings_take_the_time_of_the_rig(script, connect, clock):
    device = connect(reading_time=0.5, quick_time=0.25, setpoint_time=1.0)
    for action, seconds in ((device.measure, 0.5), (device.glance, 0.25), (lambda: device.set(1.0), 1.0)):
        begin = clock.now()
        action()
        assert clock.now() - begin == pytest.approx(seconds, abs=1e-3)
    begin = clock.now()
    connect().measure()
    assert clock.now() - begin < 1e-3


@pytest.mark.parametrize("answer", ["1.5", "1.5 2.5 3.5", "1.5 none", ""])
def test_readings_that_are_none(script, connect, answer):
    script.answers["measure?"] = answer
    with pytest.raises(DeviceError, match=f"answered '{answer}' to 'measure\\?', expected 2 numbers"):
        connect().measure()


def test_set_points(script, connect):
    device = connect()
    assert math.isnan(device.setpoint)
    assert str(device.limits) == "-1 to 2 mm"
    assert device.setpoint_signal.name == "stage_setpoint"
    status = device.set(1.5)
    assert script.received == ["set   +1.5000000000000000e+00"]
    assert device.setpoint == 1.5
    # At exactly the tolerance it has arrived, by a quick reading.
    script.answers["glance?"] = "1.24 0"
    assert not status.update()
    script.answers["glance?"] = "1.25 0"
    assert status.update()
    script.answers["glance?"] = "9 0"
    assert not device.set(1.0).update()


def test_set_points_that_arrive_at_once(script, connect):
    assert connect(setpoint={**SETPOINT, "tolerance": 0.0}).set(1.0).done
    script.answers["measure?"] = script.answers["glance?"] = ""
    assert connect(signals=()).set(1.0).done


def test_time_that_an_arrival_is_given(script, connect, clock):
    status = connect().set(2.0)
    begin = clock.now()
    with pytest.raises(DeviceError, match="did not arrive within 600 s"):
        status.wait()
    assert clock.now() - begin == pytest.approx(600.0, abs=1.0)


def test_set_points_that_are_not_taken(script, connect):
    device = connect()
    for beyond in (-1.1, 2.1, math.nan):
        with pytest.raises(LimitError):
            device.set(beyond)
    assert script.received == []
    script.answers["set   +1.0000000000000000e+00"] = "refused"
    with pytest.raises(DeviceError, match="answered 'refused' to a set-point of 1 mm"):
        device.set(1.0)
    assert math.isnan(device.setpoint)


def test_safe_state_is_confirmed(script, connect):
    device = connect()
    device.set(1.0)
    script.received.clear()
    device.safe()
    assert script.received == ["off", "output?"]
    assert math.isnan(device.setpoint)
    script.answers["output?"] = "1.0"
    with pytest.raises(DeviceError, match="does not confirm that its output is off"):
        device.safe()


def test_actuator_without_a_set_point(script, connect):
    with pytest.raises(DeviceError, match="has no set-point; expected a table setpoint, or the driver twin-sensor"):
        connect(setpoint=None)


def test_requests_are_sent_three_times_at_most(script, connect):
    device = connect()
    script.lost = 2
    assert device.measure() == {"stage": 1.5, "force": -0.25}
    assert len(script.received) == 3
    script.lost = 3
    script.received.clear()
    with pytest.raises(DeviceConnectionError, match=rf"no answer to 'measure\?' at {PORT}"):
        device.measure()
    assert len(script.received) == 3
    script.end = b""
    with pytest.raises(DeviceConnectionError, match="no answer"):
        device.measure()


def test_what_came_before_a_request_is_forgotten(script, connect):
    device = connect()
    device._line._port._received += b"9 9\n"
    assert device.measure() == {"stage": 1.5, "force": -0.25}


def test_line_that_is_lost_or_closed(script, connect):
    device = connect()
    unregister("scripted-twin")
    with pytest.raises(DeviceConnectionError, match="lost the line emulated://scripted-twin"):
        device.measure()
    device.close()
    assert not device._line._port.is_open
