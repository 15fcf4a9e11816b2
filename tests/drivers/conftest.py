"""The scripted instrument at the other end of a driver's line: the class `Script` of a module, at its `PORT`."""

import pytest

from bench.clock import VirtualClock
from sim_devices.protocol_emulated import register, unregister


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def script(request, clock):
    script, name = request.module.Script(), request.module.PORT.removeprefix("emulated://")
    register(name, script, clock)
    yield script
    unregister(name)
