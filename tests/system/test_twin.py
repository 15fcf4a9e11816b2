"""A twin of a specimen: what is identified from runs, and what the twin then does."""

import json
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases import cases

import bench
from bench.analysis import TransientRecording, identify_actuator
from bench.base import ConfigurationError, DataError
from bench.cli import main
from bench.identification import load_model
from bench.models import ActuatorDynamics, PrandtlIshlinskii
from bench.models.kernels import actuator_kernels as _kernels
from bench.record import Record
from bench.rig import load_rig
from bench.specimen import Specimen, write_twin
from bench.specimen.disturbances import identify_disturbances, noise_of
from bench.specimen.hysteresis import run_of_model
from bench.specimen.specimen import Dynamics, Unevenness, Wander
from sim_devices.twin_laboratory import SpecimenPlant

pytestmark = pytest.mark.slow

CREEP = {"hot": 70.0, "cool": 50.0, "duration": 60.0}


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Short runs on the emulated cantilever, which is built differently from any twin."""
    folder = tmp_path_factory.mktemp("measured")
    creep = bench.run("creep", "vo2", out=folder, seed=1, **CREEP)
    loops = bench.run("damped-oscillation", "vo2", out=folder, seed=1, increment=4.0, half_cycles=8)
    return creep.folder, loops.folder


@pytest.fixture(scope="module")
def model(measured, tmp_path_factory):
    """Its model, identified from the loops."""
    path = tmp_path_factory.mktemp("model") / "model.json"
    identified = bench.identify(bench.load(measured[1]), "preisach-nonmonotonic", levels=12, plane=(30.0, 70.0))
    identified.file.save(path)
    return path


@pytest.fixture(scope="module")
def twin(measured, model, tmp_path_factory):
    """Its twin, made by the command, and what the command wrote for programs."""
    folder = tmp_path_factory.mktemp("twin")
    out, found = folder / "twin.toml", folder / "twin.json"
    options = ["--rig", "vo2", "--model", str(model), "--out", str(out), "--json", str(found)]
    with pytest.raises(SystemExit) as stopped:
        main(["model", "twin", *map(str, measured), *options])
    assert not stopped.value.code
    return out, json.loads(found.read_text())


@pytest.mark.seeds
def test_the_model_is_from_the_run_that_sweeps_the_drive(tmp_path):
    """The hold has more steps than the sweep, and says nothing of any other set-point."""
    creep = bench.run("creep", "hybrid", out=tmp_path, seed=1, interval=0.4, duration=24.0)
    loops = bench.run("damped-oscillation", "hybrid", out=tmp_path, seed=1, half_cycles=4)
    assert len(creep.readings) > len(loops.readings)
    twin = write_twin([creep.folder, loops.folder], "hybrid", tmp_path / "twin.toml")
    assert twin.response.rms < 0.03 * np.ptp(loops.readings[twin.recordings[0].response])
    assert twin.warnings == ()


def test_a_short_run_makes_a_twin_and_warnings(tmp_path):
    run = bench.run("damped-oscillation", "vo2", out=tmp_path, seed=1, increment=8.0, half_cycles=3, dwell=2.0)
    twin = write_twin([run.folder], "vo2", tmp_path / "twin.toml")
    few, *_, history, still = twin.warnings
    count = len(run.readings)
    assert f"{run.folder.name}, whose readings determine only {count} of the 211 numbers" in few
    assert "add a run that sweeps the drive up and down in small increments, such as damped-oscillation" in few
    assert "add a run of random-validation" in history
    assert "noise of the response, wander, drift: not known, and taken as 0" in still
    assert "add a run of creep" in still
    load_rig(str(tmp_path / "twin.toml"))


def test_a_model_that_describes_the_response_worse_than_a_constant_is_refused(measured, model, tmp_path):
    right = load_model(model)
    operator = right.operator.with_coefficients(-right.operator.coefficients, right.operator.bias)
    wrong = replace(right, model=operator)
    wrong.save(tmp_path / "wrong.json")
    message = (
        r"model wrong\.json is off by .* 1/m RMS, where the response has a range of .* or give a model by --model"
    )
    with pytest.raises(DataError, match=message) as error:
        write_twin(measured, "vo2", tmp_path / "twin.toml", tmp_path / "wrong.json")
    assert len(str(error.value).splitlines()) == 1
    assert not (tmp_path / "twin.toml").exists()


def test_the_dynamics_of_the_plate_are_found(twin):
    """The emulated plate has 2.2 rad/s, a damping of 0.9 and 15 K/s, on a grid of 0.05 s."""
    assert twin[1]["warnings"] == []
    actuator = twin[1]["actuator"]
    assert actuator["order"] == 2
    assert actuator["frequency"] == pytest.approx(2.2, rel=0.1)
    assert actuator["damping"] == pytest.approx(0.9, rel=0.1)
    assert actuator["rate"] == pytest.approx(15.0, rel=0.1)


def test_the_twin_is_the_rig_with_emulated_devices(twin):
    rig, real = load_rig(str(twin[0])), load_rig("vo2")
    assert rig.in_process
    assert (rig.roles, rig.interlocks, rig.telemetry, rig.derived) == (
        real.roles, real.interlocks, real.telemetry, real.derived
    )  # fmt: skip
    with bench.open_rig(str(twin[0])) as emulated, bench.open_rig("vo2") as original:
        assert emulated.signals == original.signals
        assert emulated.description.limits == original.description.limits


def test_a_run_on_the_twin_is_as_long_and_goes_as_on_the_specimen(twin, measured, tmp_path):
    found = bench.run("creep", twin[0], out=tmp_path, seed=5, **CREEP)
    with Record(measured[0]) as record:
        real = record.steps()
    emulated = found.readings
    assert len(emulated) == len(real)
    assert emulated["finished"][-1] == pytest.approx(real["finished"][-1], rel=0.02)
    moving = np.abs(np.diff(real["tec_temperature"], prepend=0.0)) > 1.0
    late = ~moving
    assert np.abs(emulated["tec_temperature"] - real["tec_temperature"])[late].max() < 1.0
    span = np.ptp(real["curvature"])
    assert np.sqrt(np.mean((emulated["curvature"] - real["curvature"])[late] ** 2)) < 0.05 * span


def test_what_lines_take_is_not_in_the_delay_as_well(twin):
    """The set-point is sent within a part of what was identified, and the detector is read behind the drive."""
    path, found = twin
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    tec, psd = content["devices"]["tec"], content["devices"]["psd"]
    assert min(tec["setpoint_time"], psd["quick_time"]) > 0.0
    delay = content["emulation"]["drive"]["delay"]
    assert delay + tec["setpoint_time"] + psd["quick_time"] == pytest.approx(found["actuator"]["delay"], abs=1e-4)


def test_equal_seeds_give_equal_sessions(twin, tmp_path):
    first, again, other = (
        bench.run("creep", twin[0], out=tmp_path, seed=seed, hot=60.0, duration=8.0).readings["curvature"]
        for seed in (3, 3, 4)
    )
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_a_run_under_control_is_rehearsed_on_the_twin(twin, model, tmp_path):
    found = tmp_path / "rehearsal.json"
    settings = [f"--set=model={model}", "--set=count=2"]
    with pytest.raises(SystemExit) as stopped:
        main(["rehearse", "tracking", "--rig", str(twin[0]), "--seed", "7", "--json", str(found), *settings])
    assert not stopped.value.code
    run = bench.run("tracking", twin[0], out=tmp_path, seed=7, model=str(model), count=2)
    assert json.loads(found.read_text())["seconds"] == pytest.approx(run.readings["finished"][-1], rel=0.02)


@pytest.mark.parametrize(
    ("rig", "out", "message"),
    [
        ("sma", "new.toml", "is a run of rig vo2, with the devices tec, psd; rig sma has supply"),
        ("vo2", "old.toml", "exists already"),
        ("vo2", "new.json", "ends in .toml"),
        ("vo2", "none/new.toml", "cannot be written"),
    ],
)
def test_a_wrong_command_is_one_message(measured, tmp_path, rig, out, message):
    (tmp_path / "old.toml").write_text("")
    with pytest.raises((ConfigurationError, DataError), match=message) as error:
        write_twin(measured[1:], rig, tmp_path / out)
    assert len(str(error.value).splitlines()) == 1


def test_a_run_that_says_too_little_is_refused(tmp_path):
    (tmp_path / "look.py").write_text(
        '"""Looks."""\n'
        "from bench.devices import Actuator\n"
        "from bench.protocol import Dwell, Messages, ProtocolParameters, Slots, Step, protocol\n\n\n"
        "class Parameters(ProtocolParameters):\n"
        '    """None."""\n\n\n'
        '@protocol(needs={"drive": Actuator})\n'
        "def look(parameters: Parameters, slots: Slots) -> Messages:\n"
        '    """Look."""\n'
        "    for _ in range(30):\n"
        "        yield Step({}, Dwell(1.0))\n"
    )
    run = bench.run(str(tmp_path / "look.py"), "vo2", out=tmp_path).folder
    with pytest.raises(DataError, match="does not change, so that there is no transient"):
        write_twin([run], "vo2", tmp_path / "twin.toml")
    with pytest.raises(DataError, match="is not a run"):
        write_twin([tmp_path], "vo2", tmp_path / "twin.toml")


def recording_of(dynamics, noise=0.0):
    """A recording of an actuator that makes ten steps, read each 0.5 s."""
    rng = np.random.default_rng(1)
    changes, setpoints = 10.0 * np.arange(1, 11), rng.uniform(-5.0, 5.0, 10)
    times = np.arange(0.0, 110.0, 0.5)
    grid = 0.001
    out = np.empty((2, int(110.0 / grid)))
    levels = np.concatenate([[0.0], setpoints])
    held = levels[np.searchsorted(changes + dynamics.delay, grid * np.arange(out.shape[1]), side="right")]
    _kernels.follow(
        np.zeros(_kernels.STATE_SIZE), held, np.zeros((2, held.size)), out, grid, dynamics.frequency,
        dynamics.damping, dynamics.rate, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0,
    )  # fmt: skip
    drive = np.interp(times, grid * np.arange(1, held.size + 1), out[0], left=0.0) + noise * rng.standard_normal(
        times.size
    )
    return recording_from(times, drive, changes, setpoints)


def recording_from(times, drive, changes, setpoints):
    """A recording of a drive, read at some times."""
    return TransientRecording(
        path=Path("run"), meta={}, signals=(), steps=(), times=times, is_reading=np.ones(times.size, dtype=bool),
        columns={"drive": drive, "response": drive}, changes=changes, setpoints=setpoints, drive="drive",
        response="response", ticks=(np.empty(0), np.empty(0)),
    )  # fmt: skip


@cases(
    "dynamics",
    [
        ActuatorDynamics(delay=0.3, frequency=1.5),
        ActuatorDynamics(frequency=2.0, damping=0.4),
        ActuatorDynamics(frequency=3.0, damping=0.7, rate=1.5),
    ],
)
def test_the_order_of_an_actuator_is_found_with_its_numbers(dynamics):
    found = identify_actuator([recording_of(dynamics, 1e-3)]).dynamics
    assert found.order == dynamics.order
    assert found.delay == pytest.approx(dynamics.delay, abs=0.05)
    assert found.frequency == pytest.approx(dynamics.frequency, rel=0.05)
    assert found.damping == pytest.approx(dynamics.damping, rel=0.05)
    assert math.isinf(dynamics.rate) or found.rate == pytest.approx(dynamics.rate, rel=0.05)


def test_an_actuator_that_follows_at_once_has_no_delay():
    """Readings that are complete as the next set-point is sent saw the one before."""
    changes, setpoints = np.arange(1.0, 16.0) * 0.497, np.tile([1.0, 3.0, 2.0], 5)
    times = np.sort(np.concatenate([changes, changes + 0.05]))
    levels = np.concatenate([[0.0], setpoints])[np.searchsorted(changes, times)]
    found = identify_actuator([recording_from(times, levels, changes, setpoints)]).dynamics
    assert (found.order, found.delay) == (0, 0.0)


def test_a_sensor_that_reads_otherwise_from_run_to_run_is_no_dynamics():
    """Its gain differs by 0.15 %, far beyond its noise."""
    rng = np.random.default_rng(4)
    changes, setpoints = 3.0 + 0.581 * np.arange(80), rng.uniform(-40.0, 40.0, 80)
    times = np.concatenate([[0.0, 2.0], changes[1:], [changes[-1] + 0.581]])
    levels = np.concatenate([[-40.0, -40.0], setpoints])
    runs = [
        recording_from(times, gain * levels + rng.normal(0.0, 2e-3, times.size), changes, setpoints)
        for gain in (1.0015, 1.0015, 1.0)
    ]
    found = identify_actuator(runs)
    assert (found.dynamics.order, found.dynamics.delay) == (0, 0.0)
    assert found.rms == pytest.approx(2e-3, rel=0.1)


def test_the_run_of_the_model_is_not_that_of_the_most_readings():
    """What counts is how many histories of the drive were read, on the range of all runs."""

    def held(levels, readings):
        changes = 10.0 * np.arange(len(levels))
        times = np.sort(np.concatenate([changes + each for each in np.linspace(1.0, 9.0, readings)]))
        levels = np.array(levels, dtype=float)
        return recording_from(times, levels[np.searchsorted(changes, times) - 1], changes, levels)

    hold = held([0.0, 40.0, 20.0], 100)
    # A controller that makes small moves about its targets.
    control = held([target + 0.1 * move for target in (10.0, 20.0, 30.0) for move in range(40)], 1)
    sweep = held([*range(0, 41, 4), *range(36, -1, -4), *range(4, 33, 4)], 1)
    assert run_of_model([hold])[1] == 3
    # The second rise repeats the first.
    assert run_of_model([hold, control, sweep]) == (sweep, 20)
    assert run_of_model([hold, control])[0] is control
    assert run_of_model([hold, control])[1] < 12


def test_noise_is_what_readings_of_few_digits_scatter_by():
    """Between two digits a normal noise of a third of one; a quantile of differences is 0 or a whole digit."""
    rng = np.random.default_rng(8)
    times = 0.1 * np.arange(1, 4001)
    read = np.round(0.3 + rng.normal(0.0, 0.5, times.size))
    made = recording_from(times, read, np.array([0.0]), np.array([0.3]))
    assert noise_of([made], "drive", Dynamics(0.02)).reading == pytest.approx(0.5, rel=0.05)


def test_how_calls_divide_the_time_does_not_matter():
    play = PrandtlIshlinskii(np.array([0.0, 0.5]), np.array([1.0, 1.0]), input_range=(-2.0, 2.0))
    actuator = ActuatorDynamics(frequency=2.0, damping=0.7)
    dynamics = Dynamics(
        0.02,
        actuator,
        wander=Wander(deviation=0.01, time=1.0),
        unevenness=Unevenness(deviation=0.1, length=1.0),
        drift=0.01,
    )

    def ends(pieces):
        specimen = Specimen(play, dynamics, 0.0, np.random.default_rng(1))
        plant = SpecimenPlant(specimen, 0.0)
        for target in (1.0, -1.0):
            plant.set(target)
            for _ in range(pieces):
                plant.advance(4.0 / pieces)
        return specimen.drive, specimen.response

    assert ends(1) == pytest.approx(ends(7), rel=1e-12)


@cases(
    "real",
    [
        Dynamics(0.05, wander=Wander(deviation=0.02, time=20.0), drift=0.003),
        Dynamics(0.05, unevenness=Unevenness(deviation=0.05, length=2.0), drift=0.003),
        Dynamics(0.05),
    ],
)
def test_what_moves_a_response_is_found_again(real):
    """A specimen without hysteresis, of slope 2, that is set to 500 levels and read at each six times."""
    rng = np.random.default_rng(11)
    line = PrandtlIshlinskii(np.array([0.0]), np.array([2.0]), input_range=(0.0, 10.0))
    changes, setpoints = 6.0 * np.arange(500), rng.uniform(0.0, 10.0, 500)
    times = np.arange(1.0, 3000.0, 1.0)
    grid = 0.05 * np.arange(1, 60001)
    specimen = Specimen(line, real, float(setpoints[0]), rng)
    drive, response = specimen.advance(setpoints[np.searchsorted(changes, grid - 1e-9, side="right") - 1])
    rows = np.searchsorted(grid, times - 1e-9)
    made = replace(
        recording_from(times, drive[rows], changes, setpoints),
        columns={"drive": drive[rows], "response": response[rows] + rng.normal(0.0, 0.01, times.size)},
    )
    errors = made.responded - line.evaluate(made.setpoints)[made.last_change]
    noise, found = identify_disturbances([made], [errors], line, Dynamics(0.05))
    assert noise.reading == pytest.approx(0.01, rel=0.1)
    assert found.drift == pytest.approx(real.drift, rel=0.3, abs=1e-4)
    # By how much they change within some time, and on some way.
    for seconds in (1.0, 10.0):
        moved, wanted = (
            w.deviation * math.sqrt(1.0 - math.exp(-seconds / w.time)) for w in (found.wander, real.wander)
        )
        assert moved == pytest.approx(wanted, rel=0.25, abs=5e-4)
    for way in (0.5, 5.0):
        moved, wanted = (
            u.deviation * math.sqrt(1.0 - math.exp(-way / u.length)) for u in (found.unevenness, real.unevenness)
        )
        assert moved == pytest.approx(wanted, rel=0.25, abs=5e-4)
