"""From a model and a rig to a tuning file."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.base import BenchError, ConfigurationError, PlainConsole, wall_time
from bench.batch.campaign.execution import opened_folder
from bench.batch.tuning.search import ERRORS, MARGIN, TIME_WEIGHT, WORST, TuningTrial, confirm, search
from bench.batch.tuning.tuning_runs import TuningRuns, TuningTask, start_of, task_of
from bench.control import ControllerSetup, controller_spec, tuning_text
from bench.identification import load_model
from bench.models import TwoStage
from bench.rig import load_rig


@dataclass(frozen=True)
class Tuned:
    """Numbers that were found for a controller."""

    task: TuningTask  # what they are for
    twin: str  # the emulated rig on which they were found
    # The numbers before and after, in sessions that the search has not seen. The same if nothing better was found.
    first: TuningTrial
    best: TuningTrial
    trials: int  # number of trials of the search
    others: dict[str, Any]  # tables of the rig file for the other controllers of the protocol
    provenance: dict[str, str | float]  # what the tuning file says of where they come from

    def text(self) -> str:
        """Return the tuning file."""
        return tuning_text({**self.others, self.task.controller: self.best.numbers}, self.provenance)

    def rows(self) -> list[tuple[str, str]]:
        """Return what was found, for people."""
        after = "after" if self.best is not self.first else "nothing better found"
        rows = [
            (name, f"cost {t.cost:.4g}, RMS {t.rms:.4g}, worst margin {t.worst:.4g}, {t.seconds:.1f} s a target")
            for name, t in (("before", self.first), (after, self.best))
        ]
        return [*rows, ("trials", str(self.trials)), ("numbers", str(dict(self.best.numbers)))]

    def summary(self) -> dict[str, Any]:
        """Return what was found, for programs."""
        return {"before": asdict(self.first), "after": asdict(self.best), "trials": self.trials, **self.provenance}


def tune(
    model: Path,
    rig: str,
    *,
    twin: str | None = None,
    controller: str = "closed-loop-inverse",
    protocol: str | None = None,
    settings: Mapping[str, str] | None = None,
    seeds: int = 2,
    checks: int = 8,
    rounds: int = 2,
    time_weight: float = TIME_WEIGHT,
    workers: int | None = None,
    folder: Path = Path("recordings/tuning"),
    console: Console | None = None,
) -> Tuned:
    """Tune a controller; parameters as the options of `bench model tune`.

    Of the best numbers of the search those are taken that are best in sessions that it has not seen, and better there
    than the first ones by `bench.batch.tuning.search.confirm`.

    Raises
    ------
    ConfigurationError
        If the controller has no numbers to tune, or the rig no emulated twin.
    DataError
        If the model cannot be used.
    BenchError
        If the runs fail with the numbers to begin with and the model as it is, or with all numbers beside it.
    """
    from bench.base import Workers

    shown = console or PlainConsole(quiet=True)
    file = load_model(model).at_rest()
    task = task_of(file, controller, protocol)
    own = load_rig(rig)
    on = twin or own.rig.twin or rig
    tuned_on = load_rig(on)
    if not tuned_on.in_process:
        raise ConfigurationError(
            f"rig {on} is not emulated: give --twin, such as a rig file that bench model twin has made"
        )
    tables = own.protocols.get(task.protocol, {}).get("tuning", {})
    spec = controller_spec(task.kind, controller)
    if spec.numbers is None:
        raise ConfigurationError(f"controller {controller} has no numbers that could be tuned")
    given = settings or {}
    low, high = file.model.first.input_range if file.model.kind == TwoStage.kind else file.operator.input_range
    drive = own.roles.get("drive")
    setup = ControllerSetup(
        name=controller,
        model=file,
        limits=(low, high),
        dwell=None if drive is None else drive.dwell,
        options={"duration": float(given.get("duration", 20.0))},
    )
    begin = start_of(tables.get(controller, {}), spec.numbers(setup), spec.tunable)
    trials: list[TuningTrial] = []

    def tell(trial: TuningTrial) -> None:
        trials.append(trial)
        shown.print(f"{len(trials):3}  cost {trial.cost:.4g}  RMS {trial.rms:.4g}  {dict(trial.numbers)}")
        if len(trials) == 1 and trial.failed:
            shown.print(f"the search begins with numbers that fail: {runs.failures[0]}")

    # What each of many runs says of itself would hide what the search says.
    kernels = ("bench.models", "bench.control", *getattr(tuned_on.laboratory, "kernels", ()))
    made = wall_time()
    # An earlier tuning keeps its runs.
    folder /= f"{controller}-{made:%Y%m%d-%H%M%S}"
    with opened_folder(folder), Workers(workers, title=f"tune {controller}", kernels=kernels) as pool:
        runs = TuningRuns(task, on, file, folder, pool, given, seeds, time_weight=time_weight)
        best = search(begin, spec.tunable, runs, tell, rounds)
        if best.failed:
            raise BenchError(f"the controller fails with all numbers that were tried: {runs.failures[0]}")
        unseen = [replace(runs, seeds=1, first_seed=seed) for seed in range(seeds, seeds + checks)]
        first, best = confirm(trials, unseen)
    provenance: dict[str, str | float] = {
        "model": model.name,
        "model_sha256": sha256(model.read_bytes()).hexdigest(),
        "rig": rig,
        "twin": on,
        "protocol": task.protocol,
        "settings": ", ".join(f"{key}={value}" for key, value in given.items()),
        "cost": f"0.5 (as identified + worst margin) of RMS + {time_weight:g} time a target, as multiples of those "
        f"before; margins: gain and time constant by {MARGIN:g} to either side",
        "better": f"cost less by more than {ERRORS:g} standard errors in the same sessions, "
        f"greatest RMS at most {WORST:g} times that before",
        "cost_before": first.cost,
        "cost_after": best.cost,
        "rms_before": first.rms,
        "rms_after": best.rms,
        "trials": len(trials),
        "seeds": seeds,
        "checks": checks,
        "made": made.isoformat(timespec="seconds"),
        "bench": importlib.metadata.version("actuator-bench"),
    }
    return Tuned(task, on, first, best, len(trials), dict(tables), provenance)
