import math
import threading
import warnings

import pytest
from heater_laboratory import HeaterTEC, NoSettings, Thermometer
from hypothesis import given
from hypothesis import strategies as st

from bench.clock import VirtualClock
from bench.devices import (
    ROLES,
    Device,
    Identity,
    Limits,
    LoadCell,
    PositionSensor,
    Servo,
    Signal,
    Status,
    VoltageSupply,
    role_of,
)
from bench.errors import DeviceError, LimitError
from bench.rig import Rig
from bench.rig_file import load_rig

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", category=DeprecationWarning, module="(bluesky|event_model|toolz|historydict).*")
    bluesky_protocols = pytest.importorskip("bluesky.protocols")


@pytest.fixture
def rig(rig_file):
    with Rig(load_rig(rig_file()), VirtualClock(), seed=1) as rig:
        yield rig


class TestStatus:
    def test_completes_when_the_device_has_arrived(self):
        clock = VirtualClock()
        status = Status("tec", clock, lambda: clock.now() >= 2.0, interval=0.5)
        assert not status.done
        assert not status.success
        assert not status.update()
        status.wait()
        assert clock.now() == 2.0
        assert status.done
        assert status.success
        assert status.exception() is None

    def test_asks_no_more_once_it_is_done(self):
        asked = []
        status = Status("tec", VirtualClock(), lambda: asked.append(1) or True)
        for _ in range(3):
            assert status.update()
        status.wait()
        assert len(asked) == 1

    def test_completed_is_complete_at_once(self):
        clock = VirtualClock()
        status = Status.completed("tec", clock)
        assert status.done
        assert status.success
        status.wait()
        assert clock.now() == 0.0

    def test_a_fault_of_the_device_fails_it(self):
        def arrived():
            raise DeviceError("tec", "sensor open")

        status = Status("tec", VirtualClock(), arrived)
        with pytest.raises(DeviceError, match="tec: sensor open"):
            status.wait()
        assert status.done
        assert not status.success
        assert isinstance(status.exception(), DeviceError)

    def test_timeout_passes_on_the_clock(self):
        clock = VirtualClock()
        status = Status("tec", clock, lambda: False, timeout=30.0, interval=1.0)
        with pytest.raises(DeviceError, match="did not arrive within 30 s"):
            status.wait()
        assert clock.now() == 30.0

    def test_arriving_at_the_very_deadline_counts(self):
        clock = VirtualClock()
        status = Status("tec", clock, lambda: clock.now() >= 30.0, timeout=30.0, interval=30.0)
        status.wait()
        assert status.success

    def test_callback_after_completion_comes_at_once(self):
        status = Status.completed("tec", VirtualClock())
        came = []
        status.add_callback(came.append)
        assert came == [status]

    def test_callbacks_before_completion_come_once_each(self):
        clock = VirtualClock()
        came, both = [], threading.Event()

        def second(status):
            came.append(("second", status.success))
            both.set()

        status = Status("tec", clock, lambda: clock.now() >= 5.0)
        status.add_callback(lambda status: came.append(("first", status.success)))
        status.add_callback(second)
        assert both.wait(60.0)
        status.update()
        assert came == [("first", True), ("second", True)]

    @pytest.mark.parametrize("end", ["arrives", "fails", "times out"])
    def test_the_watcher_ends(self, end):
        clock = VirtualClock()

        def arrived():
            if end == "fails" and clock.now() > 1.0:
                raise DeviceError("watched-device", "sensor open")
            return end == "arrives" and clock.now() > 1.0

        ended = threading.Event()
        status = Status("watched-device", clock, arrived, timeout=3.0)
        status.add_callback(lambda _: ended.set())
        watchers = [thread for thread in threading.enumerate() if thread.name == "watched-device"]
        assert ended.wait(60.0)
        for thread in watchers:
            thread.join(60.0)
            assert not thread.is_alive()
        assert status.success == (end == "arrives")

    def test_a_defect_of_the_driver_fails_it_too(self):
        # Otherwise whoever waits by callback waits for ever.
        ended = threading.Event()
        status = Status("tec", VirtualClock(), lambda: 1 / 0)
        status.add_callback(lambda _: ended.set())
        assert ended.wait(60.0)
        assert isinstance(status.exception(), ZeroDivisionError)
        with pytest.raises(ZeroDivisionError):
            status.wait()

    def test_a_callback_that_raises_does_not_undo_the_success_nor_keep_others_from_being_told(self):
        clock = VirtualClock()
        status = Status("tec", clock, lambda: clock.now() >= 1.0, interval=0.25)
        status._watcher = threading.current_thread()  # this thread asks, so that the order is known
        came = []

        def raising(_):
            raise DeviceError("tec", "from a callback")

        status.add_callback(raising)
        status.add_callback(came.append)
        with pytest.raises(DeviceError, match="from a callback"):
            status.wait()
        assert came == [status]
        assert status.success
        assert status.exception() is None

    def test_conforms_to_bluesky(self):
        assert isinstance(Status.completed("tec", VirtualClock()), bluesky_protocols.Status)


