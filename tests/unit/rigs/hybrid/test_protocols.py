"""The protocols for the hybrid: what they plan and refuse, what they set, and how they end when something fails."""

import io
import json
import math
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cases import cases
from rich.console import Console
from short_runs import all_messages

from bench.base import ConfigurationError, ConvergenceError, DataError, VirtualClock
from bench.execution import Run, carry_out, check_before_moving
from bench.identification import ModelFile
from bench.models import Polynomial, PrandtlIshlinskii
from bench.protocol import Caution, FixedRate, Step, find_protocol, plan
from bench.record import Record
from bench.rig import Rig, load_rig
from protocols.hybrid.control import APPROACH, REST, moves_of
from rigs.hybrid.control import HybridController, OpenLoopHybrid, ThermalFeedback
from rigs.hybrid.design import Design
from rigs.hybrid.identification import read_loop, read_loops
from rigs.hybrid.laboratory import ENABLE_LINE, HybridLaboratory
from rigs.hybrid.model import PUBLISHED_DYNAMICS, HybridModel

PLAIN, WITNESSED = "hybrid", "hybrid-witness"
DEFLECTION, BASE, TIP = "displacement_position", "base_temperature", "tip_temperature"
WITNESS = "witness_position"
DEVICES = ("tec", "displacement", "base", "tip", "piezo")
SENSORS = {DEFLECTION, BASE, TIP}
LIMITS = {"tec": 0.15, "piezo": 40.0}
MICRO = 1e-6


def assignments(option, values):
    return [part for key, value in values.items() for part in (option, f"{key}={value}")]


