"""From a campaign file to its tasks, everything checked: rigs, protocols, each set of parameters, limits, faults."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from bench.analysis import WholeIdentification, check_template, option_names, whole_identification, whole_models
from bench.base import ConfigurationError, closest, counted, registry, toml_value
from bench.batch.campaign.file import (
    REFERENCE,
    CampaignFile,
    ComparisonsTable,
    ModelsTable,
    RunsTable,
    StudiesTable,
    axes,
    dotted,
)
from bench.batch.campaign.known_rig import KnownRig
from bench.batch.campaign.sources import PROGRAMS, code_digest, digest, file_digest
from bench.batch.campaign.tasks import (
    SHOWN_DIGITS,
    CampaignTask,
    ComparisonTask,
    Done,
    ModelTask,
    RunTask,
    StudyTask,
    identification_options,
    program_of,
)
from bench.batch.study import Study
from bench.execution import check_before_moving
from bench.models import find_model, identifiable_models
from bench.protocol import ProtocolDefinition, find_protocol, plan

_LONGEST_NAME = 120
_UNSAFE = re.compile(r"[^A-Za-z0-9_.=+,-]+")

Axis = Mapping[str, Any]
T = TypeVar("T")
Task = TypeVar("Task", bound=CampaignTask)


@dataclass(frozen=True)
class Expansion:
    """The tasks of a campaign file."""

    tasks: Mapping[str, CampaignTask]  # by name; those that others need come before them
    # By the name of a table of runs, what differs among its runs, in the order in which it is shown, with its unit.
    varying: Mapping[str, Mapping[str, str]]
    # By the name of a task its planned laboratory time and that on the wall clock, s; those that are known.
    plans: Mapping[str, tuple[float, float]]
    # Packages whose kernels the tasks take, but for those of laboratories, which are compiled by now.
    kernels: tuple[str, ...]

    def announcement(self, before: Collection[str], cores: int) -> str:
        """Return in a line what is left to do after the tasks `before`, and what it will take on so many cores."""
        left = [name for name in self.tasks if name not in before]
        counts = Counter(self.tasks[name].kind for name in left)
        plural = {"run": "runs", "model": "models", "comparison": "comparisons", "study": "studies"}
        texts = [f"{n} {kind if n == 1 else many}" for kind, many in plural.items() if (n := counts[kind])]
        line = f"{', '.join(texts) or 'nothing'} to do" + (f", {len(before)} done before" if before else "")
        known = [self.plans[name] for name in left if name in self.plans]
        if known:
            hours, wall = sum(lab for lab, _ in known) / 3600, sum(wall for _, wall in known) / cores
            line += f"; {hours:.1f} h of laboratory time, {_in_words(wall)} on {counted(cores, 'core')}"
            # Studies, identifications, and runs that need a model of the campaign.
            if unknown := len(left) - len(known):
                line += f", and {unknown} tasks of unknown length"
        return line

    def listing(self, before: Mapping[str, Done]) -> Iterator[str]:
        """Yield a line for each task: name, planned laboratory time, and how it ended before."""
        for name in self.tasks:
            planned = f"{self.plans[name][0]:.0f} s" if name in self.plans else ""
            yield ", ".join(filter(None, [name, planned, before[name].status if name in before else ""]))


def _in_words(seconds: float) -> str:
    # The pace of the plant alone is known: what a run takes besides counts among short ones.
    if seconds < 60:
        return "less than a minute"
    return f"about {seconds / 60:.0f} min" if seconds < 5400 else f"about {seconds / 3600:.1f} h"


def expand(file: CampaignFile) -> Expansion:
    """Return the tasks of a campaign file; nothing is carried out, nothing is written.

    Raises ConfigurationError if something in it is wrong: names file, table, key, and what is allowed.
    """
    return _Expander(file).expansion()


class _Run(NamedTuple):
    """A task of a run, with its rig and its protocol as they were found."""

    task: RunTask
    known: KnownRig
    definition: ProtocolDefinition


class _Expander:
    """Carries what was looked up already: a thousand runs of ten rigs connect ten."""

    def __init__(self, file: CampaignFile) -> None:
        self._file = file
        self._digest = cache(file_digest)
        self._protocol = cache(_protocol_and_digest)
        self._rig = cache(KnownRig.look_at)
        self._check_faults = cache(KnownRig.check_faults)
        self._tasks: dict[str, CampaignTask] = {}
        self._runs: dict[str, list[_Run]] = {}
        self._models: dict[str, dict[tuple[str, int], list[ModelTask]]] = {}
        self._plans: dict[str, tuple[float, float]] = {}
        self._varying: dict[str, dict[str, str]] = {}
        self._asked_runs = 0
        self._kernels = ["bench.models", "bench.identification"]

    def expansion(self) -> Expansion:
        """Return all tasks, those of runs in an order in which their models come before them."""
        file = self._file
        for where, models in file.each("models"):
            self._check_models(where, models)
        # A table of models comes after its runs, and before those that use it.
        waiting = list(file.each("models"))
        for where, table in file.each("runs"):
            self._add_runs(where, table)
            for models in [each for each in waiting if self._runs.keys() >= set(each[1].runs)]:
                self._add_models(*models)
                waiting.remove(models)
        for where, comparisons in file.each("comparisons"):
            self._add_comparisons(where, comparisons)
        for where, study in file.each("studies"):
            self._add_studies(where, study)
        if len(self._tasks) > 2 * file.tables.most_runs:
            raise ConfigurationError(
                f"{file.path}: {len(self._tasks)} runs, models and studies; expected at most twice most_runs = "
                f"{file.tables.most_runs}"
            )
        return Expansion(self._tasks, self._varying, self._plans, tuple(self._kernels))

    def _check_models(self, where: str, table: ModelsTable) -> None:
        known = {runs.name: runs for runs in self._file.tables.runs}
        for name in table.runs:
            _check_known(f"{where}: runs", name, known, "table of runs of this name")
            seeds = known[name].seeds
            if table.seed is not None and table.seed not in seeds:
                raise ConfigurationError(
                    f"{where}: seed = {table.seed}: {name} has no run with this seed; it has: "
                    f"{', '.join(map(str, seeds))}"
                )
        allowed: tuple[str, ...] = ()
        if whole_identification(table.model) is None:
            try:
                find_model(table.model)
            except ValueError:
                raise ConfigurationError(
                    f"{where}: model = {table.model!r}: there is no such model; "
                    f"{closest(table.model, (*identifiable_models(), *whole_models()))}"
                ) from None
            if len(table.runs) > 1:
                raise ConfigurationError(
                    f"{where}: runs: a model {table.model} is identified from one run; expected one table"
                )
            allowed = option_names(table.model)
        for key in table.options:
            if key not in allowed:
                raise ConfigurationError(f"{where}.{key}: there is no such key; {closest(key, allowed)}")

    def _add_runs(self, where: str, table: RunsTable) -> None:
        parameters = axes(table.parameters)
        overrides = {key: list(map(toml_value, values)) for key, values in axes(dotted(table.overrides)).items()}
        for kind, grid in (("parameters", parameters), ("overrides", overrides)):
            for key, values in grid.items():
                if not values:
                    raise ConfigurationError(f"{where}: {kind}.{key} = []: expected at least one value")
        lengths = {
            "protocol": len(table.protocol),
            "rig": len(table.rigs),
            **{key: len(values) for key, values in {**parameters, **overrides}.items()},
            "faults": len(table.faults),
            "seed": len(table.seeds),
        }
        self._asked_runs += math.prod(lengths.values())
        if self._asked_runs > (most := self._file.tables.most_runs):
            raise ConfigurationError(
                f"{where}: {' × '.join(map(str, lengths.values()))} runs make {self._asked_runs} with those before; "
                f"most_runs = {most} are allowed"
            )
        of_models = {key for key, values in parameters.items() if self._has_several_models(where, key, values)}
        self._varying[table.name] = {key: "" for key, length in lengths.items() if length > 1 or key in of_models}
        self._runs[table.name] = []
        for protocol, rig in itertools.product(table.protocol, table.rigs):
            for replaced, chosen in itertools.product(_grid(overrides), _grid(parameters)):
                self._add_point(where, table, protocol, rig, replaced, chosen)

    def _has_several_models(self, where: str, key: str, values: Sequence[Any]) -> bool:
        """Return whether the values of a parameter refer to several models of a rig and seed."""
        names = [name for value in values if (name := _reference(value)) is not None]
        known = [REFERENCE + each for each in self._models]
        for name in names:
            what = "such table of models of runs that come before"
            _check_known(f"{where}: parameters.{key}", REFERENCE + name, known, what)
        return any(len(models) > 1 for name in names for models in self._models[name].values())

    def _add_point(
        self, where: str, table: RunsTable, protocol: str, rig: str, overrides: Axis, chosen: Axis
    ) -> None:
        """Add the runs of one point of the grid: its faults, seeds, and the models of each."""
        with _said_at(f"{where}: protocol = {protocol!r}"):
            definition, source = self._protocol(self._beside(protocol))
        with _said_at(f"{where}: rigs = {rig!r}{f' with overrides {dict(overrides)}' if overrides else ''}"):
            known = self._rig(self._beside(rig), tuple(overrides.items()))
        file = known.description.file
        referred = {key: name for key, value in chosen.items() if (name := _reference(value)) is not None}
        given = {
            key: self._file.beside(value) if key in definition.file_parameters and isinstance(value, str) else value
            for key, value in chosen.items()
            if key not in referred
        }
        of = f" (rig {file.name}{''.join(f', {key} = {value}' for key, value in given.items())})"
        with _said_at(f"{where}: parameters{of}"):
            # The path of a model that does not exist yet is a text like any other.
            own = file.protocols.get(definition.name)
            parameters = definition.parse({**given, **dict.fromkeys(referred, "")}, file.roles, own, path=file.path)
            # What a run does whose model is not there yet is not known.
            planned = None if referred else plan(definition, parameters, known.description.slots(definition))
            if planned is None:
                known.description.check_needs(definition.name, definition.names)
            else:
                check_before_moving(known.description, definition, planned)
        inputs = {key: path for key, path in definition.files(parameters).items() if key not in referred}
        varying, units = self._varying[table.name], definition.units(file.roles)
        varying |= {key: unit or units.get(key, "") for key, unit in varying.items() if key in chosen}
        determining = {
            "code": code_digest(),
            "rig": known.digest,
            "protocol": [definition.name, source],
            # The content of a file determines the results, not its place.
            "parameters": parameters.model_dump(mode="json", exclude={*inputs, *referred}),
            "inputs": {key: self._digest(Path(path)) for key, path in inputs.items()},
            "interlock_rate": table.interlock_rate,
        }
        for faults, seed in itertools.product(table.faults, table.seeds):
            path = self._file.beside(faults)
            if path:
                with _said_at(f"{where}: faults = {faults!r}, rig {file.name}"):
                    self._check_faults(known, Path(path))
            for models in self._sources(where, referred, self._beside(rig), seed):
                task = RunTask(
                    table=table.name,
                    protocol=self._beside(protocol),
                    rig=self._beside(rig),
                    seed=seed,
                    seed_offset=table.seed_offset,
                    parameters=given,
                    models={key: model.name for key, model in models.items()},
                    overrides=overrides,
                    faults=path,
                    interlock_rate=table.interlock_rate,
                    inputs=tuple(inputs.values()),
                    model_labels={key: model.label for key, model in models.items()},
                )
                shown = {key: _shown(task.settings[key]) for key in varying}
                parts = [text if key in ("protocol", "rig") else f"{key}={text}" for key, text in shown.items()]
                own_determining = {
                    "seed": seed + table.seed_offset,
                    "faults": self._digest(Path(path)) if path else "",
                    "models": {key: model.identity for key, model in models.items()},
                }
                task = self._added(task, table.name, "-".join(parts), {**determining, **own_determining})
                self._runs[table.name].append(_Run(task, known, definition))
                if planned is not None and planned.complete:
                    self._plans[task.name] = (planned.seconds, planned.seconds * known.pace)

    def _sources(
        self, where: str, referred: Mapping[str, str], rig: str, seed: int
    ) -> Iterator[Mapping[str, ModelTask]]:
        """Yield the models that a run takes, one set a run: those of its rig and seed."""
        return _grid(
            {
                key: self._models_of(f"{where}: parameters.{key} = '{REFERENCE}{name}'", name, rig, seed)
                for key, name in referred.items()
            }
        )

    def _models_of(self, where: str, name: str, rig: str, seed: int) -> list[ModelTask]:
        """Return the models of a table for a rig and a seed; raise ConfigurationError if there are none."""
        table = next(each for each in self._file.tables.models if each.name == name)
        wanted = seed if table.seed is None else table.seed
        if not (found := self._models[name].get((rig, wanted), [])):
            raise ConfigurationError(
                f"{where}: {', '.join(table.runs)} has no run on {rig} with seed {wanted}; expected the same rigs "
                "and seeds there, or `seed` in the table of models"
            )
        return found

    def _add_models(self, where: str, table: ModelsTable) -> None:
        self._models[table.name] = {}
        runs = [run for label in table.runs for run in self._runs[label] if table.seed in (None, run.task.seed)]
        if (whole := whole_identification(table.model)) is not None:
            for rig, seed in dict.fromkeys((run.task.rig, run.task.seed) for run in runs):
                together = [run for run in runs if (run.task.rig, run.task.seed) == (rig, seed)]
                self._check_whole(where, whole, rig, seed, together)
                self._add_model(table, together, f"{Path(rig).stem}-seed={seed}", table.name)
            return
        (table_of_runs,) = table.runs
        varying = [key for key in self._varying[table_of_runs] if key not in ("rig", "seed")]
        for run in runs:
            self._check_identification(where, table, run)
            label = " ".join([table.name, *(f"{key}={_shown(run.task.settings[key])}" for key in varying)])
            self._add_model(table, [run], run.task.base, label)

    def _add_model(self, table: ModelsTable, runs: Sequence[_Run], base: str, label: str) -> None:
        """Add the identification of a model of a rig and seed from runs."""
        task = ModelTask(
            table=table.name,
            sources=tuple(run.task.name for run in runs),
            model=table.model,
            input=table.input,
            output=table.output,
            options=table.options,
            label=label,
        )
        content = table.model_dump(exclude={"name", "runs", "seed"})
        task = self._added(task, table.name, base, {"runs": [run.task.identity for run in runs], **content})
        self._models[table.name].setdefault((runs[0].task.rig, runs[0].task.seed), []).append(task)

    def _check_whole(self, where: str, whole: WholeIdentification, rig: str, seed: int, runs: Sequence[_Run]) -> None:
        """Check that a model of several runs gets one of each protocol that it needs."""
        found = [run.definition.name for run in runs]
        if sorted(found) != sorted(whole.protocols):
            raise ConfigurationError(
                f"{where}: runs: expected one run each of {', '.join(whole.protocols)} on a rig and seed; on {rig} "
                f"with seed {seed} there are: {', '.join(found)}"
            )

    def _check_identification(self, where: str, table: ModelsTable, run: _Run) -> None:
        """Check columns and options of an identification from a run."""
        known = run.known
        file, slots = known.description.file, known.description.slots(run.definition)
        columns = {"input": (table.input, "drive"), "output": (table.output, "response")}
        for key, (column, slot) in columns.items():
            if not column and slot not in slots:
                raise ConfigurationError(f"{where}: {key} is missing, as {run.task.protocol} has no slot {slot!r}")
            if column:
                _check_known(f"{where}: {key}", column, known.description.by_name, "such signal")
        drive = file.roles.get("drive")
        if table.input or drive is None or drive.range is None:
            return
        try:
            options = identification_options(table.options)
            for levels in options.pop("levels_to_try", (None,)):
                own = options if levels is None else {**options, "levels": levels}
                check_template(table.model, np.linspace(*drive.range, 100), own)
        except ValueError as error:
            raise ConfigurationError(f"{where}: {error} (rig {file.name})") from None

    def _add_comparisons(self, where: str, table: ComparisonsTable) -> None:
        for key, names, known in (
            ("runs", (table.runs,), self._runs),
            ("models", table.models, self._models),
        ):
            for name in names:
                _check_known(f"{where}: {key}", name, known, f"table of {key} of this name")
        tables = {models.name: models for models in self._file.tables.models}
        columns = {(tables[name].input, tables[name].output) for name in table.models}
        if len(columns) > 1:
            raise ConfigurationError(f"{where}: models: their columns differ; expected one input and one output")
        ((input_column, output_column),) = columns
        content = table.model_dump(exclude={"name", "runs", "models"})
        for run, *_ in self._runs[table.runs]:
            found = {
                task.label: task
                for name in table.models
                for task in self._models_of(f"{where}: models = {name!r}", name, run.rig, run.seed)
            }
            task = ComparisonTask(
                table=table.name,
                source=run.name,
                models={label: task.name for label, task in found.items()},
                input=input_column,
                output=output_column,
                recalibrate=table.recalibrate,
                recalibrate_rows=table.recalibrate_rows,
            )
            identities = {label: task.identity for label, task in found.items()}
            self._added(task, table.name, run.base, {"run": run.identity, **content, "models": identities})

    def _add_studies(self, where: str, table: StudiesTable) -> None:
        with _said_at(f"{where}: name = {table.name!r}"):
            study: Study = registry.load("studies", table.name)
        for rig, seed in itertools.product(table.rigs, table.seeds):
            if rig and study.rig is None:
                raise ConfigurationError(f"{where}: rigs = {rig!r}: the study runs on several rigs of its own")
            used = rig or study.rig
            with _said_at(f"{where}: rigs = {used!r}"):
                known = self._rig(self._beside(used), ()).digest if used else ""
            self._kernels += study.all_kernels
            shown = f"{Path(rig).stem}-seed={seed}" if len(table.rigs) > 1 else f"seed={seed}"
            self._added(
                StudyTask(study=table.name, rig=self._beside(rig), seed=seed),
                table.name,
                shown,
                {"code": code_digest(), "study": table.name, "rig": known, "seed": seed},
            )

    def _added(self, task: Task, table: str, shown: str, determining: Mapping[str, Any]) -> Task:
        """Add a task, known by what determines its results, in a folder named by what is shown; return it."""
        identity = digest(determining)
        text = _UNSAFE.sub("_", shown)[:_LONGEST_NAME]
        added = replace(
            task, name=f"{table}/{'-'.join(filter(None, (text, identity[:SHOWN_DIGITS])))}", identity=identity
        )
        if added.name in self._tasks:
            raise ConfigurationError(f"{self._file.path}: {added.name}: two runs are the same; give each value once")
        self._tasks[added.name] = added
        return added

    def _beside(self, name: str) -> str:
        """Return a rig or a protocol of the file; a path is relative to it."""
        return self._file.beside(name) if name.endswith(".toml") or ".py" in name else name


def _protocol_and_digest(path: str) -> tuple[ProtocolDefinition, str]:
    """Return a protocol, and the hash of its file; of a packaged one it is part of that of the programs."""
    return find_protocol(path), file_digest(program_of(path), PROGRAMS) if ".py" in path else ""


@contextmanager
def _said_at(where: str) -> Iterator[None]:
    """Put the place in the file before the text of a ConfigurationError."""
    try:
        yield
    except ConfigurationError as error:
        raise ConfigurationError(f"{where}: {error}") from None


def _check_known(where: str, name: str, known: Collection[str], what: str) -> None:
    """Raise ConfigurationError if a name is none of those that are known."""
    if name not in known:
        raise ConfigurationError(f"{where} = {name!r}: there is no {what}; {closest(name, known)}")


def _grid(values: Mapping[str, Sequence[T]]) -> Iterator[dict[str, T]]:
    for chosen in itertools.product(*values.values()):
        yield dict(zip(values, chosen, strict=True))


def _reference(value: object) -> str | None:
    """Return the table of models to which the value of a parameter refers, or None."""
    return value[1:] if isinstance(value, str) and value.startswith(REFERENCE) else None


def _shown(value: object) -> str:
    return Path(value).stem if isinstance(value, str) and "/" in value else str(value)
