import math
import threading
import warnings
from contextlib import nullcontext

import pytest
from cases import cases
from hypothesis import given, strategies as st

from bench.base import DeviceError, LimitError, VirtualClock
from bench.devices import (
    Device,
    GeneralActuator,
    GeneralSensor,
    Identity,
    Limits,
    LinearStage,
    LoadCell,
    PositionSensor,
    Servo,
    Signal,
    Status,
    Switch,
    TECAmplifier,
    TemperatureSensor,
    VoltageSupply,
)
from bench.rig import Rig, load_rig

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

    @cases("end", ["arrives", "fails", "times out"])
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

    @cases(("low", "high"), [(2.0, 1.0), (math.nan, 1.0), (1.0, math.nan)])
    def test_refuses_an_empty_range(self, low, high):
        with pytest.raises(ValueError, match="expected low ≤ high"):
            Limits(low, high, "V")


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


class TestRoles:
    @cases(
        "role",
        [TECAmplifier, VoltageSupply, LoadCell, PositionSensor, TemperatureSensor, Servo, LinearStage, Switch],
    )
    def test_roles_cannot_be_made_without_their_methods(self, role):
        assert issubclass(role, Device)
        with pytest.raises(TypeError, match="abstract"):
            role("x", VirtualClock())

    @cases("role", [LoadCell, PositionSensor, Servo, VoltageSupply])
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


class Bridge(GeneralSensor):
    def measure_quantities(self):
        return {"strain": 1.5, "temperature": 22.0}

    def close(self):
        pass


class Coil(GeneralActuator):
    sent = ()
    fails = False

    def measure_quantities(self):
        return {"current": 0.0 if math.isnan(self.setpoint) else self.setpoint}

    def send(self, value):
        self.sent = (*self.sent, value)
        return Status.completed(self.name, self._clock)

    def switch_off(self):
        self.sent = (*self.sent, "off")
        if self.fails:
            raise DeviceError(self.name, "does not confirm that it is off")

    def close(self):
        pass


class TestGeneralRoles:
    identity = Identity("Acme", "X", "1", "2.0")

    def bridge(self):
        quantities = (Signal("strain", "1", "strain"), Signal("temperature", "°C", "temperature", 1))
        return Bridge("bridge", VirtualClock(), self.identity, quantities)

    def coil(self):
        quantities = (Signal("current", "A", "coil current"),)
        return Coil("coil", VirtualClock(), self.identity, quantities, Limits(-3.0, 3.0, "A"), description="current")

    def test_signals_are_named_after_the_device_and_keep_their_units(self):
        bridge = self.bridge()
        assert [(signal.name, signal.unit) for signal in bridge.signals] == [
            ("bridge_strain", "1"),
            ("bridge_temperature", "°C"),
        ]
        assert bridge.measure() == bridge.glance() == {"bridge_strain": 1.5, "bridge_temperature": 22.0}
        assert bridge.describe()["bridge_temperature"]["units"] == "°C"
        bridge.safe()

    def test_a_set_point_is_checked_sent_and_remembered(self):
        coil = self.coil()
        assert math.isnan(coil.setpoint)
        assert coil.setpoint_signal == Signal("coil_setpoint", "A", "current", 3)
        assert coil.set(2.0).success
        assert coil.setpoint == 2.0
        assert coil.measure() == {"coil_current": 2.0}
        with pytest.raises(LimitError, match=r"coil: set-point 4 A is outside of -3 to 3 A"):
            coil.set(4.0)
        assert coil.sent == (2.0,)

    @cases("fails", [False, True])
    def test_safe_forgets_the_set_point_even_if_it_cannot_be_confirmed(self, fails):
        coil = self.coil()
        coil.set(2.0)
        coil.fails = fails
        with pytest.raises(DeviceError) if fails else nullcontext():
            coil.safe()
        assert coil.sent == (2.0, "off")
        assert math.isnan(coil.setpoint)
