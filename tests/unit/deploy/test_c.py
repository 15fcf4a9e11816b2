"""Exported C beside the models in Python, and what the compilers say of it."""

import re

import numpy as np
import pytest
from deployed import (
    RANDOM,
    STRICT,
    Compiled,
    differences,
    instructions,
    plane,
    probes_of,
    random_sequence,
    run,
    shrinking,
)

from bench.base import ConfigurationError, DataError
from bench.deployment import deploy
from bench.identification import ModelFile
from bench.models import (
    Hammerstein,
    Linear,
    LinearPart,
    Polynomial,
    Preisach,
    RateDependentPlays,
    Summed,
    TwoStage,
    logarithmic_creep,
    uniform_levels,
)

FAMILIES = list(RANDOM)


def _file(family, seed):
    model = RANDOM[family](np.random.default_rng(seed))
    low, high = model.input_range
    memory = model.advance(model.initial_state(), random_sequence(low, high, 100, seed))
    return ModelFile(family, model, memory)


def _compare(family, seed, real, folder, compiler):
    file = _file(family, seed)
    operator = file.operator
    least, greatest = operator.output_range()
    beyond = 0.05 * (greatest - least)
    inputs = random_sequence(*operator.input_range, 1000, seed, real)
    targets = random_sequence(least - beyond, greatest + beyond, 20, seed + 1, real)
    compiled = Compiled(file, folder, real, compiler)
    assert compiled.size_of_state == compiled.deployment.state
    found = differences(operator, file.memory, compiled, inputs, targets, real)
    bound = 4.0 if real == "double" else 1e-5
    assert found.outputs <= bound
    assert found.setpoints <= bound
    assert found.disagreements == 0


@pytest.mark.parametrize("family", FAMILIES)
def test_steps_and_answers_are_those_of_python(family, gcc, tmp_path):
    _compare(family, 7, "double", tmp_path / "double", gcc)
    _compare(family, 8, "float", tmp_path / "float", gcc)


@pytest.mark.seeds
@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("seed", range(20, 26))
def test_steps_and_answers_are_those_of_python_for_more_models(family, seed, gcc, tmp_path):
    _compare(family, seed, "double", tmp_path / "double", gcc)
    _compare(family, seed, "float", tmp_path / "float", gcc)


