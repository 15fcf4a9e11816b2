"""What the roles promise beyond being a device or an actuator; see the classes of the roles."""

from __future__ import annotations

import math
from typing import ClassVar

import pytest

from bench.base import Clock, DeviceError
from bench.contracts.devices import ActuatorContract, DeviceContract
from bench.devices import (
    Actuator,
    Device,
    LinearStage,
    LoadCell,
    PositionSensor,
    Servo,
    Switch,
    TECAmplifier,
    TECMode,
    TemperatureSensor,
    VoltageSupply,
)


class TECAmplifierContract(ActuatorContract):
    """The contract of a TEC amplifier."""

    role = TECAmplifier
    quantities = (("temperature", "°C"), ("sink_temperature", "°C"), ("current", "A"), ("voltage", "V"))

    def quantity(self, device: Actuator) -> str:
        """Return what the mode holds constant."""
        assert isinstance(device, TECAmplifier)
        return device.mode.value

    def test_output_follows_set_and_safe(self, device: TECAmplifier, set_points: tuple[float, float]) -> None:
        """The output is off at first, on after `set`, off after `safe`; `stop` leaves it as it is."""
        found = []
        for bring in (device.stop, lambda: device.set(set_points[0]), device.stop, device.safe, device.stop):
            bring()
            found.append(device.output_enabled)
        assert found == [False, True, True, False, False]

    def test_change_of_mode_switches_off(self, device: TECAmplifier, set_points: tuple[float, float]) -> None:
        """A change of mode switches the output off and forgets the set-point; each mode has its unit."""
        modes = (TECMode.TEMPERATURE, TECMode.CURRENT)
        device.set(set_points[0])
        for mode in modes if device.mode is TECMode.CURRENT else modes[::-1]:
            device.select_mode(mode)
            assert device.mode is mode
            assert not device.output_enabled
            assert math.isnan(device.setpoint)
            unit = "°C" if mode is TECMode.TEMPERATURE else "A"
            assert device.setpoint_signal.unit == device.limits.unit == unit
            if mode is TECMode.CURRENT:
                assert device.set(0.0).success
                assert device.output_enabled


class VoltageSupplyContract(ActuatorContract):
    """The contract of a voltage supply."""

    role = VoltageSupply
    quantities = (("voltage", "V"), ("current", "A"))
    driven = "voltage"

    def test_output_names_its_voltage(self, device: VoltageSupply) -> None:
        """`output` is one of the three, and the descriptions name it."""
        assert device.output in ("average", "rms", "dc")
        assert device.output in device.signals[0].description
        assert device.output in device.setpoint_signal.description

    def test_stop_keeps_the_voltage_and_safe_is_zero(
        self, device: VoltageSupply, clock: Clock, set_points: tuple[float, float], tolerance: float
    ) -> None:
        """`stop` keeps the voltage; the safe state is a set-point and a voltage of zero."""
        for bring, expected in ((device.stop, set_points[1]), (device.safe, 0.0)):
            device.set(set_points[1]).wait()
            bring()
            clock.sleep(0.05)
            assert device.setpoint == expected
            assert device.measure()[f"{device.name}_voltage"] == pytest.approx(expected, abs=tolerance)


class LoadCellContract(DeviceContract):
    """The contract of a load cell; its load is at rest."""

    role = LoadCell
    quantities = (("force", "N"),)

    @pytest.fixture
    def resolution(self, device: LoadCell) -> float:
        """Return how close two readings of one force are, N; twice the spread of ten readings and 2 mN."""
        (forces,) = zip(*(device.glance().values() for _ in range(10)), strict=True)
        return 2e-3 + 2.0 * float(max(forces) - min(forces))

    def test_tare_makes_the_present_force_zero(self, device: LoadCell, resolution: float) -> None:
        """`tare` makes the present force zero, again without effect; `clear_tare` brings the gross force back."""
        (gross,) = device.measure().values()
        moves: DeviceError | None = None
        try:
            device.tare()
        except DeviceError as error:
            moves = error
        steps = ((device.tare, 0.0), (device.clear_tare, gross), (device.clear_tare, gross))
        for bring, expected in steps if moves is None else steps[1:]:
            bring()
            for take in (device.measure, device.glance):
                assert take() == {f"{device.name}_force": pytest.approx(expected, abs=resolution)}
        if moves is not None:
            pytest.skip(f"refused the tare and kept the gross force: {moves}")


class PositionSensorContract(DeviceContract):
    """The contract of a position sensor."""

    role = PositionSensor
    quantities = (("position", "m"),)


