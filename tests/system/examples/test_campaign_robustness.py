"""The campaign of perturbed specimens can be carried out, and the part that takes a minute reaches its goals."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from bench.base import Workers
from bench.batch import WorkersExecutor, carry_out_tasks, expand, read_campaign
from bench.batch.campaign.file import axes, dotted
from bench.batch.campaign.tasks import ModelTask, RunTask

FILE = Path(__file__).parents[3] / "examples" / "campaign-robustness.toml"
PLANT = "emulation.plant"
NOMINAL = "{}"

OPEN, CLOSED = "open-loop-inverse", "closed-loop-inverse"
MINUTE = {
    "film": ({}, 1),
    "film-tracking": ({"controller": [OPEN, CLOSED], "count": 30}, 3),
    "wire": ({}, 1),
    "wire-length": ({"controller": CLOSED, "count": 20}, 3),
    "wire-force": ({"controller": CLOSED, "count": 20}, 3),
    "beam": ({}, 1),
    "beam-rooms": ({"controller": ["hybrid", "open-loop"]}, 2),
}
"""Parameters in place of those of the file, and the number of plants, by table."""


def first_of_each_axis(table, parameters=None, plants=1):
    overrides = {key: values[:plants] for key, values in axes(dotted(table.overrides)).items()}
    return table.model_copy(
        update={
            "overrides": overrides,
            "seeds": table.seeds[:1],
            "parameters": {**table.parameters, **(parameters or {})},
        }
    )


def with_tables(file, **tables):
    return replace(file, tables=file.tables.model_copy(update=tables))


def test_each_rig_has_its_model_and_each_controller_runs_with_it():
    file = read_campaign(FILE)
    tasks = expand(with_tables(file, runs=tuple(map(first_of_each_axis, file.tables.runs)))).tasks.values()
    models = {task.table: task for task in tasks if isinstance(task, ModelTask)}
    runs = {name: len(task.sources) for name, task in models.items()}
    assert runs == {"density": 1, "wire-model": 3, "braid-model": 3, "coil-model": 3, "beam-model": 4}
    used = [task for task in tasks if isinstance(task, RunTask) and task.models]
    assert {each for task in used for each in task.needs} == {task.name for task in models.values()}


def test_nominal_comes_first_on_each_axis_of_perturbations():
    for table in read_campaign(FILE).tables.runs:
        for perturbed in axes(table.overrides.get("emulation", {})).values():
            assert len(perturbed) == 1 or perturbed[0] == {}


@pytest.fixture(scope="module")
def minute(tmp_path_factory):
    """Status, reason and results by table, controller and plant."""
    file, out = read_campaign(FILE), tmp_path_factory.mktemp("robustness")
    wanted = (table for table in file.tables.runs if table.name in MINUTE)
    chosen = tuple(first_of_each_axis(table, *MINUTE[table.name]) for table in wanted)
    models = tuple(model for model in file.tables.models if MINUTE.keys() >= set(model.runs))
    tasks = expand(with_tables(file, runs=chosen, models=models)).tasks
    with Workers(1) as workers:
        done = carry_out_tasks(tasks, {}, WorkersExecutor(workers, out))
    return {
        (task.table, task.parameters["controller"], plant_of(task)): done[name]
        for name, task in tasks.items()
        if isinstance(task, RunTask) and task.models
    }


def plant_of(task):
    """Return what differs in the plant of a run, as JSON."""
    return json.dumps(tomllib.loads(f"plant = {task.overrides.get(PLANT, NOMINAL)}")["plant"])


def result(found, name):
    value, _ = found.results[name]
    return value


@pytest.mark.seeds
class TestMinute:
    def test_a_film_that_overshoots_is_tracked(self, minute):
        plant = '{"loop_damping": 0.6}'
        closed, opened = (minute["film-tracking", name, plant] for name in (CLOSED, OPEN))
        assert (closed.status, opened.status) == ("completed", "completed")
        assert result(closed, "tracking_rms") <= 8.0
        assert result(closed, "tracking_seconds_per_target") <= 8.0
        assert result(opened, "tracking_rms") <= 45.0

    def test_an_open_loop_beyond_twice_its_nominal_error_is_stopped(self, minute):
        plant = '{"session_offset": 0.36}'
        opened, nominal = minute["film-tracking", OPEN, plant], minute["film-tracking", OPEN, NOMINAL]
        assert nominal.status == "completed"
        assert opened.status == "failed"
        assert result(opened, "tracking_rms") > 2.0 * result(nominal, "tracking_rms")
        assert "the model does not hold for this specimen" in opened.reason
        closed = minute["film-tracking", CLOSED, plant]
        assert closed.status == "completed"
        assert result(closed, "tracking_rms") <= 8.0

    def test_a_wire_of_another_time_constant_is_tracked(self, minute):
        for table, most in (("wire-length", 0.02e-3), ("wire-force", 0.05)):
            found = {plant: done for (of, _, plant), done in minute.items() if of == table}
            assert list(found) == [NOMINAL, '{"time_constant": 3.5}', '{"time_constant": 6.5}']
            assert {done.status for done in found.values()} == {"completed"}
            assert max(result(done, "tracking_rms") for done in found.values()) <= most

    def test_a_beam_in_a_warm_room_is_moved_smoothly(self, minute):
        plant = '{"ambient_temperature": 27.0}'
        found = minute["beam-rooms", "hybrid", plant]
        assert found.status == "completed"
        assert result(found, "loop_true_move_max") <= 100e-9
        assert result(found, "loop_true_hold_rms") <= 5e-9
        opened = minute["beam-rooms", "open-loop", plant]
        assert opened.status == "failed"
        assert "the model does not hold for this specimen" in opened.reason
        assert minute["beam-rooms", "open-loop", NOMINAL].status == "completed"
