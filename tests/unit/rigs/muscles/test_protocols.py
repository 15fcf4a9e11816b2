"""The protocols for muscles: what they plan and refuse, how they control, and how they end when something fails."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from cases import cases
from short_runs import all_messages

from bench.analysis import target_results
from bench.base import ConfigurationError, DataError, VirtualClock
from bench.cli import main
from bench.identification import ModelFile
from bench.models import IdentifiedDynamics, Linear, Preisach, ResponseDynamics, Summed, TwoStage, uniform_levels
from bench.protocol import Control, Phase, Prompt, Step, find_protocol, plan
from bench.record import Record
from bench.rig import Rig, load_rig
from protocols.muscles.force_voltage import scaled_steps
from rigs.muscles.identification import FORCE, LENGTH, SAMPLE

SMA = ["--rig", "sma", "--clock", "virtual"]
DEVICES = ("supply", "load_cell", "wire_end", "stage", "fan")
CHARACTERIZATION = ("force-voltage", "length-voltage", "length-force", "length-verification")
CONTROL = ("length-control", "force-control")
DYNAMICS = IdentifiedDynamics(response=ResponseDynamics(5.0, 2.0))


def assignments(option, values):
    return [part for key, value in values.items() for part in (option, f"{key}={value}")]


def bound(protocol, settings):
    """A protocol with its parameters and its slots on the rig `sma`."""
    definition, file = find_protocol(protocol), load_rig("sma")
    texts = {key: str(value) for key, value in settings.items()}
    parameters = definition.parse(texts, file.roles, file.protocols.get(protocol))
    with Rig(file, VirtualClock(), 0) as rig:
        return definition, parameters, rig.description.slots(definition)


def dry(protocol, **settings):
    """All messages of a protocol whose readings are all zero."""
    definition, parameters, slots = bound(protocol, settings)
    return all_messages(definition.start(parameters, slots), dict.fromkeys((FORCE, LENGTH), 0.0))


def samples_by_phase(messages):
    """The set-points of the supply at each sample, as they stand there, by phase."""
    found, phase, voltage = {}, "", None
    for message in messages:
        if isinstance(message, Phase):
            phase = message.name
        elif isinstance(message, Step):
            voltage = message.setpoints.get("supply", voltage)
            if message.label == SAMPLE:
                found.setdefault(phase, []).append(voltage)
    return found


def planned(protocol, **settings):
    return plan(*bound(protocol, settings))


def preisach(low, high, least, greatest, units):
    """A rising Preisach operator with its weight near the diagonal, from `least` to `greatest`."""
    levels = uniform_levels(low, high, 20)
    rows, columns = np.tril_indices(20)
    # As of the wire, which hardly moves at the lowest voltages.
    density = np.exp(-0.5 * ((rows - columns - 3) / 2.0) ** 2) * (columns >= 3)
    plain = Preisach(levels, density)
    density *= 0.5 * (greatest - least) / (density @ plain.cell_areas())
    bias = 0.5 * (greatest + least)
    return Preisach(levels, density, bias, input_unit=units[0], output_unit=units[1])


def made_up_models(unit="m", scale=1.0):
    """Models with about the ranges of the wire, made of its numbers rather than of measurements."""
    first = preisach(0.0, 3.0, 0.3, 11.2, ("V", "N"))
    second = preisach(-11.5, 11.5, -6e-3 * scale, 6e-3 * scale, ("N", unit))
    by_voltage = preisach(0.0, 3.0, 0.0, 5e-3 * scale, ("V", unit))
    by_force = preisach(0.0, 11.5, 0.0, 5e-3 * scale, ("N", unit))
    return {
        "two-stage": TwoStage(first, second, 0.3),
        "summed": Summed(by_force, by_voltage, 0.3),
        "linear": Linear(3.6, 0.3, second, (0.0, 3.0), 0.3, "V"),
    }


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Model files that do and do not fit the rig, by name."""
    folder = tmp_path_factory.mktemp("models")
    models = made_up_models()
    for name, model in models.items():
        ModelFile(name, model, dynamics=DYNAMICS).save(folder / f"{name}.json")
    ModelFile("two-stage", models["two-stage"]).save(folder / "without-dynamics.json")
    ModelFile("two-stage", made_up_models("mm", 1e3)["two-stage"]).save(folder / "millimetres.json")
    ModelFile("preisach", models["two-stage"].first, None).save(folder / "operator.json")
    damaged = json.loads((folder / "two-stage.json").read_text())
    del damaged["model"]["first"]
    (folder / "damaged.json").write_text(json.dumps(damaged))
    return {path.stem: path for path in folder.iterdir()} | {"none": folder / "none.json"}


