"""The driver of text instruments when the instrument restarts, the line is lost, or answers are spoilt."""

from contextlib import ExitStack

import numpy as np
import pytest
from faulty_line import FaultyLine
from text_laboratory import Laboratory

from bench.base import DeviceConnectionError, DeviceError, DeviceRestartedError
from bench.contracts import ActuatorLineLostContract, RestartedActuatorContract, SafeOverAFreshLineContract
from drivers.scpi import SCPIActuator, SCPIVoltageSupply
from sim_devices import protocol_emulated
from sim_devices.wire.text import TextServer

CALLS = 2000
TIMEOUT = 0.4
UNASKED = {"on": ["OUTP ON"], "off": ["OUTP OFF"]}


@pytest.fixture
def stack():
    with ExitStack() as stack:
        yield stack


class _OnALaboratory:
    @pytest.fixture(
        params=[(SCPIActuator, {}), (SCPIVoltageSupply, {}), (SCPIActuator, {"output": UNASKED})],
        ids=["actuator", "voltage supply", "without a question for the output"],
    )
    def lab(self, stack, request):
        kind, changes = request.param
        return Laboratory(stack, kind=kind, timeout=TIMEOUT, **changes)

    @pytest.fixture
    def device(self, lab):
        return lab.connect()

    @pytest.fixture
    def clock(self, lab):
        return lab.clock

    @pytest.fixture
    def set_points(self):
        return 7.5, 22.5

    @pytest.fixture
    def restart(self, lab):
        return lab.instrument.power_cycle

    @pytest.fixture
    def output(self, lab):
        return lambda: lab.instrument.output


class _WithALine(_OnALaboratory):
    @pytest.fixture(params=["unplugged", "silent"])
    def cut(self, lab, request):
        if request.param == "silent":
            return lab.instrument.unplug
        return lambda: protocol_emulated.unregister("scpi-test")

    @pytest.fixture
    def mend(self, lab):
        def mend():
            lab.instrument.plug_in()
            protocol_emulated.unregister("scpi-test")
            protocol_emulated.register("scpi-test", lab.server, lab.clock)

        return mend

    @pytest.fixture
    def exchange(self, lab):
        def exchange():
            usual = lab.answer
            lab.answer = lambda data, answer: usual(data, answer).replace(b"emulated", b"another")

        return exchange

    @pytest.fixture
    def truth(self, lab):
        return lambda: {"supply_voltage": lab.instrument.output, "supply_current": lab.current}

    @pytest.fixture
    def tolerance(self):
        return 1e-6


class TestRestart(_OnALaboratory, RestartedActuatorContract):
    pass


class TestLineLost(_WithALine, ActuatorLineLostContract):
    pass


class TestSafeOverAFreshLine(_WithALine, SafeOverAFreshLineContract):
    pass


def test_switching_on_again_writes_the_set_up_first(stack):
    lab = Laboratory(stack)
    device = lab.connect()
    device.set(5.0)
    device.safe()
    lab.requests.clear()
    device.set(6.0)
    assert lab.requests.index("VOLT:PROT 31") < lab.requests.index("VOLT 6.000") < lab.requests.index("OUTP ON")


def test_nothing_is_sent_to_an_instrument_that_restarted_but_what_switches_off(stack):
    lab = Laboratory(stack)
    device = lab.connect()
    device.set(5.0)
    lab.instrument.power_cycle()
    with pytest.raises(DeviceRestartedError):
        device.set(6.0)
    lab.requests.clear()
    for call in (device.glance, device.measure, lambda: device.set(6.0)):
        with pytest.raises(DeviceRestartedError):
            call()
    assert lab.requests == []
    device.safe()
    assert lab.requests == ["OUTP OFF", "OUTP?"]


# Lines of text have no check sum: a digit that is damaged is a digit, unless TCP or USB refuses it.
KINDS = ("drop", "double", "delay")


@pytest.mark.parametrize("kinds", [*((kind,) for kind in KINDS), KINDS], ids=[*KINDS, "all"])
def test_a_reading_was_taken_during_its_call(stack, kinds):
    """The two signals have values apart, and each has a part that says when it was read."""
    lab = Laboratory(stack, timeout=TIMEOUT, identity="EXAMPLE,PS-3005,emulated", error_query="")
    device = lab.connect()
    given = []

    def count(signal):
        def read():
            given.append(lab.clock.now())
            return float(len(given)) if signal == "voltage" else -float(len(given))

        return read

    for name, meter in lab.instrument._meters.items():
        object.__setattr__(meter, "read", count(name))
    line = FaultyLine(
        TextServer(lab.instrument), lab.clock, np.random.default_rng(1), kinds=kinds, share=0.3, latest=2.8 * TIMEOUT
    )
    protocol_emulated.unregister("scpi-test")
    protocol_emulated.register("scpi-test", line, lab.clock)
    pauses = np.random.default_rng(2)
    taken, wrong = 0, []
    for _ in range(CALLS // 2):
        lab.clock.sleep(pauses.choice([0.0, 0.01, 0.5]))
        begin = lab.clock.now()
        try:
            values = device.glance()
        except DeviceError:
            continue
        taken += 1
        for number in (values["supply_voltage"], -values["supply_current"]):
            if not (number > 0 and begin <= given[round(number) - 1]):
                wrong.append(number)
    assert not wrong
    assert taken > CALLS / 8
    if kinds != ("double",):
        assert device.repeats > 0.1 * line.spoilt
    line.share = 0.0
    lab.clock.sleep(3.0)
    device.glance()


def test_a_safe_state_is_not_read_from_a_late_answer(stack):
    lab = Laboratory(stack, timeout=TIMEOUT)
    device = lab.connect()
    device.set(5.0)
    held = []

    def late(data, usual):
        # The output stays on, and a number that reads like "off" comes late.
        if b"OUTP OFF" in data:
            return b""
        answer, held[:] = b"".join([*held, usual(data)]), []
        return answer

    lab.answer = lambda *_: b""
    with pytest.raises(DeviceConnectionError):
        device.glance()
    held[:] = [b"0\n"]
    lab.answer = late
    with pytest.raises(DeviceError, match="does not confirm that its output is off"):
        device.safe()
