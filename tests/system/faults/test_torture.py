"""A small part of `bench rig torture`; `make fault-matrix` runs all of it on three rigs."""

import json
from functools import cache
from pathlib import Path

import pytest
from cases import cases

from bench.base import ConfigurationError
from bench.record import Record
from sim_devices.torture.running import Bed, Task, faults_of, largest_excursion, reference_of, torture

EXAMPLES = Path(__file__).parents[3] / "examples"
SUPPLY = str(EXAMPLES / "bench-supply.toml")
BUSES = str(Path(__file__).parents[1] / "lines" / "buses.toml")
PYMEASURE = str(EXAMPLES / "pymeasure-supply.toml")
OVERRIDES = {"vo2": {"devices.tec.current_limit": "1.0"}}


@cache
def tortured(rig):
    # An interlock of the servos is within their range.
    task = Task(rig, OVERRIDES.get(rig, {}), share=0.5 if rig == BUSES else 1.0)
    found = {seed: reference_of(task, seed) for seed in ((1, 4) if rig == "sma" else (0, 1))}
    return task, {seed: each.widened(found.values()) for seed, each in found.items()}


def cell(rig, fault, seed=1):
    task, references = tortured(rig)
    return torture(task, fault, seed, references[seed])


@cases(
    ("rig", "fault"),
    [
        ("vo2", "psd.drop"),
        ("vo2", "tec.garbage"),
        ("vo2", "tec.power-cycle"),
        ("vo2", "clock-step"),
        ("sma", "supply.double"),
        ("sma", "broken-muscle"),
        ("hybrid", "amplifier-trips"),
        ("hybrid", "displacement.out-of-range"),
        (SUPPLY, "meter.comma"),
        (PYMEASURE, "supply.cut"),
        ("sma", "load_cell.exchange"),
        ("sma", "load_cell.echo"),
        ("sma", "supply+load_cell.renumber"),
        (BUSES, "load2+heater1.renumber"),
    ],
)
def test_a_run_with_a_fault_ends_safe_and_true(rig, fault):
    found = cell(rig, fault)
    assert not found.failures, found


def test_an_adapter_that_hands_back_what_is_sent_is_named(tmp_path):
    schedule = tmp_path / "faults.toml"
    schedule.write_text('[[fault]]\nat = 5.0\nfault = "supply.echo"\nduration = 100.0\n')
    outcome = Bed.of(Task(SUPPLY, {})).run(0, tmp_path, schedule)
    assert outcome.status == "failed"
    assert "echo = true" in outcome.reason


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


def test_the_command_names_each_run_with_what_was_found(bench, tmp_path):
    options = ["--fault", "meter.comma", "--seeds", "2", "--processes", "1"]
    code, out, err = bench("rig", "torture", SUPPLY, *options, "--json", tmp_path / "f.json")
    assert code == 0, err
    runs = json.loads((tmp_path / "f.json").read_text())["runs"]
    assert [run["fault"] for run in runs] == ["meter.comma"] * 2
    assert {result for run in runs for result in run["results"].values()} <= {"ok", "."}
    assert "2 of 2" in out.splitlines()[-1]


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
