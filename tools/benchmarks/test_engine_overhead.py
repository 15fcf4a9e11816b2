"""What a step costs beside its devices: the engine on the virtual clock, and bluesky's RunEngine.

Prints, asserts no time.
"""

import json
import logging
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from pydantic import Field

from bench.base import Interrupts, VirtualClock, registry
from bench.devices import DriverSettings, Identity, Limits, Status, TemperatureSensor, VoltageSupply
from bench.execution.engine import Engine
from bench.execution.station.local import LocalStation
from bench.protocol import Arrived, ProtocolParameters, Step, protocol
from bench.record import FILE_NAME, Journal
from bench.rig import LaboratorySettings, Rig, load_rig

pytestmark = pytest.mark.benchmark

# The rig file below names classes of this module.
registry.import_beside(Path(__file__))

STEPS = 5000

RIG = """
[rig]
title = "devices that cost nothing"

[devices.supply]
driver = "test_engine_overhead:Supply"

[devices.probe]
driver = "test_engine_overhead:Probe"

[[interlocks]]
signal = "probe_temperature"
high = 90.0
low = -50.0

[[interlocks]]
signal = "supply_voltage"
high = 50.0
seconds = 2.0

[[interlocks]]
signal = "supply_current"
high = 9.0
fastest = 100.0

[telemetry]
period = 1.0

[emulation]
laboratory = "test_engine_overhead:Nowhere"
"""


class Nowhere:
    class Settings(LaboratorySettings):
        pass

    def __init__(self, settings, clock, seed):
        pass

    def open(self):
        return {}

    def close(self):
        pass


class Supply(VoltageSupply):
    class Settings(DriverSettings):
        most: float = Field(default=40.0, description="largest voltage, V")

    identity = Identity("Test", "Supply", "1", "1.0")
    limits = Limits(0.0, 40.0, "V")
    output = "dc"
    setpoint = 0.0

    @classmethod
    def connect(cls, name, _settings, clock):
        return cls(name, clock)

    def set(self, value):
        self.check(value)
        self.setpoint = value
        return Status.completed(self.name, self._clock)

    def measure(self):
        return {f"{self.name}_voltage": self.setpoint, f"{self.name}_current": 0.1 * self.setpoint}

    def safe(self):
        self.setpoint = 0.0

    def close(self):
        pass


class Probe(TemperatureSensor):
    class Settings(DriverSettings):
        pass

    identity = Identity("Test", "Probe", "2", "1.0")

    @classmethod
    def connect(cls, name, _settings, clock):
        return cls(name, clock)

    def measure(self):
        return {f"{self.name}_temperature": 25.0 + 1e-3 * self._clock.now()}

    def safe(self):
        pass

    def close(self):
        pass


class Nothing(ProtocolParameters):
    pass


@pytest.fixture
def rig_file(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    path = tmp_path / "nothing.toml"
    path.write_text(RIG)
    return load_rig(str(path))


def of_engine(rig_file, folder):
    """Return the wall-clock time of each step, µs."""
    stamps = []

    @protocol(needs=("supply",))
    def stairs(_parameters: Nothing):
        """Set, and read when it has arrived."""
        for k in range(STEPS):
            stamps.append(time.perf_counter())
            yield Step({"supply": 1.0 + k % 20}, Arrived(timeout=10.0, minimum=0.0))
        stamps.append(time.perf_counter())

    rig = Rig(rig_file, VirtualClock(), 0)
    folder.mkdir()
    with ExitStack() as stack:
        stack.callback(rig.close)
        journal = Journal(folder / FILE_NAME, rig.signals, {"run": "overhead"})
        stack.callback(journal.close)
        engine = Engine(LocalStation(rig), journal, (), Interrupts(lambda _: None))
        outcome = engine.run(stairs, Nothing())
    assert outcome.status == "completed", outcome.reason
    assert outcome.steps == STEPS
    return 1e6 * np.diff(stamps)


def of_bluesky(rig_file, folder):
    """Return the wall-clock time of each step of the same kind, with its documents appended to a file, µs."""
    bluesky = pytest.importorskip("bluesky")
    plan_stubs = pytest.importorskip("bluesky.plan_stubs")
    writer = pytest.importorskip("bluesky.callbacks.json_writer")
    logging.getLogger("bluesky").setLevel(logging.ERROR)
    stamps = []
    rig = Rig(rig_file, VirtualClock(), 0)
    supply, probe = rig.devices["supply"], rig.devices["probe"]

    def stairs():
        yield from plan_stubs.open_run()
        for k in range(STEPS):
            stamps.append(time.perf_counter())
            yield from plan_stubs.mv(supply, 1.0 + k % 20)
            yield from plan_stubs.trigger_and_read([supply, probe])
        stamps.append(time.perf_counter())
        yield from plan_stubs.close_run()

    folder.mkdir()
    engine = bluesky.RunEngine({}, context_managers=[])
    try:
        engine(stairs(), writer.JSONWriter(str(folder)))
    finally:
        rig.close()
        engine._loop.call_soon_threadsafe(engine._loop.stop)
    (written,) = folder.iterdir()
    assert len(json.loads(written.read_text())) >= STEPS
    return 1e6 * np.diff(stamps)


def test_a_step(rig_file, tmp_path):
    times = {
        "bench, journal and interlocks": of_engine(rig_file, tmp_path / "bench"),
        "bluesky, JSON writer": of_bluesky(rig_file, tmp_path / "bluesky"),
    }
    print(f"\n{f'{STEPS} steps':32} {'median':>9} {'99 %':>9} {'99.9 %':>9}  µs a step")
    for name, each in times.items():
        figures = np.percentile(each, [50.0, 99.0, 99.9])
        print(f"{name:32} " + " ".join(f"{figure:9.3g}" for figure in figures))