class TestLimits:
    @given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9), st.floats(allow_nan=True))
    def test_contains_its_ends_and_what_lies_between(self, a, b, value):
        limits = Limits(min(a, b), max(a, b), "°C")
        assert a in limits
        assert b in limits
        assert (value in limits) == (min(a, b) <= value <= max(a, b))

    @pytest.mark.parametrize(("low", "high"), [(2.0, 1.0), (math.nan, 1.0), (1.0, math.nan)])
    def test_refuses_an_empty_range(self, low, high):
        with pytest.raises(ValueError, match="expected low ≤ high"):
            Limits(low, high, "V")

    def test_says_its_unit(self):
        assert str(Limits(-10.0, 95.0, "°C")) == "-10 to 95 °C"


class TestSetpoints:
    @pytest.mark.parametrize("value", [9.999, 95.001, math.nan, math.inf, -math.inf])
    def test_outside_of_the_limits_nothing_is_sent(self, rig, value):
        tec = rig.devices["tec"]
        with pytest.raises(LimitError) as caught:
            tec.set(value)
        assert "tec: set-point" in str(caught.value)
        assert "10 to 95 °C" in str(caught.value)
        assert caught.value.device == "tec"
        assert tec.calls == []
        assert math.isnan(tec.setpoint)

    @pytest.mark.parametrize("value", [10.0, 95.0])
    def test_the_ends_are_allowed(self, rig, value):
        rig.devices["tec"].set(value)
        assert rig.devices["tec"].sent == [value]


class TestRoles:
    def test_by_class(self):
        assert role_of(HeaterTEC) == "TEC amplifier"
        assert role_of(Thermometer) == "temperature sensor"
        assert set(ROLES) >= {"TEC amplifier", "voltage supply", "load cell", "position sensor", "servo"}

    def test_none(self):
        with pytest.raises(TypeError, match="NoSettings plays none of the roles TEC amplifier"):
            role_of(NoSettings)

    @pytest.mark.parametrize("role", list(ROLES.values()), ids=list(ROLES))
    def test_roles_cannot_be_made_without_their_methods(self, role):
        assert issubclass(role, Device)
        with pytest.raises(TypeError, match="abstract"):
            role("x", VirtualClock())

    @pytest.mark.parametrize("role", [LoadCell, PositionSensor, Servo, VoltageSupply])
    def test_signals_are_named_after_the_device(self, role):
        class Minimal(role):
            output = "dc"

        Minimal.__abstractmethods__ = frozenset()
        device = Minimal("left", VirtualClock())
        names = [signal.name for signal in device.signals]
        assert len(set(names)) == len(names) > 0
        assert all(name.startswith("left_") for name in names)
        assert all(signal.unit for signal in device.signals)
        if hasattr(device, "setpoint_signal"):
            assert device.setpoint_signal.name == "left_setpoint"


class TestBlueskyByStructure:
    def test_every_device_conforms(self, rig):
        for device in rig.devices.values():
            for protocol in ("Readable", "Stoppable", "HasName", "HasParent"):
                assert isinstance(device, getattr(bluesky_protocols, protocol)), protocol
            assert device.parent is None
        assert isinstance(rig.devices["tec"], bluesky_protocols.Movable)
        assert not isinstance(rig.devices["probe"], bluesky_protocols.Movable)

    def test_read_and_describe_agree(self, rig):
        rig.clock.sleep(3.0)
        for device in rig.devices.values():
            reading, description = device.read(), device.describe()
            assert list(reading) == list(description) == [signal.name for signal in device.signals]
            for signal in device.signals:
                key = description[signal.name]
                assert key["units"] == signal.unit
                assert key["dtype"] == "number"
                assert key["shape"] == []
                assert device.identity.serial_number in key["source"]
                assert reading[signal.name]["timestamp"] == rig.clock.epoch.timestamp() + 3.0


def test_identity_on_one_line():
    identity = Identity("Meerstetter", "TEC-1091", "42", "5.10")
    assert str(identity) == "Meerstetter TEC-1091, serial number 42, firmware 5.10"


def test_signal_shows_three_digits_unless_told():
    assert Signal("a", "m", "position").precision == 3