class TestPlan:
    def test_force_over_voltage_has_the_paper_s_37_samples(self):
        found = samples_by_phase(dry("force-voltage"))
        assert list(found) == ["force over voltage"]
        assert found["force over voltage"] == scaled_steps(3.0, 37)
        assert len(scaled_steps(3.0, 37)) == 37
        assert (min(found["force over voltage"]), max(found["force over voltage"])) == (0.0, 3.0)

    def test_length_over_voltage_has_the_paper_s_185_samples_under_five_loads(self):
        found = samples_by_phase(dry("length-voltage"))
        assert list(found) == [f"length over voltage at {load:g} N" for load in (0.98, 2.94, 4.9, 6.86, 8.82)]
        assert all(voltages == scaled_steps(3.0, 37) for voltages in found.values())
        assert sum(map(len, found.values())) == 185

    def test_length_over_force_has_the_paper_s_138_samples_at_six_voltages(self):
        messages = dry("length-force")
        found = samples_by_phase(messages)
        assert [set(voltages) for voltages in found.values()] == [{0.0}, {0.6}, {1.2}, {1.8}, {2.4}, {3.0}]
        assert [len(voltages) for voltages in found.values()] == [23] * 6
        asked = [message.task.trace.reference for message in messages if isinstance(message, Control)]
        assert max(asked) == 10.5
        assert min(asked) == 0.3
        start = messages.index(Phase("length over force at 0 V"))
        one = [m.task.trace.reference for m in messages[start:] if isinstance(m, Control)][:23]
        np.testing.assert_allclose(np.diff(one), [*[(10.5 - 0.3) / 11] * 11, *[-(10.5 - 0.3) / 11] * 11])

    def test_verification_has_the_paper_s_90_samples(self):
        found = samples_by_phase(dry("length-verification"))
        assert len(found) == 5
        assert sum(map(len, found.values())) == 90
        first, *others = found.values()
        assert all(voltages == first for voltages in others)
        assert len(set(first)) == 18
        assert 0.0 <= min(first) < 1.0 < 2.0 < max(first) <= 3.0
        assert next(iter(samples_by_phase(dry("length-verification", sequence_seed=2)).values())) != first

    @cases(
        ("protocol", "seconds", "prompts"),
        [
            # Fastening 10, reset 5 + 30 + 0.1, 2 cycles of 2 · 30, 37 samples of 30.
            ("force-voltage", 10 + 35.1 + 120 + 37 * 30, 1),
            # For each load: cooling 20.5, two loads of 5, reset 30 + 20 + 30, 37 samples of 30.
            ("length-voltage", 5 * (20.5 + 10 + 80 + 37 * 30), 10),
            # Fastening 10; for each voltage: reset 35.1, slack 5, voltage 30, 23 samples of 30.
            ("length-force", 10 + 6 * (35.1 + 35 + 23 * 30), 1),
            ("length-verification", 5 * (20.5 + 10 + 80 + 18 * 30), 10),
        ],
    )
    def test_it_takes_as_long_as_its_dwells_at_least(self, protocol, seconds, prompts):
        found = planned(protocol)
        assert found.seconds == pytest.approx(seconds)
        assert found.at_most >= found.seconds
        assert found.prompts == prompts

    @cases("rig", ["sma", "sma-hardware"])
    @cases("protocol", [*CHARACTERIZATION, *CONTROL])
    def test_set_points_lie_within_what_the_rig_allows(self, protocol, rig, files):
        limits = {entry.name: entry.settings for entry in load_rig(rig).devices}
        allowed = {
            "supply": limits["supply"].voltage_limits,
            "stage": limits["stage"].stage_limits,
            "fan": (0.0, 1.0),
        }
        found = planned(protocol, **({"model": files["two-stage"]} if protocol in CONTROL else {}))
        assert found.extremes["supply"] == (0.0, 3.0)
        for device, (low, high) in found.extremes.items():
            assert allowed[device][0] <= low <= high <= allowed[device][1]

    def test_changing_weights_are_asked_for(self, files):
        loads = [
            message.value
            for message in dry("length-control", model=files["two-stage"], change=1.96, count=20)
            if isinstance(message, Prompt)
        ]
        assert loads == [0.3, 4.9, 6.86, 4.9, 6.86]
        assert planned("length-control", model=files["two-stage"]).prompts == 2
        assert planned("force-control", model=files["two-stage"]).prompts == 1

    def test_targets_are_drawn_from_what_the_model_reaches(self, files):
        references = []
        for seed, margin in ((1, 0.05), (1, 0.05), (2, 0.05), (1, 0.25)):
            messages = dry("force-control", model=files["two-stage"], count=30, sequence_seed=seed, margin=margin)
            reach = [m for m in messages if isinstance(m, Control) and m.actuator == "supply"]
            targets = []
            for message in reach:
                message.task.begin(0.0, 0.0, 1.0)
                targets.append(message.task.trace.reference)
            references.append(targets)
        assert references[0] == references[1] != references[2]
        assert len(references[0]) == 30
        assert 0.3 < min(references[0]) < 3.0
        assert 8.0 < max(references[0]) < 11.2
        # The same draws from a narrower range.
        wide, narrow = (np.array(references[each]) for each in (0, 3))
        np.testing.assert_allclose(narrow - narrow.mean(), (wide - wide.mean()) * 0.5 / 0.9)


