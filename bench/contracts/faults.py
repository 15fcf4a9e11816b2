"""What devices promise when the line or the instrument fails.

These classes need an instrument whose faults a test can switch on, an emulated one as a rule.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest

from bench.devices import Actuator
from bench.errors import DeviceConnectionError, DeviceError


class SilentInstrumentContract:
    """The contract of an actuator whose instrument stops answering.

    A subclass provides the fixture `device`, `set_points` as for an `ActuatorContract`, and `unplug`, a function
    that cuts the line.
    """

    def test_silence_is_an_error_of_every_call(
        self, device: Actuator, set_points: tuple[float, float], unplug: Callable[[], object]
    ) -> None:
        """Reading and setting raise a `DeviceConnectionError` that names the device."""
        device.set(set_points[0])
        unplug()
        for call in (device.measure, device.glance, device.read, lambda: device.set(set_points[1])):
            with pytest.raises(DeviceConnectionError, match=f"^{device.name}: "):
                call()

    def test_safe_without_an_answer_raises(
        self, device: Actuator, set_points: tuple[float, float], unplug: Callable[[], object]
    ) -> None:
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
        self,
        device: Actuator,
        set_points: tuple[float, float],
        spoil: Callable[[], object],
        requests: list[bytes],
    ) -> None:
        """The same request is repeated once, and no other."""
        device.set(set_points[0]).wait()
        for call in (device.measure, lambda: device.set(set_points[1]), device.safe):
            spoil()
            requests.clear()
            call()
            assert requests[0] == requests[1]
            assert len(set(requests)) == len(requests) - 1
