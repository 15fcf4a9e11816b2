"""The tasks of a campaign: runs, identifications and studies, each carried out by itself in a folder of its own."""

from __future__ import annotations

import math
import shutil
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Self, TypeAlias

from bench.analysis import (
    FEWEST_ROWS,
    ColumnNames,
    FitOptions,
    Session,
    compare_models,
    identify_model,
    input_and_output,
    load_models,
    read_dataset,
    read_for,
    results_json,
    whole_identification,
)
from bench.base import AbortError, BenchError, DataError, PlainConsole, Workers, parse_json, registry, write_json_file
from bench.batch.campaign.file import dotted
from bench.batch.campaign.sources import PROGRAMS, PROGRAMS_AND_RIGS, digest
from bench.batch.campaign.study_tables import FILE_NAME as STUDY_NAME, write_study
from bench.batch.study import RunSeries, Study
from bench.execution import Run, carry_out
from bench.protocol import find_protocol
from bench.record import FILE_NAME as JOURNAL_NAME, Record

DONE_NAME = "campaign.json"
"""In the folder of each task that is done: what it was, and its results."""
SHOWN_DIGITS = 8
"""Digits of its identity at the end of the name of a task."""
MODEL_NAME = "model.json"
"""In the folder of an identification."""
UNFINISHED = "unfinished"
"""Folder of a campaign in which tasks are carried out; what died there is removed at the next start."""

Results: TypeAlias = Mapping[str, tuple[float, str]]
"""Value and unit by name; 1 for a plain number."""


@dataclass(frozen=True)
class Done:
    """What a task left behind.

    Attributes
    ----------
    identity : str
        That of the task.
    status : str
        `completed`, or how a run ended: `failed`, `unsafe` if the safe state was not confirmed; `refused` if it could
        not start, `crashed` if it ended by a defect of a program.
    reason : str
        Why, and what the run warned of; empty where it was completed without a warning.
    results : mapping of str to (float, str)
        Value and unit by name.
    """

    identity: str
    status: str
    reason: str = ""
    results: Results = field(default_factory=dict)

    @property
    def carried_out(self) -> bool:
        """Whether it has a result, if only that a run has failed; else the next start tries it again."""
        return self.status not in ("refused", "crashed")


@dataclass(frozen=True, kw_only=True)
class CampaignTask(ABC):
    """One task.

    Attributes
    ----------
    name : str
        Its folder, relative to that of the campaign; the last part ends in the first digits of its identity.
    identity : str
        Hash of all that determines its results.
    """

    kind: ClassVar[str]
    leaves: ClassVar[str] = ""
    """The file in its folder that its results are in, for people and for other tasks; none if empty."""

    name: str = ""
    identity: str = ""

    @property
    def scratch(self) -> str:
        """Name of the folder in which it is carried out, its own even where another task has the same identity."""
        return digest(self.name)[:32]

    @property
    def needs(self) -> tuple[str, ...]:
        """The names of the tasks that come before it."""
        return ()

    @property
    def files(self) -> Mapping[Path, Sequence[str]]:
        """The files that it reads, with the suffixes of those beside each that it may read as well."""
        return {}

    def moved(self, places: Mapping[str, str]) -> Self:
        """Return the same task with its files in other places, by their old path."""

        def place(value: Any) -> Any:  # noqa: ANN401 - a field of any task
            if isinstance(value, Mapping):
                return {key: place(each) for key, each in value.items()}
            if not isinstance(value, str):
                return value
            # A protocol of a file may have its name behind the path.
            file, suffix, name = value.partition(".py")
            return places.get(value, places.get(file + suffix, file + suffix) + name)

        return replace(self, **{each.name: place(getattr(self, each.name)) for each in fields(self)})

    def carry_out(self, campaign: Path) -> Done:
        """Carry it out in the folder of a campaign, and leave its folder there, whole or not at all.

        Raises BenchError if it cannot be carried out.
        """
        scratch = campaign / UNFINISHED / self.scratch
        shutil.rmtree(scratch, ignore_errors=True)
        (scratch / "made").mkdir(parents=True)
        made, done = self._work(campaign, scratch / "made")
        content = {"task": self.describe(), **asdict(done)}
        write_json_file(made / DONE_NAME, content)
        target = campaign / self.name
        target.parent.mkdir(parents=True, exist_ok=True)
        # Nothing is there but what this very task has left when it was done twice, as by a worker thought dead.
        shutil.rmtree(target, ignore_errors=True)
        made.replace(target)
        shutil.rmtree(scratch, ignore_errors=True)
        return done

    def failed(self, error: BaseException) -> Done:
        """Return what is left of this task, which has raised an error: how it ended, and how to go on."""
        if not isinstance(error, BenchError):
            return Done(self.identity, "crashed", f"{type(error).__name__}: {error}")
        # What another task has left may be the reason.
        wrong = next((name for name in self.needs if name in str(error)), None)
        way_on = f"; remove {wrong} from the campaign, and the next start makes it again" if wrong else ""
        return Done(self.identity, "refused", f"{error}{way_on}")

    def is_whole(self, folder: Path) -> bool:
        """Return whether a folder that this task has left has the file with its results."""
        return not self.leaves or (folder / self.leaves).is_file()

    def left_in(self, folder: Path) -> Done | None:
        """Return what this task says that it has left in a folder, or None if it is not the folder of this task."""
        try:
            content = parse_json((folder / DONE_NAME).read_text(encoding="utf-8"))
            results = {
                name: (math.nan if value is None else value, unit)
                for name, (value, unit) in content["results"].items()
            }
            found = Done(content["identity"], content["status"], content["reason"], results)
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return found if found.identity == self.identity and found.carried_out else None

    def describe(self) -> dict[str, Any]:
        """Return what it is, for programs."""
        own = {key: value for key, value in asdict(self).items() if key not in ("name", "identity")}
        return {"kind": self.kind, **own}

    @abstractmethod
    def _work(self, campaign: Path, made: Path) -> tuple[Path, Done]:
        """Do it in the folder `made`; return the folder of what it has made, that or one in it."""