class TestRefused:
    @cases("text", ["", ",", "1,,2", "1;2", "one", "1, nan", "inf", "1 2"])
    def test_what_are_no_numbers(self, text):
        with pytest.raises(ConfigurationError, match=r"loads .*is not a finite number"):
            find_protocol("length-voltage").parse({"loads": text})

    @cases(
        ("protocol", "settings", "words"),
        [
            ("length-voltage", ["loads=4.9;2"], ["loads = '4.9;2'", "commas"]),
            ("length-voltage", ["loads=4.9, -1"], ["loads = 4.9, -1", "positive"]),
            ("length-voltage", ["highest=3.3"], ["supply", "3.3 V", "0 to 3.2 V"]),
            ("force-voltage", ["slack=-0.02"], ["stage", "-0.02", "-0.015 to 0.011 m"]),
            ("length-force", ["voltages=0, 3.4"], ["supply", "3.4 V", "0 to 3.2 V"]),
            ("length-force", ["voltages=-1"], ["supply", "-1", "0 to 3.2 V"]),
            ("length-force", ["smallest_force=5", "largest_force=5"], ["smallest_force", "< largest_force"]),
            ("force-control", [], ["model", "is missing"]),
            ("length-control", ["model={two-stage}", "controller=bang-bang"], ["controller", "closed-loop-inverse"]),
            ("length-control", ["model={two-stage}", "highest=3.3"], ["supply", "3.3 V"]),
            ("length-control", ["model={two-stage}", "load=60"], ["3 V", "length does not change under 60 N"]),
            ("length-control", ["model={two-stage}", "load=0.05", "change=11.4"], ["change", "no length in common"]),
            ("length-control", ["model={two-stage}", "highest=0.1"], ["highest", "0.1 V", "length does not change"]),
            ("force-control", ["model={two-stage}", "highest=0.1"], ["highest", "0.1 V", "force does not change"]),
            ("force-control", ["model={two-stage}", "change=1"], ["no parameter 'change'", "slack"]),
        ],
    )
    def test_before_anything_moves(self, bench, tmp_path, files, protocol, settings, words):
        options = [part for text in settings for part in ("--set", text.format(**files))]
        code, _, err = bench("run", protocol, *SMA, *options, "--out", tmp_path)
        assert code == 2
        assert err.count("error:") == 1
        assert "Traceback" not in err
        for word in words:
            assert word in re.sub(r"\s+", " ", err)
        assert not list(tmp_path.iterdir())

    @cases("protocol", CONTROL)
    @cases(
        ("name", "words"),
        [
            ("summed", "expected a model of the kind 'two-stage'"),
            ("operator", "expected a model of the kind 'two-stage', got 'preisach'"),
            ("millimetres", "expected a model in V, N and m, got 'V', 'N', 'mm'"),
            ("damaged", "damaged"),
            ("none", "cannot be read"),
        ],
    )
    def test_models_that_do_not_fit(self, files, protocol, name, words):
        with pytest.raises(DataError, match=words) as caught:
            planned(protocol, model=files[name])
        assert f"{name}.json" in str(caught.value)

    @cases("protocol", CONTROL)
    def test_a_model_that_does_not_say_how_fast_the_muscle_is(self, files, protocol):
        with pytest.raises(ConfigurationError, match="does not say how fast the muscle follows"):
            planned(protocol, model=files["without-dynamics"])

    @cases(
        ("protocol", "missing"),
        [
            ("length-voltage", "[roles.force], [roles.load], [roles.cooling]"),
            ("force-voltage", "[roles.force], [roles.stage]"),
        ],
    )
    def test_a_rig_without_a_muscle(self, bench, tmp_path, protocol, missing):
        code, _, err = bench("run", protocol, "--rig", "vo2", "--clock", "virtual", "--out", tmp_path)
        assert code == 2
        text = re.sub(r"\s+", " ", err)
        assert f"vo2.toml: protocol {protocol} needs {missing}; the file binds: drive, response" in text
        assert not list(tmp_path.iterdir())

    @cases(
        ("protocol", "settings", "words"),
        [
            ("length-force", {"smallest_force": 6, "largest_force": 5}, "smallest_force = 6 N is not allowed with"),
            ("length-force", {"stiffnesses": "900, 30"}, "stiffnesses = 900, 30 N/m is not allowed"),
            ("force-voltage", {"stiffnesses": "0, 0"}, "stiffnesses = 0, 0 N/m is not allowed"),
            ("force-voltage", {"highest": "0"}, "highest = '0' is not allowed; allowed: > 0 V"),
            ("length-verification", {"highest": "-1"}, "highest = '-1' is not allowed; allowed: > 0 V"),
            ("length-voltage", {"loads": "0, 1"}, "loads = 0, 1 N is not allowed; allowed: positive numbers"),
            ("calibration-load", {"weights": "1, -1", "tolerance": "0.2"}, "weights = 1, -1 N is not allowed"),
        ],
    )
    def test_a_parameter_is_named_with_its_value_and_what_is_allowed(self, protocol, settings, words):
        with pytest.raises(ConfigurationError) as caught:
            planned(protocol, **settings)
        assert str(caught.value).startswith(f"protocol {protocol}: parameter {words}")


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """A two-stage model of the wire from short runs through the command line."""
    folder = tmp_path_factory.mktemp("identified")
    runs = []
    for protocol, settings in (
        ("force-voltage", {"points": 15, "dwell": 10}),
        ("length-voltage", {"points": 15, "dwell": 10, "loads": "4.9, 6.86"}),
    ):
        result = folder / "run.json"
        with pytest.raises(SystemExit) as stopped:
            main(
                ["run", protocol, *SMA, *assignments("--set", settings), "--out", str(folder), "--json", str(result)]
            )
        assert not stopped.value.code
        runs.append(json.loads(result.read_text())["folder"])
    with pytest.raises(SystemExit) as stopped:
        main(["identify", *runs, "--model", "two-stage", "--out", str(folder / "model.json")])
    assert not stopped.value.code
    return folder / "model.json"


