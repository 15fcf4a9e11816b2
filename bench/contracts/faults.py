"""What devices promise when the line or the instrument fails.

These classes need an instrument whose faults a test can switch on, an emulated one as a rule.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from bench.base import Clock, DeviceConnectionError, DeviceError, DeviceRestartedError
from bench.devices import Actuator, Device

_LONGEST_RECONNECTION = 1.0  # s, as `Device.reconnect` says
_LONGEST_SAFE = 3.0  # s, on a line that stays dead

Act = Callable[[], object]
"""What a test does to the line or the instrument, such as to cut it."""
Output = Callable[[], float]
"""Tells the true output of the instrument."""
Pair = tuple[float, float]
"""Two set-points, or the lowest and the highest."""


class SilentInstrumentContract:
    """The contract of an actuator whose instrument stops answering.

    A subclass provides the fixture `device`, `set_points` as for an `ActuatorContract`, and `unplug`, a function
    that cuts the line.
    """

    def test_silence_is_an_error_of_every_call(self, device: Actuator, set_points: Pair, unplug: Act) -> None:
        """Reading and setting raise a `DeviceConnectionError` that names the device."""
        device.set(set_points[0])
        unplug()
        for call in (device.measure, device.glance, device.read, lambda: device.set(set_points[1])):
            with pytest.raises(DeviceConnectionError, match=f"^{device.name}: "):
                call()

    def test_safe_without_an_answer_raises(self, device: Actuator, set_points: Pair, unplug: Act) -> None:
        """A safe state that could not be confirmed is not a safe state."""
        device.set(set_points[0])
        unplug()
        with pytest.raises(DeviceError, match=f"^{device.name}: "):
            device.safe()


class SpoiltAnswerContract:
    """The contract of a driver one of whose answers is lost or damaged on a line where requests are numbered.

    A subclass provides the fixture `device`, `set_points` as for an `ActuatorContract`, `spoil`, a function that
    spoils the next answer (parametrized by the ways there are), and `requests`, the list to which each request
    is added.
    """

    def test_a_spoilt_answer_is_asked_for_again(
        self, device: Actuator, set_points: Pair, spoil: Act, requests: list[bytes]
    ) -> None:
        """The same request is repeated once, and no other."""
        device.set(set_points[0]).wait()
        for call in (device.measure, lambda: device.set(set_points[1]), device.safe):
            spoil()
            requests.clear()
            call()
            assert requests[0] == requests[1]
            assert len(set(requests)) == len(requests) - 1


class RestartedInstrumentContract:
    """The contract of a device whose instrument restarts while it is in use.

    A subclass provides the fixture `device` and `restart`, a function that switches the supply of the instrument off
    and on.
    """

    @pytest.fixture
    def in_use(self, device: Device) -> Device:
        """Return the device in use, here after one reading."""
        device.glance()
        return device

    @pytest.mark.parametrize("take", ["glance", "measure", "read"])
    def test_the_next_reading_finds_the_restart(self, in_use: Device, restart: Act, take: str) -> None:
        """The next reading raises, and so does each one after it."""
        restart()
        for _ in range(3):
            with pytest.raises(DeviceRestartedError, match=f"^{in_use.name}: "):
                getattr(in_use, take)()

    def test_an_instrument_that_restarted_is_not_taken_back(self, in_use: Device, restart: Act) -> None:
        """`reconnect` does not take it for the instrument that was left."""
        restart()
        with pytest.raises(DeviceRestartedError, match=f"^{in_use.name}: "):
            in_use.reconnect()


class RestartedActuatorContract(RestartedInstrumentContract):
    """The contract of an actuator whose instrument restarts in mid-run.

    Besides what a `RestartedInstrumentContract` needs, a subclass provides `set_points` as for an
    `ActuatorContract`, and `output`, a function that tells the true output of the instrument, not what the driver
    says: 0 is off. It may override `output_limits`.
    """

    @pytest.fixture
    def output_limits(self, device: Actuator) -> Pair:
        """Return the lowest and highest output that the settings allow, here the limits of the set-point."""
        return device.limits.low, device.limits.high

    @pytest.fixture
    def in_use(self, device: Actuator, set_points: Pair) -> Actuator:
        """Return the device with its output on."""
        device.set(set_points[0]).wait()
        return device

    @pytest.mark.parametrize("read_first", [False, True], ids=["set at once", "set after a reading"])
    def test_nothing_is_set_after_a_restart(
        self,
        in_use: Actuator,
        set_points: Pair,
        restart: Act,
        output: Output,
        output_limits: Pair,
        *,
        read_first: bool,
    ) -> None:
        """`set` raises before anything is sent, as often as it is called, and `safe` still works."""
        restart()
        left = output()
        if read_first:
            with pytest.raises(DeviceRestartedError):
                in_use.glance()
        for value in (set_points[1], *set_points):
            with pytest.raises(DeviceRestartedError, match=f"^{in_use.name}: "):
                in_use.set(value)
            assert output() in (left, 0.0)
            assert output_limits[0] <= output() <= output_limits[1]
        in_use.safe()
        assert output() == 0.0
        # What made it safe does not make it usable.
        with pytest.raises(DeviceRestartedError, match=f"^{in_use.name}: "):
            in_use.set(set_points[1])

    def test_a_restart_at_rest_is_found_before_the_output_goes_on(
        self, in_use: Actuator, set_points: Pair, restart: Act, output: Output
    ) -> None:
        """An instrument that restarted with its output off is not switched on without its settings."""
        in_use.safe()
        restart()
        with pytest.raises(DeviceRestartedError, match=f"^{in_use.name}: "):
            in_use.set(set_points[1])
        assert output() == 0.0


class LineLostContract:
    """The contract of a device whose line is lost and comes back.

    A subclass provides the fixture `device`, `clock`, the functions `cut`, which breaks the line in use and lets no
    other be opened, and `mend`, which lets it; `restart` as for a `RestartedInstrumentContract`; `exchange`, a
    function that puts another instrument of the kind in the place of this one; and `truth`, a function that returns
    what a reading is to deliver, by signal name, with `tolerance`, its greatest deviation.
    """

    @pytest.fixture
    def in_use(self, device: Device) -> Device:
        """Return the device in use, here after one reading."""
        device.glance()
        return device

    def test_the_line_is_opened_again(
        self,
        in_use: Device,
        clock: Clock,
        cut: Act,
        mend: Act,
        truth: Callable[[], dict[str, float]],
        tolerance: float,
    ) -> None:
        """While the line is away an attempt fails within 1 s; after it the device goes on as it was left."""
        setpoint = in_use.setpoint if isinstance(in_use, Actuator) else 0.0
        cut()
        with pytest.raises(DeviceConnectionError, match=f"^{in_use.name}: "):
            in_use.glance()
        begin = clock.now()
        with pytest.raises(DeviceConnectionError, match=f"^{in_use.name}: "):
            in_use.reconnect()
        assert clock.now() - begin <= _LONGEST_RECONNECTION + 1e-9
        mend()
        in_use.reconnect()
        assert (in_use.setpoint if isinstance(in_use, Actuator) else 0.0) == setpoint
        for take in (in_use.glance, in_use.measure):
            values = take()
            for name, value in truth().items():
                assert values[name] == pytest.approx(value, abs=tolerance)

    def test_reconnection_without_a_loss_changes_nothing(
        self, in_use: Device, truth: Callable[[], dict[str, float]], tolerance: float
    ) -> None:
        """A line that works is replaced by another that does."""
        in_use.reconnect()
        values = in_use.glance()
        for name, value in truth().items():
            assert values[name] == pytest.approx(value, abs=tolerance)

    def test_another_instrument_is_refused(self, in_use: Device, cut: Act, mend: Act, exchange: Act) -> None:
        """Another instrument at the same address is not taken for the one that was lost, and there is no retry."""
        cut()
        exchange()
        mend()
        with pytest.raises(DeviceError, match=f"^{in_use.name}: ") as raised:
            in_use.reconnect()
        assert not isinstance(raised.value, DeviceConnectionError)

    def test_a_restart_behind_a_lost_line_is_found(self, in_use: Device, cut: Act, mend: Act, restart: Act) -> None:
        """An instrument that lost its supply with its line is not taken back, however often that is tried."""
        cut()
        restart()
        mend()
        for _ in range(2):
            with pytest.raises(DeviceRestartedError, match=f"^{in_use.name}: "):
                in_use.reconnect()


class ActuatorLineLostContract(LineLostContract):
    """The contract of an actuator whose line is lost while its output is on.

    Besides what a `LineLostContract` needs, a subclass provides `set_points` and `output` as for a
    `RestartedActuatorContract`.
    """

    @pytest.fixture
    def in_use(self, device: Actuator, set_points: Pair) -> Actuator:
        """Return the device with its output on."""
        device.set(set_points[0]).wait()
        return device

    def test_reconnection_leaves_the_output_as_it_is(
        self, in_use: Actuator, set_points: Pair, cut: Act, mend: Act, output: Output
    ) -> None:
        """Nothing moves by it, and the next set-point is taken."""
        before = output()
        cut()
        mend()
        in_use.reconnect()
        assert output() == before
        in_use.set(set_points[1]).wait()
        assert in_use.setpoint == set_points[1]


class SafeOverAFreshLineContract:
    """The contract of the safe state of an actuator whose line is gone.

    A subclass provides the fixture `device`, `clock`, `set_points`, `cut` and `mend` as for a `LineLostContract`, and
    `output` as for a `RestartedActuatorContract`.
    """

    def test_safe_opens_a_line_of_its_own(
        self, device: Actuator, set_points: Pair, cut: Act, mend: Act, output: Output
    ) -> None:
        """A line that broke and can be opened again brings the output to its safe state, at the first call."""
        device.set(set_points[1]).wait()
        assert output() != 0.0
        cut()
        mend()
        device.safe()
        assert output() == 0.0

    def test_safe_after_an_error_opens_a_line_of_its_own(
        self, device: Actuator, set_points: Pair, cut: Act, mend: Act, output: Output
    ) -> None:
        """So it does after a reading and an earlier `safe` have failed."""
        device.set(set_points[1]).wait()
        cut()
        for call in (device.glance, device.safe):
            with pytest.raises(DeviceError):
                call()
        mend()
        device.safe()
        assert output() == 0.0

    @pytest.mark.parametrize("found_before", [False, True], ids=["at once", "after an error"])
    def test_a_line_that_stays_dead_is_said_soon(
        self, device: Actuator, clock: Clock, set_points: Pair, cut: Act, *, found_before: bool
    ) -> None:
        """`safe` raises within 3 s, so that it does not hold up the safe state of others on the line."""
        device.set(set_points[1]).wait()
        cut()
        if found_before:
            with pytest.raises(DeviceError):
                device.glance()
        begin = clock.now()
        with pytest.raises(DeviceError, match=f"^{device.name}: "):
            device.safe()
        assert clock.now() - begin <= _LONGEST_SAFE


class WatchdogContract:
    """The contract of an actuator whose instrument watches its host.

    A subclass provides the fixture `device`, `clock` and `set_points`, and `output` as for a
    `RestartedActuatorContract`.
    """

    def test_silence_switches_the_output_off_at_the_declared_time(
        self, device: Actuator, clock: Clock, set_points: Pair, output: Output
    ) -> None:
        """The output is on until then and off after it, without a word of the host."""
        assert device.watchdog is not None
        device.set(set_points[1]).wait()
        device.glance()
        clock.sleep(0.95 * device.watchdog)
        assert output() != 0.0
        clock.sleep(0.1 * device.watchdog)
        assert output() == 0.0