@dataclass(frozen=True, kw_only=True)
class RunTask(CampaignTask):
    """A run on an emulated rig, on the virtual clock."""

    kind = "run"
    leaves = JOURNAL_NAME

    table: str  # name of the table that asks for it
    # As `bench run` takes them.
    protocol: str
    rig: str
    seed: int  # as the file has it; the laboratory's is `seed_offset` more
    seed_offset: int = 0
    # Parameters that were set, without models of the campaign.
    parameters: Mapping[str, Any] = field(default_factory=dict)
    # Name of the task by the parameter that takes its model file.
    models: Mapping[str, str] = field(default_factory=dict)
    overrides: Mapping[str, str] = field(default_factory=dict)  # values of the rig file by dotted key
    faults: str = ""  # file of faults; empty for none
    interlock_rate: float | None = None  # as for `bench run`
    inputs: tuple[str, ...] = ()  # files that its parameters name
    # What tells the models apart, by the parameter, for people.
    model_labels: Mapping[str, str] = field(default_factory=dict)

    @property
    def needs(self) -> tuple[str, ...]:
        """The identifications of its models."""
        return tuple(self.models.values())

    @property
    def files(self) -> Mapping[Path, Sequence[str]]:
        """The files that its parameters name, the faults, the rig file and the protocol file."""
        found: dict[Path, Sequence[str]] = {Path(name): () for name in (*self.inputs, self.faults) if name}
        if self.rig.endswith(".toml"):
            found[Path(self.rig)] = PROGRAMS_AND_RIGS
        if ".py" in self.protocol:
            found[program_of(self.protocol)] = PROGRAMS
        return found

    @property
    def base(self) -> str:
        """Its name without the table and its identity."""
        return self.name.rpartition("/")[2].rpartition("-")[0]

    @property
    def settings(self) -> dict[str, Any]:
        """The value on each axis of its table, by the name of the axis; a model is given by its label."""
        return {
            "protocol": Path(self.protocol).name,
            "rig": Path(self.rig).stem,
            **self.overrides,
            **self.parameters,
            **self.model_labels,
            "faults": Path(self.faults).stem or "none",
            "seed": self.seed,
        }

    def run(self, campaign: Path, folder: Path) -> Run:
        """Return the run that it carries out; its record goes below `folder`."""
        models = {key: str(campaign / name / MODEL_NAME) for key, name in self.models.items()}
        return Run(
            protocol=find_protocol(self.protocol),
            settings={**self.parameters, **models},
            rig=self.rig,
            folder=folder,
            overrides=self.overrides,
            seed=self.seed + self.seed_offset,
            clock="virtual",
            recording=False,
            interlock_rate=self.interlock_rate,
            faults=Path(self.faults) if self.faults else None,
        )

    def _work(self, campaign: Path, made: Path) -> tuple[Path, Done]:
        result = carry_out(self.run(campaign, made), PlainConsole(quiet=True))
        outcome = result.outcome
        if isinstance(outcome.error, AbortError):
            raise outcome.error
        if outcome.error is not None and not isinstance(outcome.error, BenchError):
            # A defect of a protocol or of the bench, not a result.
            return result.folder, Done(self.identity, "crashed", outcome.reason)
        with Record(result.folder) as record:
            results = {
                "steps": (outcome.steps, "1"),
                "laboratory_time": (outcome.laboratory_seconds, "s"),
                "wall_time": (result.wall_seconds, "s"),
                **run_results(record),
            }
            warnings = [each.text for each in record.events() if each.kind == "note" and each.level == "WARN"]
        unsafe = "" if outcome.is_safe else f"NOT in the safe state: {dict(outcome.safe_state)}"
        reason = "; ".join(filter(None, (outcome.reason, unsafe, *warnings)))
        return result.folder, Done(self.identity, outcome.status if outcome.is_safe else "unsafe", reason, results)