class TestControl:
    def test_length_under_a_weight_that_changes(self, bench, identified, tmp_path):
        settings = {"model": identified, "count": 7, "change": 1.96, "duration": 15, "readings": 3, "dwell": 10}
        code, _, err = bench(
            *("run", "length-control", *SMA, *assignments("--set", settings)),
            *("--out", tmp_path, "--json", tmp_path / "run.json"),
        )
        assert code == 0, err
        result = json.loads((tmp_path / "run.json").read_text())
        assert set(result["safe_state"].values()) == {"safe"}
        with Record(Path(result["folder"])) as record:
            assert record.meta["controls"] == LENGTH
            results, ticks, events = target_results(record, LENGTH), record.telemetry(), record.events()
        assert results.targets.size == 7
        assert np.sqrt(np.mean((results.outputs - results.targets) ** 2)) < 0.02e-3
        assert np.all(results.seconds >= 15.0 - 1e-6)
        # Before the first set-point there is none.
        assert np.nanmin(ticks["supply_setpoint"]) == 0.0
        assert np.nanmax(ticks["supply_setpoint"]) == 3.0
        prompts = [event.text for event in events if event.kind == "prompt"]
        assert [float(re.search(r"Hang ([\d.]+) N", text).group(1)) for text in prompts] == [0.3, 4.9, 6.86]
        (note,) = (event.text for event in events if event.kind == "note")
        rms = 1e3 * np.sqrt(np.mean((results.outputs - results.targets) ** 2))
        assert note.startswith("closed-loop-inverse: 7 targets")
        assert f"RMS {rms:.3f} mm" in note


