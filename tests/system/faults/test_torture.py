"""A small part of `bench rig torture`; `make fault-matrix` runs all of it on three rigs."""

import json
from functools import cache
from pathlib import Path
from textwrap import dedent

import pytest
from cases import cases

from bench.base import ConfigurationError
from bench.record import Record
from sim_devices.torture.running import Bed, Task, faults_of, largest_excursion, reference_of, torture

EXAMPLES = Path(__file__).parents[3] / "examples"
SUPPLY = str(EXAMPLES / "bench-supply.toml")
PYMEASURE = str(EXAMPLES / "pymeasure-supply.toml")
OVERRIDES = {"vo2": {"devices.tec.current_limit": "1.0"}}


@cache
def tortured(rig):
    task = Task(rig, OVERRIDES.get(rig, {}))
    found = {seed: reference_of(task, seed) for seed in (0, 1, 4)}
    return task, {seed: each.widened(found.values()) for seed, each in found.items()}


def cell(rig, fault, seed=1):
    task, references = tortured(rig)
    return torture(task, fault, seed, references[seed])


@cases(
    ("rig", "fault"),
    [
        ("vo2", "psd.drop"),
        ("vo2", "tec.unplug"),
        ("vo2", "tec.garbage"),
        ("vo2", "tec.power-cycle"),
        ("vo2", "tec-over-current"),
        ("vo2", "clock-step"),
        ("sma", "supply.double"),
        ("sma", "stage.halve"),
        ("sma", "broken-muscle"),
        ("hybrid", "tec.corrupt"),
        ("hybrid", "amplifier-trips"),
        ("hybrid", "displacement.out-of-range"),
        (SUPPLY, "meter.comma"),
        (PYMEASURE, "supply.cut"),
        (PYMEASURE, "supply.power-cycle"),
        ("sma", "load_cell.exchange"),
    ],
)
def test_a_run_with_a_fault_ends_safe_and_true(rig, fault):
    found = cell(rig, fault)
    assert not found.failures, found


def test_an_instrument_that_keeps_others_waiting_is_named():
    # The watchdog of the servo is what ends the run, as the supply answers late again and again.
    found = cell("sma", "supply.corrupt", 4)
    assert found.results["names"] == "ok", found


def test_a_wrong_value_is_found_out(tmp_path):
    task, references = tortured("hybrid")
    bed = Bed.of(task)
    schedule = tmp_path / "faults.toml"
    schedule.write_text('[[fault]]\nat = 5.0\nfault = "base.drifting"\nvalues = { slope = 0.1 }\n')
    outcome = bed.run(1, tmp_path, schedule)
    assert outcome.status == "completed"
    (folder,) = (path for path in tmp_path.iterdir() if path.is_dir())
    with Record(folder) as record:
        found = references[1].lie(record, bed.observed, "")
        assert found.startswith("base_temperature = ")
        assert references[1].lie(record, bed.observed, "base_temperature tec_temperature is wrong") == ""


def test_an_output_that_stays_on_is_found_out():
    task, _ = tortured("vo2")
    bed = Bed.of(task)
    laboratory = bed.observed.laboratory
    assert bed.safe() == "ok"
    laboratory.tec.set(30.0)
    assert bed.safe() == "on for ever: tec_output"


def test_an_output_beyond_a_limit_is_found_out():
    task, references = tortured("vo2")
    bed = Bed.of(task)
    assert bed.within_limits(references[1]) == "ok"
    instant, values = bed.observed.seen[0]
    bed.observed.seen.append((instant, values | {"tec_current": 1.5}))
    assert bed.within_limits(references[1]).startswith("tec_current truly was 1.5")


