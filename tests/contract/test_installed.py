"""The contracts as `pytest --pyargs bench.contracts` runs them, for devices of the bench and of a stranger."""

import re
import sys

import pytest

# Each in a process of its own.
pytestmark = pytest.mark.slow

RIG = """
[rig]
title = "supplies of one's own"
"""
EMULATED = """
[emulation]
laboratory = "stranger:Nothing"
"""
MODULE = """
import math

from bench.devices import DriverSettings, Identity, Limits, Status
from bench.devices import VoltageSupply
from bench.rig import LaboratorySettings


class Nothing:
    Settings = LaboratorySettings

    def __init__(self, settings, clock, seed):
        pass

    def open(self):
        return {}

    def close(self):
        with open("closed", "a") as file:
            file.write(f"{len(Supply.on)} on\\n")


class Supply(VoltageSupply):
    Settings = DriverSettings
    on = set()
    output = "dc"
    identity = Identity("a stranger", "one", "7", "1.0")
    limits = Limits(-2.0, 2.0, "V")
    setpoint = math.nan
    volts = 0.0

    @classmethod
    def connect(cls, name, settings, clock):
        return cls(name, clock)

    def set(self, value):
        self.check(value)
        self.setpoint = self.volts = value
        self.on.add(self.name)
        return Status.completed(self.name, self._clock)

    def measure(self):
        return {f"{self.name}_voltage": self.volts, f"{self.name}_current": 0.1 * self.volts}

    def safe(self):
        self.setpoint = self.volts = 0.0
        self.on.discard(self.name)

    def close(self):
        pass


class Stale(Supply):
    table = None

    def measure(self):
        self.table = self.table or super().measure()
        return self.table


class NotANumber(Supply):
    def measure(self):
        return {name: math.nan for name in super().measure()}


class SafeOnce(Supply):
    times = 0

    def safe(self):
        super().safe()
        self.times += 1
        if self.times == 2:
            raise RuntimeError("is safe already")


class Unlimited(Supply):
    def check(self, value):
        pass


class WithoutUnit(Supply):
    @property
    def signals(self):
        return tuple(type(signal)(signal.name, "", signal.description) for signal in super().signals)
"""


BROKEN = {
    "stale": ("Stale", "test_arrives_at_its_set_points", "the readings of stale are the same .* they are stale"),
    "cached": ("Stale", "test_measures_every_signal", "measure returns the same table again"),
    "nan": ("NotANumber", "test_measures_every_signal", "nan delivers values that are not numbers"),
    "once": ("SafeOnce", "test_safe_and_stop_again_change_nothing", "is safe already"),
    "unlimited": (
        "Unlimited",
        "test_beyond_the_limits_nothing_is_sent",
        r"check\(nan\) raised no LimitError",
    ),
    "unitless": ("WithoutUnit", "test_signals_have_names_units_and_descriptions", "unitless_voltage has no unit"),
}


@pytest.fixture
def contracts(tmp_path, warm_process):
    """Return a function that runs the contracts in a stranger's folder, and returns exit code and output."""

    def run(*arguments):
        command = [sys.executable, "-m", "pytest", "--verbose", "--pyargs", "bench.contracts", *arguments]
        done = warm_process(command, tmp_path, None)
        return done.returncode, done.stdout + done.stderr

    return run


@pytest.fixture
def stranger(tmp_path):
    """Return a function that writes a rig with devices of the stranger's, by name and class."""

    def write(*appendices, **devices):
        tables = [f'[devices.{name}]\ndriver = "stranger:{kind}"\n' for name, kind in devices.items()]
        (tmp_path / "stranger.py").write_text(MODULE)
        (tmp_path / "own.toml").write_text("\n".join([RIG, *tables, *appendices]))

    return write


def test_a_device_of_the_bench_keeps_its_contract(contracts):
    code, output = contracts("--device", "drivers.labjack_t7:T7PositionSensor", "--rig", "vo2")
    assert code == 0, output
    assert "PositionSensorContract::test_measures_every_signal[psd] PASSED" in output


def test_a_device_of_a_stranger_keeps_its_contract_and_is_left_safe(contracts, stranger, tmp_path):
    stranger(EMULATED, coil="Supply", spare="Supply")
    code, output = contracts("--device", "stranger:Supply", "--rig", "own.toml")
    assert code == 0, output
    tests = re.findall(r"VoltageSupplyContract::(\w+)\[(\w+)\] PASSED", output)
    assert {name for _, name in tests} == {"coil", "spare"}
    assert (tmp_path / "closed").read_text().splitlines() == ["0 on"] * len(tests)


@pytest.mark.slow
def test_on_a_real_rig_an_actuator_moves_between_the_set_points_that_are_given(contracts, stranger):
    stranger(coil="Supply")
    code, output = contracts("--device", "coil", "--rig", "own.toml")
    assert code == pytest.ExitCode.USAGE_ERROR
    assert "own.toml is a real rig, on which coil will move; give the two values by --set-points" in output
    code, output = contracts("--device", "coil", "--rig", "own.toml", "--set-points", "0.5", "1")
    assert code == 0, output


def test_a_device_that_breaks_its_contract_is_found_out(contracts, stranger):
    stranger(EMULATED, good="Supply", **{name: kind for name, (kind, *_) in BROKEN.items()})
    code, output = contracts("--device", "stranger:Supply", "--rig", "own.toml", "-k", "not bluesky")
    assert code == pytest.ExitCode.TESTS_FAILED, output
    failed = set(re.findall(r"^FAILED \S+::(\w+\[\w+\])", output, re.MULTILINE))
    for name, (_, test, text) in BROKEN.items():
        assert f"{test}[{name}]" in failed
        assert re.search(text, output), output
    assert not any("[good]" in test for test in failed)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((), r"the contracts need a device and its rig: --device MODULE:CLASS .* --rig RIG"),
        (("--device", "fan", "--rig", "vo2"), r"--device fan: vo2.toml has no such device; it has: tec \(drivers"),
        (("--device", "no.module:Fan", "--rig", "vo2"), "--device no.module:Fan: cannot be loaded: ModuleNotFound"),
    ],
)
def test_without_a_device_and_its_rig_nothing_is_skipped(contracts, arguments, text):
    code, output = contracts(*arguments)
    assert code == pytest.ExitCode.USAGE_ERROR
    assert re.search(text, output), output