@dataclass(frozen=True, kw_only=True)
class ModelTask(CampaignTask):
    """The identification of a model from a run, or from several together."""

    kind = "model"
    leaves = MODEL_NAME

    table: str  # name of the table that asks for it
    sources: tuple[str, ...]  # names of the tasks of the runs; several for a model that needs them
    model: str  # name of a registered model
    # Columns; empty for the signals of the slots `drive` and `response`.
    input: str = ""
    output: str = ""
    # Options of the identification, as `bench.analysis.FitOptions.of` takes them.
    options: Mapping[str, Any] = field(default_factory=dict)
    label: str = ""  # what tells it from the others of its rig and seed

    @property
    def needs(self) -> tuple[str, ...]:
        """The runs."""
        return self.sources

    def _work(self, campaign: Path, made: Path) -> tuple[Path, Done]:
        runs = [completed_run(campaign, name) for name in self.sources]
        whole = whole_identification(self.model)
        if whole is not None:
            whole.of_runs(runs, None, {}).file.save(made / MODEL_NAME)
            return made, Done(self.identity, "completed")
        (source,) = runs
        names = ColumnNames(*input_and_output(source, (self.input, self.output)))
        data = read_dataset([source], names, at_least=FEWEST_ROWS)
        found = identify_model(data, self.model, FitOptions.of(identification_options(self.options)))
        found.file.save(made / MODEL_NAME)
        summary, unit = found.summary(), found.file.operator.output_unit or "1"
        units = {"max": unit, "rms": unit, "rms_percent": "%"}
        results = {name: (float(summary[name]), unit) for name, unit in units.items()}
        return made, Done(self.identity, "completed", "", results)


@dataclass(frozen=True, kw_only=True)
class ComparisonTask(CampaignTask):
    """The errors of models on a run."""

    kind = "comparison"

    table: str  # name of the table that asks for it
    source: str  # name of the run's task
    models: Mapping[str, str]  # name of each identification's task by that of its table
    # Columns; empty for the signals of the slots `drive` and `response`.
    input: str = ""
    output: str = ""
    recalibrate: str = ""  # what is estimated of the session first, with commas; empty for nothing
    recalibrate_rows: int | None = None  # first rows for that; they do not count in the errors

    @property
    def needs(self) -> tuple[str, ...]:
        """The run and the identifications."""
        return (self.source, *self.models.values())

    def _work(self, campaign: Path, made: Path) -> tuple[Path, Done]:
        source = completed_run(campaign, self.source)
        session = Session.parse(self.recalibrate or None, self.recalibrate_rows)
        results: dict[str, tuple[float, str]] = {}
        names = ColumnNames(*input_and_output(source, (self.input, self.output)))
        for name, task in self.models.items():
            models = load_models([campaign / task / MODEL_NAME])
            found = compare_models(models, read_for([*models.values()], source, names), session=session)
            (compared,) = found.comparisons
            errors = found.recalibrated(compared) or found.comparisons[compared].raw
            unit = found.unit or "1"
            results |= {f"{name}_max": (errors.maximum, unit), f"{name}_rms": (errors.rms, unit)}
        return made, Done(self.identity, "completed", "", results)


@dataclass(frozen=True, kw_only=True)
class StudyTask(CampaignTask):
    """A study with one seed."""

    kind = "study"
    leaves = STUDY_NAME

    study: str  # name of a registered study
    rig: str  # another rig than the study's own; empty for that
    seed: int  # from which the seeds of its runs come

    @property
    def files(self) -> Mapping[Path, Sequence[str]]:
        """The rig file."""
        return {Path(self.rig): PROGRAMS_AND_RIGS} if self.rig.endswith(".toml") else {}

    def _work(self, campaign: Path, made: Path) -> tuple[Path, Done]:
        del campaign
        study: Study = registry.load("studies", self.study)
        # The cores are shared by the tasks of the campaign.
        with Workers(1) as workers:
            found = study.carry_out(RunSeries(self.rig or study.rig or "", made, self.seed, False, workers))
        write_study(found, made)
        # Units are in the names, or the study's own tables say them.
        results = {
            name: (float(value), "")
            for name, value in dotted(found.values).items()
            if isinstance(value, (int, float)) and not isinstance(value, bool)
        }
        return made, Done(self.identity, "completed", "", results)


def program_of(protocol: str) -> Path:
    """Return the file of a protocol that is not a packaged one."""
    return Path(protocol.partition(".py")[0] + ".py")


def completed_run(campaign: Path, name: str) -> Path:
    """Return the folder of the run of a task; raises DataError if it was not completed."""
    with Record(campaign / name) as record:
        if record.status != "completed":
            raise DataError(f"the run {name} was not completed")
    return campaign / name


def identification_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options from a file as `FitOptions.of` takes them: ranges are pairs, of several levels one is chosen."""
    found = {key: tuple(value) if isinstance(value, list) else value for key, value in options.items()}
    if isinstance(levels := found.get("levels"), tuple):
        del found["levels"]
        found |= {"levels_to_try": levels, "cross_validated": True}
    return found


def run_results(record: Record) -> dict[str, tuple[float, str]]:
    """Return what a run that controls a signal has reached: value and unit by name, such as `tracking_rms`."""
    unit = record.unit(record.controlled) if record.controlled else "1"
    return {
        f"{kind}_{name}": (value, "s" if name.startswith("seconds") else unit)
        for kind, values in results_json(record).items()
        for name, value in values.items()
    }
