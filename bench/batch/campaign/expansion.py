"""From a campaign file to its tasks, everything checked: rigs, protocols, each set of parameters, limits, faults."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from bench.analysis import WholeIdentification, check_template, option_names, whole_identification, whole_models
from bench.base import BenchError, ConfigurationError, closest, counted, registry, toml_value
from bench.batch.campaign.file import (
    REFERENCE,
    CampaignFile,
    ComparisonsTable,
    ModelsTable,
    RunsTable,
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
)
from bench.batch.study import Study
from bench.execution import check_before_moving
from bench.models import find_model, identifiable_models
from bench.protocol import Plan, ProtocolDefinition, find_protocol, plan
from bench.rig import RigFile

_LONGEST_NAME = 120
_UNSAFE = re.compile(r"[^A-Za-z0-9_.=+,-]+")

Axis = Mapping[str, Any]
T = TypeVar("T")


@dataclass(frozen=True)
class Expansion:
    """The tasks of a campaign file."""

    tasks: Mapping[str, CampaignTask]  # by name; those that others need come before them
    # By the name of a table of runs, what differs among its runs, in the order in which it is shown.
    varying: Mapping[str, tuple[str, ...]]
    # By the name of a task its planned laboratory time and that on the wall clock, s; those that are known.
    plans: Mapping[str, tuple[float, float]]
    units: Mapping[tuple[str, str], str]  # unit of a parameter, by the table of runs and its name
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
    """A task of a run, with the rig as the file names it, the same as it was found, and the protocol."""

    task: RunTask
    rig: str
    known: KnownRig
    definition: ProtocolDefinition


class _Expander:
    """Carries what was looked up already: a thousand runs of ten rigs connect ten."""

    def __init__(self, file: CampaignFile) -> None:
        self._file = file
        self._rigs: dict[tuple[str, str], KnownRig] = {}
        self._faults: set[tuple[str, str]] = set()
        self._protocols: dict[str, tuple[ProtocolDefinition, str]] = {}
        self._plans: dict[str, Plan | None] = {}
        self._digests: dict[str, str] = {}
        self._tasks: dict[str, CampaignTask] = {}
        self._runs: dict[str, list[_Run]] = {}
        self._models: dict[str, dict[tuple[str, int], list[ModelTask]]] = {}
        self._found_plans: dict[str, tuple[float, float]] = {}
        self._varying: dict[str, tuple[str, ...]] = {}
        self._units: dict[tuple[str, str], str] = {}
        self._kernels = ["bench.models", "bench.identification"]

    def expansion(self) -> Expansion:
        """Return all tasks, those of runs in an order in which their models come before them."""
        file = self._file
        self._check_number()
        for number, models in enumerate(file.tables.models):
            self._check_models(number, models)
        # A table of models comes after its runs, and before those that use it.
        waiting = list(file.tables.models)
        for number, table in enumerate(file.tables.runs):
            self._add_runs(number, table)
            for models in [each for each in waiting if self._runs.keys() >= set(each.runs)]:
                self._add_models(file.where("models", file.tables.models.index(models)), models)
                waiting.remove(models)
        for number, comparisons in enumerate(file.tables.comparisons):
            self._add_comparisons(file.where("comparisons", number), comparisons)
        for number, study in enumerate(file.tables.studies):
            self._add_studies(number, study)
        if len(self._tasks) > 2 * file.tables.most_runs:
            raise ConfigurationError(
                f"{file.path}: {len(self._tasks)} runs, models and studies; expected at most twice most_runs = "
                f"{file.tables.most_runs}"
            )
        return Expansion(self._tasks, self._varying, self._found_plans, self._units, tuple(self._kernels))

    def _check_number(self) -> None:
        """Check the number of runs before any list of them is made."""
        total = 0
        for number, table in enumerate(self._file.tables.runs):
            grid = [*axes(table.parameters).values(), *axes(dotted(table.overrides)).values()]
            lengths = [len(table.protocol), len(table.rigs), len(table.seeds), len(table.faults), *map(len, grid)]
            total += math.prod(lengths)
            if total > self._file.tables.most_runs:
                raise ConfigurationError(
                    f"{self._file.where('runs', number)}: {' × '.join(map(str, lengths))} runs make {total} with "
                    f"those before; most_runs = {self._file.tables.most_runs} are allowed"
                )

    def _check_models(self, number: int, table: ModelsTable) -> None:
        where = self._file.where("models", number)
        known = {runs.label: runs for runs in self._file.tables.runs}
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

    def _add_runs(self, number: int, table: RunsTable) -> None:
        where = self._file.where("runs", number)
        parameters, overrides = axes(table.parameters), axes(dotted(table.overrides))
        for kind, grid in (("parameters", parameters), ("overrides", overrides)):
            for key, values in grid.items():
                if not values:
                    raise ConfigurationError(f"{where}: {kind}.{key} = []: expected at least one value")
        models = {key: self._references(where, key, values) for key, values in parameters.items()}
        models = {key: names for key, names in models.items() if names}
        self._runs[table.label] = []
        varying = {
            "protocol": len(table.protocol) > 1,
            "rig": len(table.rigs) > 1,
            **{key: len(values) > 1 for key, values in {**parameters, **overrides}.items()},
            **{key: True for key, names in models.items() if len(names) > 1 or self._has_several(names[0])},
            "faults": len(table.faults) > 1,
            "seed": len(table.seeds) > 1,
        }
        self._varying[table.label] = tuple(key for key, varies in varying.items() if varies)
        for protocol, rig in itertools.product(table.protocol, table.rigs):
            for replaced in _grid(overrides):
                known = self._rig(where, rig, {key: toml_value(value) for key, value in replaced.items()})
                for faults in filter(None, table.faults):
                    self._check_faults(where, known, faults)
                for chosen in _grid(parameters):
                    self._add_run_of(where, table, protocol, rig, known, replaced, chosen, models)

    def _has_several(self, models: str) -> bool:
        """Return whether a table of models has several of a rig and seed."""
        return any(len(each) > 1 for each in self._models[models].values())

    def _references(self, where: str, key: str, values: Sequence[Any]) -> list[str]:
        """Return the tables of models to which the values of a parameter refer."""
        names = [value[1:] for value in values if isinstance(value, str) and value.startswith(REFERENCE)]
        known = [REFERENCE + each for each in self._models]
        for name in names:
            what = "such table of models of runs that come before"
            _check_known(f"{where}: parameters.{key}", REFERENCE + name, known, what)
        return names

    def _add_run_of(
        self,
        where: str,
        table: RunsTable,
        protocol: str,
        rig: str,
        known: KnownRig,
        replaced: Axis,
        chosen: Axis,
        models: Mapping[str, Sequence[str]],
    ) -> None:
        """Add the runs of one point of the grid: its faults, seeds, and the models of each."""
        definition, source = self._protocol(where, protocol)
        referred = {key: str(chosen[key])[1:] for key in models if str(chosen[key]).startswith(REFERENCE)}
        given = {
            key: self._file.beside(value) if key in definition.file_parameters and isinstance(value, str) else value
            for key, value in chosen.items()
            if key not in referred
        }
        planned, resolved, inputs = self._planned(where, definition, source, known, given, referred)
        for key in chosen:
            self._units.setdefault((table.label, key), _unit(definition, known.file, key))
        for faults, seed in itertools.product(table.faults, table.seeds):
            for sources in self._sources(where, referred, rig, seed):
                used = {key: task.name for key, task in sources.items()}
                path = self._file.beside(faults)
                identity = digest(
                    {
                        "code": code_digest(),
                        "rig": known.digest,
                        "protocol": [definition.name, source],
                        "parameters": resolved,
                        "models": {key: task.identity for key, task in sources.items()},
                        "inputs": {key: self._digest(each) for key, each in inputs.items()},
                        "seed": seed + table.seed_offset,
                        "faults": self._digest(path) if path else "",
                        "interlock_rate": table.interlock_rate,
                    }
                )
                labels = {key: task.label for key, task in sources.items()}
                values = {
                    "protocol": Path(protocol).name,
                    "rig": known.file.name,
                    **{key: _shown(value) for key, value in {**chosen, **replaced}.items()},
                    **labels,
                    "faults": Path(faults).stem or "none",
                    "seed": seed,
                }
                task = RunTask(
                    name=_name(table.label, values, self._varying[table.label], identity),
                    identity=identity,
                    table=table.label,
                    protocol=self._file.beside(protocol) if ".py" in protocol else protocol,
                    rig=self._file.beside(rig) if rig.endswith(".toml") else rig,
                    seed=seed,
                    seed_offset=table.seed_offset,
                    parameters=given,
                    models=used,
                    overrides={key: toml_value(value) for key, value in replaced.items()},
                    faults=path,
                    interlock_rate=table.interlock_rate,
                    inputs=tuple(inputs.values()),
                    model_labels=labels,
                )
                self._add(task)
                self._runs[table.label].append(_Run(task, rig, known, definition))
                if planned is not None and planned.complete:
                    self._found_plans[task.name] = (planned.seconds, planned.seconds * known.pace)

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
            for key in dict.fromkeys((run.rig, run.task.seed) for run in runs):
                together = [run for run in runs if (run.rig, run.task.seed) == key]
                self._check_whole(where, whole, *key, together)
                self._add_model(table, key, together, f"{Path(key[0]).stem}-seed={key[1]}", table.name)
            return
        (table_of_runs,) = table.runs
        varying = [key for key in self._varying[table_of_runs] if key not in ("rig", "seed")]
        for run in runs:
            self._check_identification(where, table, run)
            label = " ".join([table.name, *(f"{key}={_shown(run.task.setting(key))}" for key in varying)])
            self._add_model(table, (run.rig, run.task.seed), [run], run.task.base, label)

    def _add_model(
        self, table: ModelsTable, key: tuple[str, int], runs: Sequence[_Run], base: str, label: str
    ) -> None:
        """Add the identification of a model of a rig and seed from runs."""
        identity = digest(
            {"runs": [run.task.identity for run in runs], **table.model_dump(exclude={"name", "runs", "seed"})}
        )
        task = ModelTask(
            name=_folder(table.name, base, identity),
            identity=identity,
            table=table.name,
            sources=tuple(run.task.name for run in runs),
            model=table.model,
            input=table.input,
            output=table.output,
            options=table.options,
            label=label,
        )
        self._add(task)
        self._models[table.name].setdefault(key, []).append(task)

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
        slots = known.description.slots(run.definition)
        columns = {"input": (table.input, "drive"), "output": (table.output, "response")}
        for key, (column, slot) in columns.items():
            if not column and slot not in slots:
                raise ConfigurationError(f"{where}: {key} is missing, as {run.task.protocol} has no slot {slot!r}")
            if column:
                _check_known(f"{where}: {key}", column, known.description.by_name, "such signal")
        drive = known.file.roles.get("drive")
        if table.input or drive is None or drive.range is None:
            return
        try:
            options = identification_options(table.options)
            for levels in options.pop("levels_to_try", (None,)):
                own = options if levels is None else {**options, "levels": levels}
                check_template(table.model, np.linspace(*drive.range, 100), own)
        except ValueError as error:
            raise ConfigurationError(f"{where}: {error} (rig {known.file.name})") from None

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
        for run, rig, *_ in self._runs[table.runs]:
            found = {
                task.label: task
                for name in table.models
                for task in self._models_of(f"{where}: models = {name!r}", name, rig, run.seed)
            }
            content = table.model_dump(exclude={"name", "runs", "models"})
            identity = digest({"run": run.identity, **content, "models": {k: t.identity for k, t in found.items()}})
            self._add(
                ComparisonTask(
                    name=_folder(table.name, run.base, identity),
                    identity=identity,
                    table=table.name,
                    source=run.name,
                    models={label: task.name for label, task in found.items()},
                    input=input_column,
                    output=output_column,
                    recalibrate=table.recalibrate,
                    recalibrate_rows=table.recalibrate_rows,
                )
            )

    def _add_studies(self, number: int, table: Any) -> None:  # noqa: ANN401 - a StudiesTable
        where = self._file.where("studies", number)
        with _said_at(f"{where}: name = {table.name!r}"):
            study: Study = registry.load("studies", table.name)
        for rig, seed in itertools.product(table.rigs, table.seeds):
            given = self._file.beside(rig) if rig.endswith(".toml") else rig
            if rig and study.rig is None:
                raise ConfigurationError(f"{where}: rigs = {rig!r}: the study runs on several rigs of its own")
            used = rig or study.rig
            known = self._rig(where, used, {}).digest if used else ""
            identity = digest({"code": code_digest(), "study": table.name, "rig": known, "seed": seed})
            self._kernels += study.all_kernels
            values = {"rig": Path(rig).stem, "seed": seed}
            varying = ["rig"] * (len(table.rigs) > 1) + ["seed"]
            self._add(StudyTask(_name(table.name, values, varying, identity), identity, table.name, given, seed))

    def _add(self, task: CampaignTask) -> None:
        if task.name in self._tasks:
            raise ConfigurationError(f"{self._file.path}: {task.name}: two runs are the same; give each value once")
        self._tasks[task.name] = task

    def _protocol(self, where: str, name: str) -> tuple[ProtocolDefinition, str]:
        """Return a protocol, and the hash of its file."""
        if name not in self._protocols:
            path = self._file.beside(name) if ".py" in name else name
            with _said_at(f"{where}: protocol = {name!r}"):
                definition = find_protocol(path)
            source = file_digest(Path(path.partition(".py")[0] + ".py"), PROGRAMS) if ".py" in name else ""
            self._protocols[name] = definition, source
        return self._protocols[name]

    def _rig(self, where: str, name: str, overrides: Mapping[str, str]) -> KnownRig:
        key = name, digest(overrides)
        if key not in self._rigs:
            with_overrides = f" with overrides {dict(overrides)}" if overrides else ""
            with _said_at(f"{where}: rigs = {name!r}{with_overrides}"):
                path = self._file.beside(name) if name.endswith(".toml") else name
                self._rigs[key] = KnownRig.look_at(path, overrides)
        return self._rigs[key]

    def _check_faults(self, where: str, known: KnownRig, faults: str) -> None:
        key = known.digest, faults
        if key not in self._faults:
            with _said_at(f"{where}: faults = {faults!r}, rig {known.file.name}"):
                known.check_faults(Path(self._file.beside(faults)))
            self._faults.add(key)

    def _planned(
        self,
        where: str,
        definition: ProtocolDefinition,
        source: str,
        known: KnownRig,
        given: Mapping[str, Any],
        referred: Mapping[str, str],
    ) -> tuple[Plan | None, Mapping[str, Any], Mapping[str, str]]:
        """Check parameters on a rig; return the plan if there is one, the parameters, and the files among them."""
        file = known.file
        of = f" (rig {file.name}{''.join(f', {key} = {value}' for key, value in given.items())})"
        with _said_at(f"{where}: parameters{of}"):
            # The path of a model that does not exist yet is a text like any other.
            parameters = definition.parse(
                {**given, **dict.fromkeys(referred, "")},
                file.roles,
                file.protocols.get(definition.name),
                path=file.path,
            )
            files = {name: path for name, path in definition.files(parameters).items() if name not in referred}
            # Of a file its content counts, not its place.
            left_out = {*files, *referred}
            resolved = {
                key: value for key, value in parameters.model_dump(mode="json").items() if key not in left_out
            }
            key = digest([definition.name, source, known.digest, resolved, files, *referred])
            if key not in self._plans:
                slots = known.description.slots(definition)
                known.description.check_needs(definition.name, definition.names)
                expected = None if referred else plan(definition, parameters, slots)
                if expected is not None:
                    check_before_moving(known.description, definition, expected)
                self._plans[key] = expected
        return self._plans[key], resolved, files

    def _digest(self, path: str) -> str:
        if path not in self._digests:
            self._digests[path] = file_digest(Path(path))
        return self._digests[path]


@contextmanager
def _said_at(where: str) -> Iterator[None]:
    """Say of an error within at which place of the file it is."""
    try:
        yield
    except BenchError as error:
        raise ConfigurationError(f"{where}: {error}") from None


def _check_known(where: str, name: str, known: Collection[str], what: str) -> None:
    """Raise ConfigurationError if a name is none of those that are known."""
    if name not in known:
        raise ConfigurationError(f"{where} = {name!r}: there is no {what}; {closest(name, known)}")


def _grid(values: Mapping[str, Sequence[T]]) -> Iterator[dict[str, T]]:
    for chosen in itertools.product(*values.values()):
        yield dict(zip(values, chosen, strict=True))


def _unit(definition: ProtocolDefinition, file: RigFile, key: str) -> str:
    entries = definition.help(file.roles, file.protocols.get(definition.name))
    return next((entry.unit for entry in entries if entry.name == key), "")


def _shown(value: object) -> str:
    return Path(value).stem if isinstance(value, str) and "/" in value else str(value)


def _name(table: str, values: Mapping[str, Any], varying: Sequence[str], identity: str) -> str:
    """Return the folder of a task: what differs within its table, and the first digits of its identity."""
    parts = [str(values[key]) if key in ("protocol", "rig") else f"{key}={values[key]}" for key in varying]
    return _folder(table, _UNSAFE.sub("_", "-".join(parts))[:_LONGEST_NAME], identity)


def _folder(table: str, text: str, identity: str) -> str:
    return f"{table}/{text}{'-' * bool(text)}{identity[:SHOWN_DIGITS]}"