def _stage(low, high, order, scale, bias):
    levels = uniform_levels(low, high, order)
    density = np.random.default_rng(order).exponential(1.0, order * (order + 1) // 2)
    density *= scale / (density @ Preisach(levels, density).cell_areas())
    return Preisach(levels, density, bias=bias)


FORCE, LENGTH = _stage(0.0, 10.0, 12, 3.0, 3.0), _stage(-6.0, 6.0, 9, 0.01, 0.0)
COUPLED = {
    "two-stage": TwoStage(FORCE, LENGTH, 1.0),
    "linear": Linear(0.5, 1.0, LENGTH, (0.0, 10.0), 1.0),
    "summed": Summed(LENGTH, _stage(0.0, 10.0, 8, 0.01, 0.01), 1.0),
}


@pytest.mark.parametrize(("kind", "real"), [*((kind, "double") for kind in COUPLED), ("two-stage", "float")])
def test_lengths_are_those_of_python_and_voltages_bring_the_length_to_its_target(kind, real, gcc, tmp_path):
    model = COUPLED[kind]
    compiled = Compiled(ModelFile(kind, model), tmp_path, real, gcc)
    voltages, forces = (random_sequence(0.0, end, 1000, seed, real) for end, seed in ((10.0, 1), (2.0, 2)))
    expected = model.evaluate(voltages, forces)
    bound = (1e-14 if real == "double" else 1e-5) * np.ptp(expected)
    assert np.abs(compiled.steps(voltages, forces) - expected).max() <= bound
    state = model.advance(voltages, forces)
    targets = random_sequence(expected.min(), expected.max(), 30, 3, real)
    answers = compiled.follow(targets, forces[:30])
    reached = model.evaluate(answers.setpoints, forces[:30], state)
    assert np.abs(answers.outputs - reached).max() <= bound
    met = answers.reach == 0
    assert met.sum() > 5
    assert np.abs(reached - targets)[met].max() <= 4.0 * bound


TIMES, STRENGTHS = logarithmic_creep(0.02, 0.1, 100.0)
LINEAR = {
    "lag": LinearPart(0.0, (0.1, 0.0)),
    "delay": LinearPart(0.035, (0.1, 0.0)),
    "whole delay": LinearPart(0.02, (0.1, 0.0)),
    "creep": LinearPart(0.0, (0.0, 0.0), TIMES, STRENGTHS),
    "all": LinearPart(0.004, (0.1, 0.0), TIMES, STRENGTHS),
    # In a period it moves by less than a float resolves.
    "slow creep": LinearPart(0.0, (0.1, 0.0), *logarithmic_creep(0.2, 1.0, 1e5)),
}


@pytest.mark.parametrize(
    ("kind", "real"), [*((kind, "double") for kind in LINEAR), ("all", "float"), ("slow creep", "float")]
)
def test_responses_of_a_linear_part_are_those_of_python(kind, real, gcc, tmp_path):
    model, period = Hammerstein(FORCE, LINEAR[kind]), 0.01
    compiled = Compiled(ModelFile(kind, model), tmp_path, real, gcc, period=period)
    assert compiled.size_of_state == compiled.deployment.state
    inputs = random_sequence(0.0, 10.0, 20_000, 1, real)
    inputs[1000:] = inputs[1000]
    times = period * np.arange(inputs.size)
    low, high = FORCE.output_range()
    bound = 4.0 * np.spacing(high) if real == "double" else 1e-5 * (high - low)
    assert np.abs(compiled.steps(inputs) - model.run(times, inputs)[0]).max() <= bound
    # A delay later the answers bring the output to the targets.
    compiled.init(1)
    targets = 3.0 + np.sin(3.0 * times[:200])
    answers = compiled.follow(targets)
    prompt, state = model.ahead(model.initial_state())
    assert np.abs(prompt.run(times[:200], answers.setpoints, state)[0] - targets).max() <= bound


def test_a_restored_state_goes_on_with_the_same_bytes(gcc, tmp_path):
    compiled = Compiled(_file("preisach, thermal", 3), tmp_path, "float", gcc)
    inputs = random_sequence(*_file("preisach, thermal", 3).operator.input_range, 400, 5, "float")
    compiled.steps(inputs[:200])
    saved = compiled.save()
    expected = compiled.steps(inputs[200:])
    after = compiled.save()
    compiled.init(3)
    assert compiled.restore(saved)
    assert compiled.steps(inputs[200:]).tobytes() == expected.tobytes()
    assert compiled.save() == after
    for damaged in (bytes([saved[0] ^ 1]) + saved[1:], saved[:40] + b"\x7f" + saved[41:], saved[:-1] + b"\x00"):
        if damaged != saved:
            assert not compiled.restore(damaged)
            assert compiled.save() == after


def test_each_start_is_that_of_the_model(gcc, tmp_path):
    file = _file("preisach, quadratic", 4)
    compiled, operator = Compiled(file, tmp_path, "double", gcc), file.operator
    states = [file.memory, operator.initial_state(), operator.saturated_state(-1), operator.saturated_state(1)]
    inputs = random_sequence(*operator.input_range, 50, 5)
    for start, state in enumerate(states):
        compiled.init(start)
        np.testing.assert_array_equal(compiled.steps(inputs), operator.evaluate(inputs, state))


def test_an_input_that_is_not_finite_moves_nothing(gcc, tmp_path):
    compiled = Compiled(_file("preisach", 4), tmp_path, "double", gcc)
    before = compiled.save()
    assert np.isnan(compiled.steps(np.array([np.nan, np.inf, -np.inf]))).all()
    assert compiled.save() == before
    assert compiled.follow(np.array([np.nan])).reach[0] == 2


def test_a_memory_without_room_keeps_the_output_and_errs_within_a_cell(gcc, tmp_path):
    model = plane(9)
    compiled = Compiled(ModelFile("plane", model), tmp_path, "double", gcc)
    inputs = np.array(shrinking(0.0, 10.0, 1000))
    scale = np.ptp(model.output_range())
    np.testing.assert_allclose(compiled.steps(inputs), model.evaluate(inputs), atol=1e-13 * scale)
    # On the way back the simplified corners are met; at the end none is left.
    back = np.linspace(5.0, 10.0, 200)
    expected = model.evaluate(np.concatenate([inputs, back]))[1000:]
    found = compiled.steps(back)
    assert np.abs(found - expected).max() <= 0.25 * 2.0 * (model.density * model.cell_areas()).max()
    assert found[-1] == pytest.approx(expected[-1], rel=1e-13)


def _bytes_of(objects):
    text, data = re.search(r"^\s*(\d+)\s+(\d+)", objects, re.MULTILINE).groups()
    return int(text) + int(data)


@pytest.mark.parametrize("family", ["preisach", *FAMILIES[6:]])
def test_a_cortex_compiler_takes_it_and_the_readme_bounds_its_code(family, arm_gcc, tmp_path):
    model = plane(41, family.partition(", ")[2]) if family.startswith("preisach") else _file(family, 5).operator
    for real in ("float", "double"):
        found = deploy(ModelFile(family, model), real=real)
        found.write(tmp_path)
        # What is the smaller for a plane of 40 levels; for the others once is enough.
        for optimized in ("-O2", "-Os") if family == "preisach" else ("-O2",):
            run([arm_gcc, "-mcpu=cortex-m4", "-mthumb", optimized, *STRICT, "-c", "model.c"], tmp_path)
            size = _bytes_of(run([arm_gcc.replace("gcc", "size"), "model.o"], tmp_path))
            assert size <= found.constants + found.code
        run([arm_gcc, "-mcpu=cortex-m4", *STRICT, "-c", "main.c"], tmp_path)
        if family.startswith("preisach") and real == "float":
            assert size <= 24_000
            assert found.state <= 1024


@pytest.mark.parametrize("family", ["preisach, thermal", "prandtl-ishlinskii", "bouc-wen"])
def test_clang_takes_it_and_no_sanitizer_complains(family, clang, gcc, tmp_path):
    file = _file(family, 9)
    low, high = file.operator.input_range
    deploy(file).write(tmp_path)
    run([clang, *STRICT, "-c", "model.c", "main.c"], tmp_path)
    inputs = ", ".join(f"{value!r}f" for value in random_sequence(low, high, 300, 2).tolist())
    main = (tmp_path / "main.c").read_text()
    loop = f"static const float inputs[] = {{{inputs}}}; unsigned i; for (i = 0; i < 300; ++i) {{"
    loop += " model_step(&state, inputs[i]); model_invert(&state, inputs[i]); }"
    (tmp_path / "main.c").write_text(main.replace("model_save(", loop + "\n    model_save(", 1))
    sanitized = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g"]
    run([gcc, "-std=c99", *sanitized, "main.c", "model.c", "-o", "example", "-lm"], tmp_path)
    assert "met" in run(["./example"], tmp_path)


@pytest.mark.parametrize(("kind", "most"), [("", 6000), ("thermal", 8000), ("signed", 8000)])
def test_steps_and_inverses_of_40_levels_are_bounded(kind, most, valgrind, gcc, tmp_path):
    model = plane(40, kind)
    deploy(ModelFile("plane", model)).write(tmp_path)
    probes = probes_of(model, 60, 3)
    counts = np.array(instructions(tmp_path, probes, valgrind))
    inverts = np.array([each.inverts for each in probes])
    assert 50 < counts[~inverts].max() <= 2000
    assert 500 < counts[inverts].max() <= most


def test_what_cannot_be_exported_says_why():
    def said(model, error=DataError, **options):
        with pytest.raises(error) as raised:
            deploy(ModelFile("mine", model), **options)
        return str(raised.value)

    assert "no memory" in said(Polynomial([1.0, 0.2], (0.0, 1.0)))
    assert "rate-dependent-plays" in said(RateDependentPlays([0.0], [0.1], [1.0], (0.0, 1.0)))
    assert "viscous" in said(Hammerstein(FORCE, LinearPart(), viscous=0.1), period=0.1)
    assert "falls" in said(TwoStage(Preisach([0.0, 1.0], [-1.0]), LENGTH))
    assert "--real double" in said(Preisach([0.0, 1.0], [1.0], bias=1e6))
    too_fine = said(plane(200), ConfigurationError, max_bytes=24_000)
    assert "--max-bytes 24000" in too_fine
    assert "fewer levels" in too_fine
    lag = Hammerstein(FORCE, LinearPart(0.0, (0.1, 0.0)))
    assert "at most 0.025 s" in said(lag, ConfigurationError, period=0.5)
    assert "--period" in said(lag, ConfigurationError)
    assert "no linear part" in said(FORCE, ConfigurationError, period=0.5)
    resonance = Hammerstein(FORCE, LinearPart(0.0, (0.05, 0.01)))
    assert "longer steps" in said(resonance, ConfigurationError, period=0.01)
    assert "--name" in said(FORCE, ConfigurationError, name="2nd")
