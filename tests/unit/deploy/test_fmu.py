"""Exported functional mock-up units, judged and simulated by FMPy."""

import numpy as np
import pytest
from deployed import plane, random_sequence
from fmpy import simulate_fmu
from fmpy.validation import validate_fmu

from bench.analysis import predict
from bench.base import ConfigurationError, json_text
from bench.deployment import write_fmu
from bench.identification import ModelFile
from bench.models import Hammerstein, LinearPart, TwoStage
from bench.specimen import Specimen, TwinTable
from sim_devices.plants.fmu import FMUPlant
from sim_devices.twin_laboratory import SpecimenPlant

STEP = 0.01
PLANE = ModelFile("plane", plane(20, "thermal"))


def _simulated(path, step=STEP, start_values=None, **inputs):
    count = len(next(iter(inputs.values())))
    rows = list(zip(step * np.arange(count), *inputs.values(), strict=True))
    signals = np.array(rows, dtype=[("time", float), *((name, float) for name in inputs)])
    result = simulate_fmu(
        str(path),
        stop_time=count * step,
        output_interval=step,
        step_size=step,
        start_values=start_values or {},
        input=signals,
        fmi_type="CoSimulation",
    )
    return {name: result[name][1 : count + 1] for name in result.dtype.names}


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_unit_is_valid_and_gives_what_the_bench_predicts(version, gcc, tmp_path):
    path, inputs = tmp_path / "plane.fmu", random_sequence(0.0, 10.0, 150, 1)
    write_fmu(PLANE, path, version=version)
    assert validate_fmu(str(path)) == []
    np.testing.assert_allclose(_simulated(path, u=inputs)["y"], predict(PLANE, inputs), rtol=1e-13)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_an_inverse_unit_gives_the_set_points_of_the_bench(version, gcc, tmp_path):
    path = tmp_path / "inverse.fmu"
    low, high = PLANE.operator.output_range()
    targets = random_sequence(low - 1.0, high + 1.0, 150, 1)
    write_fmu(PLANE, path, what="inverse", version=version)
    assert validate_fmu(str(path)) == []
    found, expected = _simulated(path, target=targets), PLANE.operator.inverse().follow(targets)
    np.testing.assert_allclose(found["u"], expected.setpoints, atol=1e-12)
    np.testing.assert_array_equal(found["reach"] == 0, expected.met)


def test_units_of_models_with_time_and_of_two_inputs(gcc, tmp_path):
    path, inputs = tmp_path / "model.fmu", random_sequence(0.0, 10.0, 100, 2)
    lagging = Hammerstein(PLANE.operator, LinearPart(0.015, (0.1, 0.0)))
    write_fmu(ModelFile("lag", lagging), path, version="3.0", period=STEP)
    assert validate_fmu(str(path)) == []
    expected, _ = lagging.run(STEP * np.arange(100), inputs)
    np.testing.assert_allclose(_simulated(path, u=inputs)["y"], expected, rtol=1e-11, atol=1e-11)
    muscle = TwoStage(plane(8), plane(12), 1.0)
    write_fmu(ModelFile("muscle", muscle), path)
    assert validate_fmu(str(path)) == []
    forces = np.repeat(random_sequence(0.0, 4.0, 10, 3), 10)
    found = _simulated(path, voltage=inputs, force=forces)["length"]
    np.testing.assert_allclose(found, muscle.evaluate(inputs, forces), rtol=1e-12)


def _twin(**noise):
    drive = {"device": "d", "signal": "u", "rest": 0.0, "delay": 0.05, "frequency": 4.0, "damping": 0.6, "rate": 20.0}
    response = {"signal": "y", "lag": 0.1, "power": 2.0, "gain": 0.9, "shares": (0.1,), "times": (3.0,)}
    return TwinTable(
        step=0.02,
        model=json_text(PLANE.operator.to_json()),
        drive=drive,
        response=response,
        **noise,
    )


def test_a_specimen_is_that_of_the_twin(gcc, tmp_path):
    twin, path = _twin(), tmp_path / "specimen.fmu"
    write_fmu(twin, path)
    assert validate_fmu(str(path)) == []
    plant = SpecimenPlant(Specimen(twin.operator, twin.dynamics, 0.0, np.random.default_rng(0)), 0.0)
    unit = FMUPlant(path, "u", ["y", "drive"], 0.02, 0.0)
    for setpoint in random_sequence(0.0, 10.0, 100, 4).tolist():
        for each in (plant, unit):
            each.set(setpoint)
            each.advance(0.1)
        assert unit.outputs == pytest.approx([plant.response, plant.drive], rel=1e-11)


def test_a_session_of_a_specimen_wanders_by_its_seed(gcc, tmp_path):
    twin, path = _twin(wander={"deviation": 0.1, "time": 1.0}), tmp_path / "specimen.fmu"
    write_fmu(twin, path, version="3.0")
    assert validate_fmu(str(path)) == []
    inputs = np.full(2000, 5.0)
    found = [_simulated(path, 0.02, start_values={"seed": seed}, u=inputs)["y"] for seed in (1, 1, 2)]
    np.testing.assert_array_equal(found[0], found[1])
    plant = Specimen(twin.operator, twin.dynamics, 0.0, np.random.default_rng(0))
    deviations = [np.std(each[500:]) for each in (*found[1:], plant.advance(inputs)[1])]
    assert found[2][-1] != found[1][-1]
    assert max(deviations) < 1.7 * min(deviations)


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_a_plant_does_not_depend_on_how_its_time_is_divided(version, gcc, tmp_path):
    path = tmp_path / "plane.fmu"
    write_fmu(PLANE, path, version=version)
    plants = [FMUPlant(path, "u", ["y"], STEP, 0.0) for _ in range(2)]
    for setpoint in (3.0, 8.0, 2.0):
        for plant, parts in zip(plants, (1, 7), strict=True):
            plant.set(setpoint)
            for _ in range(parts):
                plant.advance(0.21 / parts)
    assert plants[0].outputs == plants[1].outputs
    assert plants[0].outputs == pytest.approx([predict(PLANE, [3.0, 8.0, 2.0])[-1]], rel=1e-12)


def test_a_wrong_unit_is_refused(gcc, tmp_path):
    path = tmp_path / "plane.fmu"
    write_fmu(PLANE, path)
    with pytest.raises(ConfigurationError, match="there are: y"):
        FMUPlant(path, "u", ["z"], STEP, 0.0)
    with pytest.raises(ConfigurationError, match="there are: u"):
        FMUPlant(path, "y", ["y"], STEP, 0.0)
    path.write_bytes(b"no unit")
    with pytest.raises(ConfigurationError, match="cannot be read"):
        FMUPlant(path, "u", ["y"], STEP, 0.0)
    with pytest.raises(ConfigurationError, match="cannot be read"):
        FMUPlant(tmp_path / "none.fmu", "u", ["y"], STEP, 0.0)
