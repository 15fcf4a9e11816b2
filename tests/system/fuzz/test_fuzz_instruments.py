"""The fuzzer on every instrument of every emulated laboratory, and that it notices what it looks for."""

import random

import pytest
from dialects import MalformedError
from faulty_line import damaged
from fuzz_instruments import SMA, TARGETS, FailedError, fuzz, make, make_bench_supply, mutated

from bench.base import VirtualClock
from rigs.hybrid.laboratory import HybridLaboratory
from rigs.vo2.laboratory import VO2Laboratory
from sim_devices.instruments.flintec_dad141 import EmulatedDAD141
from sim_devices.instruments.meerstetter_tec import EmulatedTEC
from sim_devices.wire.canopen_slcan import CanopenSlcanServer
from sim_devices.wire.mecom import MeComServer


@pytest.mark.parametrize("name", TARGETS)
def test_no_input_does_harm(name):
    outcome, again, other = (fuzz(name, 400, seed) for seed in (0, 0, 1))
    assert outcome.frames == 400
    # Most requests reach the instrument, or the inputs would test the framing alone.
    assert outcome.answers > 100
    assert outcome.digest.digest() == again.digest.digest() != other.digest.digest()


@pytest.mark.parametrize(
    ("rig", "laboratory"),
    [
        ("vo2", make(VO2Laboratory)),
        ("hybrid", make(HybridLaboratory)),
        ("sma", SMA),
        ("bench-supply", make_bench_supply),
    ],
)
def test_every_port_of_a_laboratory_is_fuzzed(rig, laboratory):
    ports = laboratory(VirtualClock(), 0).servers
    assert {f"{rig}/{port}" for port in ports} == {name for name in TARGETS if name.startswith(f"{rig}/")}


@pytest.mark.parametrize("name", ["vo2/tec", "sma/load_cell", "sma/stage", "sma/supply", "vo2/psd"])
def test_inputs_are_of_every_kind(name):
    rng, dialect = random.Random(0), TARGETS[name].dialect
    inputs = [mutated(dialect, rng) for _ in range(500)]
    assert min(map(len, inputs)) <= 1
    assert max(map(len, inputs)) > 300
    assert len(set(inputs)) > 250


def test_an_exception_is_noticed(monkeypatch):
    def fail(*_):
        raise RuntimeError("a defect")

    monkeypatch.setattr(EmulatedTEC, "attend", fail)
    with pytest.raises(RuntimeError, match="a defect") as raised:
        fuzz("vo2/tec", 200, seed=0)
    assert "vo2/tec, seed 0, frame" in raised.value.__notes__[0]


def test_a_failure_that_a_server_hides_is_noticed(monkeypatch):
    def fail(*_):
        raise RuntimeError("a defect")

    monkeypatch.setattr(EmulatedDAD141, "read_registers", fail)
    with pytest.raises(FailedError, match="the emulated instrument failed"):
        fuzz("sma/load_cell", 200, seed=0)


def test_a_damaged_answer_is_noticed(monkeypatch):
    receive = MeComServer.receive
    monkeypatch.setattr(MeComServer, "receive", lambda *given: (sent := receive(*given)) and damaged(sent))
    with pytest.raises(MalformedError):
        fuzz("vo2/tec", 200, seed=0)


def test_a_buffer_that_grows_is_noticed(monkeypatch):
    def hoard(server, data):
        server._received += data
        return b""

    monkeypatch.setattr(CanopenSlcanServer, "receive", hoard)
    monkeypatch.setattr("fuzz_instruments.PROBED_EVERY", 10_000)
    with pytest.raises(FailedError, match="bytes are kept"):
        fuzz("sma/supply", 500, seed=0)


def test_a_state_beyond_its_range_is_noticed(monkeypatch):
    original = EmulatedTEC.attend

    def attend(tec):
        original(tec)
        tec._values[2030] = 9.0

    monkeypatch.setattr(EmulatedTEC, "attend", attend)
    with pytest.raises(FailedError, match="parameter 2030"):
        fuzz("vo2/tec", 200, seed=0)


@pytest.mark.parametrize(
    ("message", "error"),
    [
        (b"VOLT" + 3000 * b" " + b"5\n", b'0,"No error"\n'),
        (b"VOLT" + 3000 * b" " + b"x\n", b'-113,"Undefined header"\n'),
        (b"VOLT" + 9000 * b" " + b"5\n", b'-363,"Input buffer overrun"\n'),
    ],
)
def test_a_long_message_is_taken_or_refused_at_once(message, error):
    line = make_bench_supply(VirtualClock(), 0).servers["supply"]
    assert line.receive(message) == b""
    assert line.receive(b"SYST:ERR?\n") == error