CARELESS = '''
    """A meter and its driver, which takes any line for the answer to its question."""
    from bench.base import DeviceConnectionError
    from bench.devices import Actuator, Identity, Limits, Signal, Status
    from pydantic import Field
    import math, serial
    from bench.devices import DriverSettings
    from bench.rig import LaboratorySettings
    from sim_devices.laboratory import EmulatedLaboratory, TrueValue
    from sim_devices.wire.text import LineServer

    class Source(LineServer):
        amperes, on = 0.0, False

        def answer(self, message):
            word, _, number = message.partition(" ")
            if word == "SET":
                self.amperes, self.on = float(number), True
            if word == "OFF":
                self.amperes, self.on = 0.0, False
            return {"I?": f"{self.amperes:.4f}", "V?": f"{2 * self.amperes:.4f}"}.get(word)

        def power_cycle(self):
            self.amperes, self.on = 0.0, False

    class Laboratory(EmulatedLaboratory):
        def __init__(self, settings, clock, seed):
            self.source = Source()
            super().__init__(
                "careless", {"source": self.source}, clock, instruments={"source": self.source}, seed=seed
            )

        def truth(self):
            return {"current": TrueValue(self.source.amperes, "A", is_output=True)}

    class Driver(Actuator):
        class Settings(DriverSettings):
            port: str

        setpoint, limits = math.nan, Limits(0.0, 3.0, "A")
        identity = Identity("a", "b", "c", "d")
        signals = Signal("coil_current", "A", "current"), Signal("coil_voltage", "V", "voltage")
        setpoint_signal = Signal("coil_setpoint", "A", "set-point")

        def __init__(self, name, settings, clock):
            super().__init__(name, clock)
            self.line = serial.serial_for_url(settings.port, timeout=0.5)

        @classmethod
        def connect(cls, name, settings, clock):
            return cls(name, settings, clock)

        def ask(self, question):
            self.line.write(question + b"\\n")
            answer = self.line.readline()
            if not answer.endswith(b"\\n"):
                raise DeviceConnectionError(self.name, "no answer")
            return float(answer)

        def measure(self):
            return {"coil_current": self.ask(b"I?"), "coil_voltage": self.ask(b"V?")}

        def set(self, value):
            self.line.write(b"SET %f\\n" % value)
            self.setpoint = value
            return Status.completed(self.name, self._clock)

        def safe(self):
            self.line.write(b"OFF\\n")

        def close(self):
            self.line.close()
'''
RIG = """
    [rig]
    title = "a rig of its own"

    [devices.coil]
    driver = "careless:Driver"
    port = "emulated://source"

    [emulation]
    laboratory = "careless:Laboratory"
"""


@pytest.fixture
def careless(tmp_path):
    (tmp_path / "careless.py").write_text(dedent(CARELESS))
    (tmp_path / "rig.toml").write_text(dedent(RIG))
    return tmp_path / "rig.toml"


def test_a_careless_driver_is_found_out(bench, careless, tmp_path):
    code, out, err = bench(
        "rig",
        "torture",
        careless,
        "--fault",
        "source.",
        "--seeds",
        "2",
        "--processes",
        "1",
        "--json",
        tmp_path / "f.json",
    )
    assert code == 1, err
    found = json.loads((tmp_path / "f.json").read_text())
    results = {}
    for each in found["runs"]:
        results.setdefault(each["fault"], []).append(each["results"])
    # A doubled answer is taken for that to the next question, and a value without a check for the true one.
    assert any(result["true"].startswith("coil_") for result in results["source.double"])
    # Without a word of its own for a number that is none, the run ends all the same.
    assert all(result["safe"] == "ok" for result in results["source.halve"])
    # Its restart is not noticed: it goes on with a value that nobody has set.
    assert "source.power-cycle" in out
    assert "of" in out.splitlines()[-1]


@cases(
    ("options", "said"),
    [
        (("vo2-hardware",), "has no emulated laboratory"),
        (("vo2", "--device", "tek"), "--device tek: there is no such device; there are: tec, psd"),
        (("vo2", "--fault", "flood"), "--fault flood: no fault has this in its name"),
    ],
)
def test_what_cannot_be_tortured_is_refused(bench, options, said):
    code, _, err = bench("rig", "torture", *options)
    assert code == 2
    assert said in " ".join(err.split())


def test_faults_are_chosen_by_device_and_word():
    task, _ = tortured("vo2")
    assert faults_of(task, "tec", "power") == ["tec.power-cycle", "tec.power-loss"]
    assert len(faults_of(task, None, "")) > 35


def test_a_rig_that_completes_no_excursion_says_why():
    with pytest.raises(ConfigurationError, match="tec"):
        largest_excursion(Task("vo2", {"interlocks": "[{signal = 'tec_temperature', high = 1.0}]"}))


def test_a_served_laboratory_is_given_its_faults(emulated_rig):
    rig = emulated_rig("vo2", faults=[{"at": 1.0, "fault": "tec.hang", "duration": 2.0}])
    rig.control.advance(60.0)
    assert [(each["fault"], each["what"]) for each in rig.control.events()] == [
        ("tec.hang", "begins"),
        ("tec.hang", "ends"),
    ]
    with pytest.raises(ConfigurationError, match=r"tec\.flood"):
        emulated_rig("vo2", faults=[{"at": 1.0, "fault": "tec.flood"}])