LENGTH_RUN = ("length-voltage", {"loads": "4.9", "points": "11", "dwell": "5"})


class TestWhatGoesWrong:
    """One message, the right exit code, the safe state of every device, and the record until then."""

    def run(self, bench, tmp_path, protocol, settings, **emulation):
        overrides = {f"emulation.{key}": value for key, value in emulation.items()}
        code, _, err = bench(
            "run", protocol, *SMA, *assignments("--set", settings), *assignments("--override", overrides),
            "--out", tmp_path, "--json", tmp_path / "run.json",
        )  # fmt: skip
        return code, re.sub(r"\s+", " ", err), json.loads((tmp_path / "run.json").read_text())

    @pytest.mark.parametrize(
        ("protocol", "settings", "emulation", "code", "words", "steps"),
        [
            pytest.param(
                "length-force", {"voltages": "0", "points": "2", "largest_force": "13", "dwell": "2"}, {},
                5, ["interlock: load_cell_force = 12", "outside of -0.5 to 12.5 N"], 9, id="force over its range",
            ),
            pytest.param(
                *LENGTH_RUN, {"fault": "missing-heartbeat", "fault_time": "60"},
                4, ["supply: no heartbeat of node 1", "2.5 s are allowed", "check the bus"], 6, id="heartbeat",
            ),
            pytest.param(
                *LENGTH_RUN, {"fault": "forgotten-load", "fault_time": "40"},
                4, ["load_cell_force: reads 0.", "after the prompt to hang 4.9 N", "expected 4.652 to 5.148 N",
                    "Was it done?"],
                7, id="weight not changed",
            ),
            pytest.param(
                "length-voltage", {"loads": "20", "dwell": "2"}, {},
                2, ["a load of 20 N cannot be hung on the muscle", "18.85 N"], 6, id="weight too heavy",
            ),
        ],
    )  # fmt: skip
    def test_ends_the_run_in_the_safe_state(self, bench, tmp_path, protocol, settings, emulation, code, words, steps):
        found, err, result = self.run(bench, tmp_path, protocol, settings, **emulation)
        assert found == code
        assert err.count("error:") == 1
        assert "Traceback" not in err
        for word in words:
            assert word in err
        assert result["status"] == "failed"
        assert result["is_safe"]
        assert result["safe_state"] == dict.fromkeys(DEVICES, "safe")
        with Record(Path(result["folder"])) as record:
            assert record.status == "failed"
            assert re.sub(r"\s+", " ", record.meta["reason"]) in err
            assert record.meta["safe_state"] == dict.fromkeys(DEVICES, "safe")
            kept = record.steps()
            assert kept["step"].tolist() == list(range(result["steps"]))
            assert result["steps"] >= steps
            events, ticks = record.events(), record.telemetry()
        assert np.all(np.diff(ticks["t"]) > 0)
        # A tick comes every 2 s.
        assert {*kept["step"][kept["finished"] - kept["started"] > 2.5]} <= {*ticks["step"]}
        # Telemetry reaches to the last tick before what happened; a line that is lost has time to come back.
        assert result["laboratory_seconds"] - ticks["t"][-1] < 12.0
        # A device that is silent comes last.
        safe = {event.text for event in events if event.kind == "safe-state"}
        assert safe == {f"{name}: safe" for name in DEVICES}
        (trouble,) = (event for event in events if event.level == "ERROR")
        assert trouble.kind == ("interlock" if code == 5 else "error")

    def test_what_cannot_be_made_safe_is_told_first(self, bench, tmp_path):
        code, err, result = self.run(bench, tmp_path, *LENGTH_RUN, fault="silent-supply", fault_time=60)
        assert code == 7
        assert err.startswith("error: supply is NOT in its safe state:")
        assert "disconnect its power supply" in err
        assert err.count("error:") == 2
        assert result["status"] == "failed"
        assert not result["is_safe"]
        assert [name for name, state in result["safe_state"].items() if state == "safe"] == list(DEVICES[1:])
        with Record(Path(result["folder"])) as record:
            assert len(record.steps()) == result["steps"] >= 6
