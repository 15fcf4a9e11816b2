"""What every device and every actuator promises; see `bench.devices`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar

import pytest

from bench.base import Clock, LimitError
from bench.devices import Actuator, Device


def _values(device: Device, values: dict[str, float]) -> dict[str, float]:
    """Return measured values after a check that each signal has one and that each is a number."""
    assert list(values) == [signal.name for signal in device.signals]
    invalid = {name: value for name, value in values.items() if not math.isfinite(value)}
    assert not invalid, f"{device.name} delivers values that are not numbers, instead of raising DeviceError"
    return values


class DeviceContract:
    """The contract of every device.

    A subclass provides two fixtures: `device`, the connected device before anything was asked of it, and `clock`,
    the clock that it was connected with.

    Attributes
    ----------
    role : type
        What the device has to be an instance of.
    quantities : tuple of (str, str), optional
        Name, without the device's, and unit of each signal that the role prescribes.
    """

    role: ClassVar[type] = Device
    quantities: ClassVar[tuple[tuple[str, str], ...] | None] = None

    @pytest.fixture
    def effects(self) -> Callable[[], object]:
        """Return a function that tells what the instrument has done to the plant so far, at first nothing."""
        return lambda: None

    @pytest.fixture
    def identity(self, device: Device) -> str:
        """Return the identity that is expected, in one line."""
        return str(device.identity)

    def test_role_and_identity(self, device: Device, identity: str) -> None:
        """It plays its role and has a name, and its identity has no empty part."""
        assert isinstance(device, self.role)
        assert device.name
        assert device.parent is None
        for part in ("maker", "model", "serial_number", "firmware"):
            assert getattr(device.identity, part).strip(), f"identity without {part}"
        assert str(device.identity) == identity
        assert len(identity.splitlines()) == 1

    def test_signals_have_names_units_and_descriptions(self, device: Device) -> None:
        """Each signal is named after the device, has a unit and a description, and stands once."""
        names = [signal.name for signal in device.signals]
        assert names
        assert len(set(names)) == len(names)
        for signal in device.signals:
            assert signal.name.startswith(f"{device.name}_")
            assert signal.unit.strip(), f"{signal.name} has no unit; a plain number has the unit 1"
            assert signal.description.strip()
            assert signal.precision >= 0
        if self.quantities is not None:
            expected = [(f"{device.name}_{quantity}", unit) for quantity, unit in self.quantities]
            assert [(signal.name, signal.unit) for signal in device.signals] == expected

    def test_readings_are_within_their_limits(self, device: Device) -> None:
        """`reading_limits` are of its own signals and in their units, and what it measures is within them."""
        units = {signal.name: signal.unit for signal in device.signals}
        values = device.measure()
        for name, limits in device.reading_limits.items():
            assert limits.unit == units[name]
            assert values[name] in limits

    def test_measures_every_signal(self, device: Device) -> None:
        """`measure` and `glance` deliver a finite number for each signal in their order, in a new table each time."""
        for take in (device.measure, device.glance):
            first, second = take(), take()
            _values(device, first)
            _values(device, second)
            assert first is not second, f"{take.__name__} returns the same table again"

    def test_read_and_describe_conform_to_bluesky(self, device: Device, clock: Clock) -> None:
        """`read` and `describe` have the keys of bluesky for each signal; a time stamp is that of the reading."""
        keys = device.describe()
        assert list(keys) == [signal.name for signal in device.signals]
        for signal in device.signals:
            key = keys[signal.name]
            assert key["source"] == f"{device.identity.model}:{device.identity.serial_number}:{signal.name}"
            assert (key["units"], key["precision"]) == (signal.unit, signal.precision)
            assert (key["dtype"], key["shape"]) == ("number", [])
        assert device.hints == {"fields": [device.signals[0].name]}
        for _ in range(2):
            before = clock.timestamp()
            readings = device.read()
            _values(device, {name: reading["value"] for name, reading in readings.items()})
            for name, reading in readings.items():
                assert before <= reading["timestamp"] <= clock.timestamp(), f"{name} has a stale time stamp"
            clock.sleep(0.5)

    def test_bluesky_finds_its_protocols(self, device: Device) -> None:
        """A bluesky RunEngine accepts it."""
        protocols = pytest.importorskip("bluesky.protocols")
        assert isinstance(device, protocols.Readable)
        assert isinstance(device, protocols.Stoppable)

    def test_safe_and_stop_again_change_nothing(self, device: Device, effects: Callable[[], object]) -> None:
        """`safe` and `stop` succeed in any order and number, and leave a device that measures."""
        device.safe()
        before = effects()
        device.stop()
        device.stop(success=False)
        device.safe()
        assert effects() == before
        _values(device, device.measure())


class ActuatorContract(DeviceContract):
    """The contract of every actuator.

    Attributes
    ----------
    beyond : float
        How far beyond its limits the actuator is asked to go, as a share of their range.
    driven : str, optional
        The quantity that follows the set-point, without the device's name, where the role says so.
    """

    role: ClassVar[type] = Actuator
    beyond: ClassVar[float] = 1e-3
    driven: ClassVar[str | None] = None

    @pytest.fixture
    def sent(self) -> Callable[[], object]:
        """Return a function that tells what was sent to the instrument so far."""
        return lambda: None

    @pytest.fixture
    def set_points(self, device: Actuator, request: pytest.FixtureRequest) -> tuple[float, float]:
        """Return two set-points at which the actuator arrives.

        They are those of the option `--set-points`, or a quarter and three quarters of the range.
        """
        if given := request.config.getoption("set_points", None):
            return given[0], given[1]
        low, high = device.limits.low, device.limits.high
        return low + 0.25 * (high - low), low + 0.75 * (high - low)

    @pytest.fixture
    def ends(self, device: Actuator, request: pytest.FixtureRequest) -> tuple[float, float]:
        """Return the lowest and the highest set-point that may be sent.

        They are those of the option `--set-points`, or the limits.
        """
        given = request.config.getoption("set_points", None)
        return (min(given), max(given)) if given else (device.limits.low, device.limits.high)

    @pytest.fixture
    def forbidden(self, device: Actuator) -> tuple[float, ...]:
        """Return set-points that have to be refused."""
        low, high = device.limits.low, device.limits.high
        margin = self.beyond * (high - low)
        return math.nan, low - margin, high + margin, -math.inf, math.inf

    @pytest.fixture
    def allowed(self, device: Actuator) -> str:
        """Return how a message names the range that is allowed; the limits."""
        return str(device.limits)

    @pytest.fixture
    def tolerance(self, device: Actuator) -> float:
        """Return how close a reading comes to its set-point; a hundredth of the range."""
        return 0.01 * (device.limits.high - device.limits.low)

    def quantity(self, device: Actuator) -> str | None:  # noqa: ARG002 - of a TEC amplifier its mode decides
        """Return the quantity that follows the set-point now."""
        return self.driven

    def test_set_point_has_a_unit_and_limits(self, device: Actuator) -> None:
        """The set-point is nan before the first; its signal, and the limits, are in the same unit."""
        assert math.isnan(device.setpoint)
        assert device.setpoint_signal.name == f"{device.name}_setpoint"
        assert device.setpoint_signal.unit.strip()
        assert device.limits.low < device.limits.high
        assert device.limits.unit == device.setpoint_signal.unit

    def test_nothing_is_driven_before_the_first_set_point(
        self, device: Actuator, clock: Clock, effects: Callable[[], object]
    ) -> None:
        """Connecting, waiting, measuring and `stop` drive nothing."""
        clock.sleep(0.5)
        device.measure()
        device.stop()
        assert not effects()
        assert math.isnan(device.setpoint)

    def test_beyond_the_limits_nothing_is_sent(
        self,
        device: Actuator,
        forbidden: tuple[float, ...],
        allowed: str,
        effects: Callable[[], object],
        sent: Callable[[], object],
    ) -> None:
        """`check` and `set` refuse what is outside of the limits or no number; nothing is sent or changed."""
        before = sent(), effects()
        for value in forbidden:
            for call in (device.check, device.set):
                said = f"{call.__name__}({value:g}) raised no LimitError; the limits are {device.limits}"
                try:
                    call(value)
                except LimitError as error:
                    said = str(error)
                assert said.startswith(f"{device.name}: set-point "), said
                assert allowed in said
            assert (sent(), effects()) == before
            assert math.isnan(device.setpoint)

    def test_limits_themselves_are_allowed(self, device: Actuator, ends: tuple[float, float]) -> None:
        """`check` and `set` accept both limits."""
        for value in (device.limits.low, device.limits.high):
            device.check(value)
        for value in ends:
            device.set(value)
            assert device.setpoint == value
            device.stop()

    def test_arrives_at_its_set_points(
        self, device: Actuator, clock: Clock, set_points: tuple[float, float], tolerance: float
    ) -> None:
        """A status completes when the device has arrived, and the readings change with the set-point."""
        found = []
        for value in set_points:
            status = device.set(value)
            assert device.setpoint == value
            status.wait()
            ended: list[object] = []
            status.add_callback(ended.append)
            assert ended == [status]
            assert status.done
            assert status.success
            assert status.exception() is None
            clock.sleep(0.05)
            found.append(_values(device, device.measure()))
        assert found[0] != found[1], f"the readings of {device.name} are the same at {set_points}: they are stale"
        if (quantity := self.quantity(device)) is not None:
            for value, values in zip(set_points, found, strict=True):
                assert values[f"{device.name}_{quantity}"] == pytest.approx(value, abs=tolerance)

    def test_safe_after_a_set_point_and_again_changes_nothing(
        self, device: Actuator, clock: Clock, set_points: tuple[float, float], effects: Callable[[], object]
    ) -> None:
        """`safe` succeeds from a set-point, again without effect, and the device can be used afterwards."""
        device.set(set_points[0])
        clock.sleep(0.1)
        device.safe()
        before = effects()
        device.safe()
        device.stop()
        clock.sleep(0.5)
        assert effects() == before
        _values(device, device.measure())
        device.set(set_points[1]).wait()
        assert device.setpoint == set_points[1]

    def test_stop_holds_what_the_limits_allow(
        self, device: Actuator, clock: Clock, set_points: tuple[float, float]
    ) -> None:
        """`stop` during a motion leaves a set-point within the limits, and a device that measures."""
        device.set(set_points[1])
        clock.sleep(0.1)
        device.stop()
        assert device.setpoint in device.limits
        device.stop(success=False)
        _values(device, device.measure())

    def test_bluesky_finds_its_protocols(self, device: Device) -> None:
        """A bluesky RunEngine accepts it, and can move it."""
        super().test_bluesky_finds_its_protocols(device)
        assert isinstance(device, pytest.importorskip("bluesky.protocols").Movable)