def made_up_model():
    """A model of about the numbers of the paper, rather than from measurements."""
    # The polynomial is one in the rise over half its range.
    polynomial = Polynomial([-7.363e-6 * 25.0], (-25.0, 25.0), 0.0, "K", "m")
    weights = np.array([150.0, *np.linspace(30.0, 2.0, 14)]) * 1e-9
    hysteresis = PrandtlIshlinskii(
        np.arange(15) * 40.0 / 15, weights, input_range=(-40.0, 40.0), input_unit="V", output_unit="m"
    )
    return HybridModel(Design().network(), polynomial, hysteresis, PUBLISHED_DYNAMICS)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Model files that can and cannot be used, by name."""
    folder = tmp_path_factory.mktemp("models")
    ModelFile("hybrid", made_up_model()).save(folder / "hybrid.json")
    content = json.loads((folder / "hybrid.json").read_text())
    ModelFile("polynomial", made_up_model().polynomial).save(folder / "other.json")
    del content["model"]["dynamics"]
    (folder / "damaged.json").write_text(json.dumps(content))
    return {path.stem: path for path in folder.iterdir()} | {"none": folder / "none.json"}


def parsed(protocol, settings):
    definition, rig = find_protocol(protocol), load_rig(PLAIN)
    texts = {key: str(value) for key, value in settings.items()}
    return definition, definition.parse(texts, rig.roles, rig.protocols.get(protocol))


@cache
def slots_of(protocol, rig=PLAIN):
    with Rig(load_rig(rig), VirtualClock(), 1) as connected:
        return connected.description.slots(find_protocol(protocol))


def planned(protocol, rig=PLAIN, **settings):
    return plan(*parsed(protocol, settings), slots_of(protocol, rig))


def dry(protocol, **settings):
    """All messages of a protocol whose readings are all zero."""
    definition, parameters = parsed(protocol, settings)
    return all_messages(definition.start(parameters, slots_of(protocol)), {})


def loops(protocol, **settings):
    return [message for message in dry(protocol, **settings) if isinstance(message, FixedRate)]


def setpoints(loop, actuator=0):
    """Times and set-points of a loop without feedback."""
    times = np.arange(round(loop.duration * loop.rate)) / loop.rate
    return times, np.array([loop.controller.update(t, ())[actuator] for t in times])


DEFAULTS = (
    ("current-sine", 1, 2000.0, SENSORS | {"tec_setpoint"}),
    ("current-steps", 1, 6000.0, SENSORS | {"tec_setpoint"}),
    ("thermomechanical", 34, 34 * 240.0, set()),
    ("piezo-loops", 1, 50.0, SENSORS | {"piezo_setpoint"}),
    ("piezo-step", 1, 0.32, {DEFLECTION, "piezo_setpoint"}),
    ("hybrid-excitation", 1, 2000.0, SENSORS | {"tec_setpoint", "piezo_setpoint"}),
    # Six moves of 640 µm in all.
    ("hybrid-control", 1, REST + 640.0 / 3.0 + 6 * (10.0 + 60.0), SENSORS | {"tec_setpoint", "piezo_setpoint"}),
    ("fine-step", 1, 0.25, {DEFLECTION, "piezo_setpoint"}),
)

EXTREMES = {
    "current-sine": {"tec": (-0.1, 0.1)},
    "current-steps": {"tec": (-0.1, 0.1)},
    "thermomechanical": {"tec": (-0.15, 0.1)},
    "piezo-loops": {"piezo": (-40.0, 40.0)},
    "piezo-step": {"piezo": (0.0, 40.0)},
    "hybrid-excitation": {"tec": (-0.08, 0.08), "piezo": (-30.0, 30.0)},
}


class TestPlan:
    @cases(("protocol", "steps", "seconds", "watched"), DEFAULTS)
    def test_as_they_are(self, files, protocol, steps, seconds, watched):
        settings = {"model": files["hybrid"]} if protocol in ("hybrid-control", "fine-step") else {}
        expected = planned(protocol, **settings)
        assert expected.steps == steps
        # A tip that rests far from the beginning of the reference is moved there first.
        approach = APPROACH if protocol == "hybrid-control" else 0.0
        assert expected.seconds == expected.at_most - approach == pytest.approx(seconds, rel=1e-9)
        assert expected.watched == watched
        assert expected.prompts == 0
        assert expected.extremes == EXTREMES.get(protocol, {})

    @cases("protocol", [entry[0] for entry in DEFAULTS])
    @cases("rig", [PLAIN, WITNESSED])
    def test_both_rigs_have_what_they_need(self, files, rig, protocol):
        settings = {"model": files["hybrid"]} if protocol in ("hybrid-control", "fine-step") else {}
        definition, parameters = parsed(protocol, settings)
        with Rig(load_rig(rig), VirtualClock(), 1) as connected:
            slots = connected.description.slots(definition)
            check_before_moving(connected.description, definition, plan(definition, parameters, slots))
            assert definition.controlled(slots) in ("", DEFLECTION)

    @cases("protocol", ["hybrid-control", "fine-step"])
    def test_a_witness_only_where_there_is_one(self, files, protocol):
        settings = {"model": files["hybrid"], "witness": True}
        expected = planned(protocol, WITNESSED, **settings)
        assert WITNESS in expected.watched
        with Rig(load_rig(WITNESSED), VirtualClock(), 1) as rig:
            check_before_moving(rig.description, find_protocol(protocol), expected)
        with pytest.raises(ConfigurationError, match=r"witness: the rig binds no \[roles\.witness\]"):
            planned(protocol, PLAIN, **settings)


class TestSetpoints:
    @cases("protocol", ["current-sine", "current-steps", "piezo-loops", "piezo-step", "hybrid-excitation"])
    def test_stay_within_what_the_rig_allows(self, protocol):
        for loop in loops(protocol):
            for k, actuator in enumerate(loop.actuators):
                _, values = setpoints(loop, k)
                assert 0.0 < np.abs(values).max() <= LIMITS[actuator]

    def test_sines_of_the_current(self):
        found = loops("current-sine", amplitude=0.02, frequencies="0.002, 0.01", periods=3)
        assert [loop.label for loop in found] == ["0.002 Hz", "0.01 Hz"]
        for loop, frequency in zip(found, (0.002, 0.01), strict=True):
            times, values = setpoints(loop)
            assert times.size == round(3 / frequency * 0.5)
            np.testing.assert_allclose(values, 0.02 * np.sin(2 * np.pi * frequency * times), atol=1e-15)
            assert loop.actuators == ("tec",)

    def test_steps_of_the_current(self):
        (loop,) = loops("current-steps")
        times, values = setpoints(loop)
        for k, level in enumerate((-0.1, -0.05, -0.025, 0.1)):
            assert set(values[(times >= 1500 * k) & (times < 1500 * k + 600)]) == {level}
            assert set(values[(times >= 1500 * k + 600) & (times < 1500 * (k + 1))]) == {0.0}
        # Even if the last sample comes late.
        assert loop.controller.update(loop.duration + 1.0, ()) == (0.1,)

    def test_staircase_of_the_current(self):
        steps = [message for message in dry("thermomechanical") if isinstance(message, Step)]
        currents = np.array([step.setpoints["tec"] for step in steps])
        assert (currents[0], currents.min(), currents.max(), currents[-1]) == (0.0, -0.15, 0.1, 0.0)
        # Down, up and back, and none twice in a row.
        assert np.array_equal(np.flatnonzero(np.diff(np.sign(np.diff(currents)))) + 1, [8, 25])
        assert np.all(np.diff(currents) != 0)
        assert {step.label for step in steps} == {"sample"}
        assert {step.settle.seconds for step in steps} == {240.0}

    def test_loops_of_the_voltage(self):
        (loop,) = loops("piezo-loops")
        times, values = setpoints(loop)
        assert loop.actuators == ("piezo",)
        for k, amplitude in enumerate((40.0, 40.0, 30.0, 20.0, 10.0)):
            cycle = values[(times >= 10.0 * k - 1e-9) & (times < 10.0 * (k + 1) - 1e-9)]
            assert cycle.size == 500
            assert (cycle.min(), cycle.max()) == pytest.approx((-amplitude, amplitude), rel=1e-6)
            assert abs(cycle[0]) < 1e-9
        assert np.abs(np.diff(values)).max() < 40.0 * 2 * math.pi * 0.1 / 50.0 * 1.01


class TestReferences:
    def moves(self, **settings):
        return moves_of(parsed("hybrid-control", {"model": "m.json", **settings})[1])

    def test_moves_hold_at_each_position(self):
        moves = self.moves(positions="60e-6, -50e-6, 10e-6", speed=5e-6, hold=20)
        times = np.linspace(0.0, moves.duration, 20_001)
        positions = np.array([moves(t) for t in times])
        assert (moves(0.0), positions[-1]) == (0.0, pytest.approx(10e-6))
        assert (positions.min(), positions.max()) == (pytest.approx(-50e-6), pytest.approx(60e-6))
        held = np.append(False, np.diff(positions) == 0.0)
        assert set(np.round(positions[held] / MICRO, 6)) == {60.0, -50.0, 10.0}
        assert np.abs(np.diff(positions)).max() <= 5e-6 * np.diff(times).max() * 1.001

    def test_a_sine_is_on_top_of_the_ramp(self, files):
        settings = {"model": files["hybrid"], "low": -10e-6, "high": 10e-6, "hold": 2}
        (plain,) = loops("hybrid-control", reference="ramp", **settings)
        (added,) = loops("hybrid-control", reference="sine-on-ramp", amplitude=2e-6, frequency=1.0, **settings)
        assert added.duration == plain.duration
        moves = self.moves(reference="sine-on-ramp", low=-10e-6, high=10e-6, hold=2)
        assert plain.duration == pytest.approx(REST + moves.duration)
        rest = (0.0, 22.0, 22.0)
        off = []
        for k in range(4000):
            t = k / plain.rate
            plain.controller.update(t, rest)
            added.controller.update(t, rest)
            off.append(added.controller.trace.reference - plain.controller.trace.reference)
        # It swells within two periods.
        assert np.max(np.abs(off[:100])) < 1e-6
        assert np.max(np.abs(off[600:])) == pytest.approx(2e-6, rel=1e-3)

    def test_the_reference_rests_at_first(self, files):
        (loop,) = loops("hybrid-control", model=files["hybrid"], positions="30e-6")
        for t in (0.0, 2.0, 4.9):
            loop.controller.update(t, (0.0, 22.0, 22.0))
            assert loop.controller.trace.reference == 0.0
        loop.controller.update(12.0, (0.0, 22.0, 22.0))
        assert loop.controller.trace.reference > 1e-6

    @cases(
        ("name", "kind"),
        [
            ("hybrid", HybridController),
            ("hybrid-low-pass", HybridController),
            ("thermal-feedback", ThermalFeedback),
            ("open-loop", OpenLoopHybrid),
        ],
    )
    def test_each_controller(self, files, name, kind):
        (loop,) = loops("hybrid-control", model=files["hybrid"], controller=name)
        assert isinstance(loop.controller, kind)
        assert loop.record_every == 4
        current, voltage = loop.controller.update(0.0, (0.0, 22.0, 22.0))
        assert abs(current) <= 0.15
        assert abs(voltage) <= 40.0
        assert (voltage == 0.0) or name != "thermal-feedback"

    @cases(("error", "said"), [(0.7e-6, []), (0.75e-6, [Caution])])
    def test_an_open_loop_that_errs_is_warned_of(self, files, error, said):
        settings = {"model": files["hybrid"], "controller": "open-loop", "reference": "hold"}
        definition, parameters = parsed("hybrid-control", settings)
        messages = definition.start(parameters, slots_of("hybrid-control"))
        loop = next(message for message in messages if isinstance(message, FixedRate))
        for k in range(round(30.0 * loop.rate)):
            loop.controller.update(k / loop.rate, (error if k else 0.0, 22.0, 22.0))
        assert [type(message) for message in messages] == said

    @cases(("rate", "record_rate", "every"), [(200, 200, 1), (200, 1000, 1), (100, 3, 33)])
    def test_as_many_samples_as_wanted_are_recorded(self, files, rate, record_rate, every):
        (loop,) = loops("hybrid-control", model=files["hybrid"], rate=rate, record_rate=record_rate)
        assert loop.record_every == every


class TestRefused:
    @cases(
        ("protocol", "settings", "words"),
        [
            ("current-sine", {"frequencies": ""}, "= '' is not allowed"),
            ("current-sine", {"frequencies": "0.06"}, "parameter frequencies: 0.06 Hz is not allowed"),
            ("current-sine", {"frequencies": "0.001, -0.001"}, "parameter frequencies: -0.001 Hz is not allowed"),
            ("hybrid-control", {"controller": "magic"}, "controller = 'magic' is not allowed"),
            ("hybrid-control", {"reference": "circle"}, "reference = 'circle' is not allowed"),
            ("hybrid-control", {"positions": "5e-6, -2e-4"}, "positions: -0.0002 m is not allowed"),
            ("hybrid-control", {"low": "-2e-4"}, "parameter low: -0.0002 m is not allowed"),
            *(
                (
                    "hybrid-control",
                    {"reference": reference, "low": "1e-6", "high": "1e-6"},
                    "parameter low = 1e-06 m is not allowed with high = 1e-06 m; allowed: low < high",
                )
                for reference in ("staircase", "ramp", "sine-on-ramp")
            ),
            ("hybrid-control", {"amplitude": "1e-5"}, "amplitude = 1e-05 m is not allowed"),
            ("fine-step", {"step": "8.9e-6"}, "step = 8.9e-06 m is not allowed; allowed: -8.55e-06 to 8.55e-06"),
            ("fine-step", {"step": "-8.9e-6"}, "step = -8.9e-06 m is not allowed; allowed: -8.55e-06 to 8.55e-06"),
        ],
    )
    def test_what_is_wrong_is_one_message_before_anything_moves(self, files, protocol, settings, words):
        if protocol in ("hybrid-control", "fine-step"):
            settings = {"model": files["hybrid"], **settings}
        with pytest.raises(ConfigurationError) as caught:
            planned(protocol, **settings)
        (line,) = str(caught.value).splitlines()
        assert line.startswith(f"protocol {protocol}: ")
        assert words in line

    @cases("protocol", ["hybrid-control", "fine-step"])
    @cases(
        ("name", "words"),
        [
            ("none", "cannot be read: No such file"),
            ("damaged", "damaged"),
            ("other", "expected a model of the kind 'hybrid', got 'polynomial'"),
        ],
    )
    def test_a_model_that_cannot_be_used(self, files, protocol, name, words):
        with pytest.raises(DataError, match=words) as caught:
            planned(protocol, model=files[name])
        assert str(files[name]) in str(caught.value)

    @cases("protocol", ["hybrid-control", "fine-step"])
    def test_a_model_must_be_given(self, protocol):
        with pytest.raises(ConfigurationError, match=f"protocol {protocol}: parameter model is missing"):
            planned(protocol)

    def test_a_staircase_beyond_the_rig_s_limits_is_found_before_anything_moves(self, bench, tmp_path):
        code, _, err = bench(
            "run", "thermomechanical", "--rig", PLAIN, "--clock", "virtual", "--set", "hottest=0.2", "--out", tmp_path
        )
        assert code == 2
        assert "would set tec to between -0.15 and 0.2 A; rig hybrid allows -0.15 to 0.15 A" in flat(err)
        assert not list(tmp_path.iterdir())


def flat(text):
    return re.sub(r"\s+", " ", text)


def record(folder, protocol, rig, overrides=None, **settings):
    run = Run(
        protocol=find_protocol(protocol),
        settings={key: str(value) for key, value in settings.items()},
        rig=rig,
        folder=folder,
        overrides=overrides or {},
        seed=1,
        clock="virtual",
        recording=False,
    )
    result = carry_out(run, Console(file=io.StringIO(), width=200))
    assert result.outcome.status == "completed", result.outcome.reason
    assert result.outcome.is_safe
    return result.folder


class TestRuns:
    def test_a_slow_loop_keeps_the_watchdogs_fed(self, tmp_path):
        """Ten seconds from sample to sample, where five without a word switch everything off."""
        run = record(tmp_path, "current-sine", PLAIN, rate=0.1, frequencies="0.01")
        samples = read_loops(run)["0.01 Hz"]
        assert len(samples.times) == 20
        assert samples.period == pytest.approx(10.0)
        with Record(run) as found:
            # A reading by wire takes some milliseconds.
            assert np.diff(found.telemetry()["t"]).max() <= 2.01

    def test_control(self, files, tmp_path):
        settings = {"positions": "4e-6", "hold": 8, "controller": "hybrid", "model": files["hybrid"]}
        run = record(tmp_path, "hybrid-control", PLAIN, **settings)
        samples = read_loop(run)
        assert samples.period == pytest.approx(0.02)
        assert samples["reference"][0] == 0.0
        assert samples["reference"][-1] == pytest.approx(4e-6)
        for actuator, limit in LIMITS.items():
            assert np.abs(samples[f"{actuator}_setpoint"]).max() <= limit
        errors = np.abs(samples[DEFLECTION] - samples["reference"])
        # With noise of the sensor; the model is made up, and feedback makes up for it.
        assert errors[samples.times > 12.0].max() < 100e-9

    def test_a_warm_room_is_left_by_a_smooth_move(self, files, tmp_path):
        """A room of 24 °C bends the cantilever by 15 µm, more than the piezo part can take back."""
        settings = {"reference": "hold", "hold": 5, "model": files["hybrid"], "witness": True}
        run = record(tmp_path, "hybrid-control", WITNESSED, {"emulation.ambient": "24"}, **settings)
        samples = read_loop(run)
        assert samples[WITNESS][0] == pytest.approx(samples["reference"][0], abs=100e-9)
        assert abs(samples["reference"][0]) > 10e-6
        assert samples["reference"][-1] == 0.0
        # At the beginning of the reference everything else follows, as late as the approach is long.
        approach = abs(samples["reference"][0]) / 3e-6 + 10.0
        assert samples.times[-1] == pytest.approx(REST + 10.0 + 5.0 + approach, abs=0.1)
        # The model is made up; with a measured one it is 20 nm.
        assert np.abs(samples[WITNESS] - samples["reference"]).max() < 500e-9

    @pytest.mark.parametrize(("known", "status"), [("0", "failed"), ("0.02", "completed")])
    def test_a_lateness_that_the_controller_does_not_know_ends_the_run(self, files, tmp_path, known, status):
        run = Run(
            protocol=find_protocol("hybrid-control"), rig=PLAIN, seed=1,
            settings={"model": str(files["hybrid"]), "reference": "hold", "hold": "1", "lateness": known},
            overrides={"emulation.displacement_sensor.latency": "0.02"}, folder=tmp_path, clock="virtual",
            recording=False,
        )  # fmt: skip
        outcome = carry_out(run, Console(file=io.StringIO(), width=200)).outcome
        assert (outcome.status, outcome.is_safe) == (status, True)
        if status == "failed":
            assert "the deflection answers the piezo part 20 ms late" in outcome.reason

    def test_a_fine_step_with_a_sensor_that_is_late_ends_with_a_message(self, files, tmp_path):
        run = Run(
            protocol=find_protocol("fine-step"), settings={"model": str(files["hybrid"])}, rig=PLAIN, seed=1,
            overrides={"emulation.displacement_sensor.lag": "1e-3"}, folder=tmp_path, clock="virtual",
            recording=False,
        )  # fmt: skip
        outcome = carry_out(run, Console(file=io.StringIO(), width=200)).outcome
        assert (outcome.status, outcome.is_safe) == ("failed", True)
        assert isinstance(outcome.error, ConvergenceError)
        assert "the sensor lags or the line delays" in outcome.reason

    def test_a_fine_step_has_every_sample(self, files, tmp_path):
        step = -3e-6
        run = record(tmp_path, "fine-step", WITNESSED, model=files["hybrid"], step=step, witness=True)
        samples = read_loop(run)
        assert len(samples.times) == 5000
        assert samples.period == pytest.approx(50e-6, rel=1e-9)
        assert not samples["lateness"].any()
        assert samples["reference"].tolist() == [0.0] * 1000 + [step] * 4000
        assert np.abs(samples[WITNESS][-1000:] - step).max() < 0.02 * abs(step)
        with Record(run) as found:
            (text,) = [event.text for event in found.events() if event.kind == "loop"]
        assert text == "5000 samples at 20000 Hz, 0 left out; late by 0 ms on average, 0 ms at most"


class TestBadInput:
    """What may go wrong at a specimen: one message, the right exit code, no current and no voltage, and a record."""

    TIME = 12.3

    FAULTS = (
        ("open-thermistor", ["base: thermistor open", "AIN1", "a wire is broken or not connected"]),
        ("tec-over-current", ["tec: error 100 (over-current", "check the Peltier element and its cables"]),
        ("amplifier-trips", ["piezo: the amplifier went off by itself", "its own protection has tripped"]),
    )

    @pytest.fixture
    def laboratories(self, monkeypatch):
        """The laboratories that are opened, to look at the plant itself when the run is over."""
        opened, really_open = [], HybridLaboratory.open

        def remember(laboratory):
            opened.append(laboratory)
            return really_open(laboratory)

        monkeypatch.setattr(HybridLaboratory, "open", remember)
        return opened

    @pytest.mark.parametrize(("fault", "words"), FAULTS)
    def test_ends_the_run_in_the_safe_state(self, bench, laboratories, tmp_path, fault, words):
        code, _, err = bench(
            "run", "hybrid-excitation", "--rig", PLAIN, "--clock", "virtual", "--out", tmp_path,
            "--json", tmp_path / "run.json",
            *assignments("--set", {"duration": 60, "rate": 20}),
            *assignments("--override", {"emulation.fault": fault, "emulation.fault_time": self.TIME}),
        )  # fmt: skip
        assert code == 4
        assert err.count("error:") == 1
        assert "Traceback" not in err
        device = words[0].partition(":")[0]
        for word in words:
            assert word in flat(err)
        assert f"error: {device}: " in flat(err)

        result = json.loads((tmp_path / "run.json").read_text())
        assert result["status"] == "failed"
        assert result["is_safe"]
        assert result["safe_state"] == dict.fromkeys(DEVICES, "safe")

        # In the plant itself; it takes its commands every 10 ms.
        (laboratory,) = laboratories
        laboratory.world.clock.sleep(0.02)
        laboratory.world.advance()
        assert laboratory.plant.current == 0.0
        assert laboratory.plant.piezo_voltage == 0.0
        assert not laboratory.amplifier.on
        assert laboratory.t7.tdac_volts(0) == 0.0
        assert not laboratory.t7.dio_level(ENABLE_LINE, pulled_down=True)

        with Record(Path(result["folder"])) as found:
            assert found.status == "failed"
            assert flat(found.meta["reason"]) in flat(err)
            assert found.meta["safe_state"] == dict.fromkeys(DEVICES, "safe")
            events, ticks = found.events(), found.telemetry()
        # Everything before is kept, up to the sample before what happened, or the tick that saw it.
        taken = np.isfinite(ticks["lateness"])
        assert self.TIME - 0.06 <= ticks["t"][taken][-1] <= self.TIME + 2.1
        assert len(ticks["t"][taken]) >= 20 * (self.TIME - 0.1)
        assert np.abs(ticks["piezo_setpoint"][taken]).max() > 25.0
        assert ticks["tec_setpoint"][taken][-1] > 5e-3
        for name in (DEFLECTION, BASE, TIP):
            assert np.all(np.isfinite(ticks[name]))
        assert [event.text for event in events if event.kind == "safe-state"] == [f"{name}: safe" for name in DEVICES]
        (trouble,) = (event for event in events if event.level == "ERROR")
        assert trouble.kind == "error"
        assert self.TIME <= trouble.t <= self.TIME + 2.1
