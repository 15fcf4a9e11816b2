"""The campaign of perturbed specimens: it can be carried out, each rig with a model of its own."""

from dataclasses import replace
from pathlib import Path

from bench.campaigns.expansion import expand
from bench.campaigns.file import axes, dotted, read_campaign
from bench.campaigns.tasks import ModelTask, RunTask

FILE = Path(__file__).parents[2] / "examples" / "campaign-robustness.toml"


def first_of_each_axis(table):
    overrides = {key: values[0] for key, values in axes(dotted(table.overrides)).items()}
    return table.model_copy(update={"overrides": overrides, "seeds": table.seeds[:1]})


def test_each_rig_has_its_model_and_each_controller_runs_with_it():
    file = read_campaign(FILE)
    tasks = expand(replace(file, runs=tuple(map(first_of_each_axis, file.runs)))).tasks.values()
    models = {task.table: task for task in tasks if isinstance(task, ModelTask)}
    assert {name: len(task.sources) for name, task in models.items()} == {
        "density": 1,
        "wire-model": 3,
        "beam-model": 4,
    }
    used = [task for task in tasks if isinstance(task, RunTask) and task.models]
    assert {each for task in used for each in task.needs} == {task.name for task in models.values()}


def test_nominal_comes_first_on_each_axis_of_perturbations():
    for table in read_campaign(FILE).runs:
        for perturbed in axes(table.overrides.get("emulation", {})).values():
            assert len(perturbed) == 1 or perturbed[0] == {}