class TemperatureSensorContract(DeviceContract):
    """The contract of a temperature sensor."""

    role = TemperatureSensor
    quantities = (("temperature", "°C"),)


class _PositionerContract(ActuatorContract):
    """What a servo and a linear stage have in common; `holding` is the property that says that it holds."""

    driven = "position"
    holding: ClassVar[str]

    def test_holds_from_set_until_safe(self, device: Actuator, clock: Clock, set_points: tuple[float, float]) -> None:
        """It is free at first, held after `set` and `stop`, free after `safe`; `stop` holds nothing that is free."""
        first, second = set_points
        found = []
        for bring in (
            device.stop,
            lambda: device.set(first),
            device.stop,
            device.safe,
            device.stop,
            lambda: device.set(second),
        ):
            bring()
            clock.sleep(0.1)
            found.append(getattr(device, self.holding))
        assert found == [False, True, True, False, False, True]

    def test_stop_holds_the_position_of_the_moment(
        self, device: Actuator, clock: Clock, set_points: tuple[float, float], tolerance: float
    ) -> None:
        """`stop` on the way makes the present position the set-point, which the status of the motion reports."""
        device.set(set_points[0]).wait()
        status = device.set(set_points[1])
        clock.sleep(0.1)
        device.stop()
        held = device.setpoint
        assert min(set_points) - tolerance <= held <= max(set_points) + tolerance
        assert held != set_points[1]
        clock.sleep(0.5)
        assert device.measure()[f"{device.name}_position"] == pytest.approx(held, abs=tolerance)
        with pytest.raises(DeviceError):
            status.wait()


class ServoContract(_PositionerContract):
    """The contract of a servo."""

    role = Servo
    quantities = (("position", "rad"), ("velocity", "rad/s"), ("load", "1"))
    holding = "torque_enabled"


class LinearStageContract(_PositionerContract):
    """The contract of a linear stage."""

    role = LinearStage
    quantities = (("position", "m"), ("velocity", "m/s"), ("load", "1"))
    holding = "force_enabled"


class SwitchContract(ActuatorContract):
    """The contract of a switch."""

    role = Switch
    quantities = (("state", "1"),)
    driven = "state"

    @pytest.fixture
    def set_points(self) -> tuple[float, float]:
        """Return on and off."""
        return 1.0, 0.0

    @pytest.fixture
    def forbidden(self) -> tuple[float, ...]:
        """Return what is neither on nor off."""
        return math.nan, -1.0, 0.5, 1.0 + 1e-9, 2.0, math.inf

    @pytest.fixture
    def allowed(self) -> str:
        """Return how a message names what is allowed."""
        return "neither 0 (off) nor 1 (on)"

    def test_set_point_has_a_unit_and_limits(self, device: Actuator) -> None:
        """The set-point is nan before the first and has the unit 1; the limits are off and on."""
        assert math.isnan(device.setpoint)
        assert (device.setpoint_signal.name, device.setpoint_signal.unit) == (f"{device.name}_setpoint", "1")
        assert (device.limits.low, device.limits.high) == (0.0, 1.0)

    def test_switches_on_and_off(self, device: Switch) -> None:
        """It is off at first, and in each state after it was set, also by an integer or a truth value."""
        states = [0.0]
        assert device.measure() == device.glance() == {f"{device.name}_state": 0.0}
        for value in (1.0, 0.0, 1.0, 1, True, 0):
            device.set(value).wait()
            states.append(device.setpoint)
            assert device.measure() == device.glance() == {f"{device.name}_state": float(value)}
        assert states == [0.0, 1.0, 0.0, 1.0, 1.0, 1.0, 0.0]

    def test_stop_keeps_the_state_and_safe_is_off(self, device: Switch) -> None:
        """`stop` keeps the state; the safe state is off."""
        for bring, state in ((device.stop, 1.0), (device.safe, 0.0)):
            device.set(1.0)
            bring()
            assert device.measure() == {f"{device.name}_state": state}
            assert device.setpoint == state


CONTRACTS: tuple[type[DeviceContract], ...] = (
    TECAmplifierContract,
    VoltageSupplyContract,
    LoadCellContract,
    PositionSensorContract,
    TemperatureSensorContract,
    ServoContract,
    LinearStageContract,
    SwitchContract,
)
"""The contracts of the roles."""


def contracts_of(device_class: type[Device]) -> tuple[type[DeviceContract], ...]:
    """Return the contract of each role that a device class plays, or the general one if it plays none."""
    found = tuple(contract for contract in CONTRACTS if issubclass(device_class, contract.role))
    return found or ((ActuatorContract,) if issubclass(device_class, Actuator) else (DeviceContract,))
