"""Carrying out the tasks of a campaign: not those that were done before, and each once what it needs is there."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Protocol

from bench.base import AbortError, ConfigurationError, Pending, Workers
from bench.batch.campaign.tasks import DONE_NAME, SHOWN_DIGITS, UNFINISHED, CampaignTask, Done
from bench.rig import Holder, Locks


class Executor(Protocol):
    """Carries tasks out, many at a time."""

    def submit(self, task: CampaignTask) -> None:
        """Have a task carried out; all that it needs is in the folder of the campaign."""

    def next_done(self) -> tuple[CampaignTask, Done]:
        """Wait for a task that was submitted, and return it with what it left; its folder is there by then."""


class WorkersExecutor:
    """Carries tasks out in the worker processes of this machine.

    Parameters
    ----------
    workers : Workers
        That are at work.
    campaign : Path
        Folder of the campaign.
    """

    def __init__(self, workers: Workers, campaign: Path) -> None:
        self._workers = workers
        self._campaign = campaign
        self._pending: dict[Pending[Done], CampaignTask] = {}

    def submit(self, task: CampaignTask) -> None:
        """Have a task carried out."""
        self._pending[self._workers.submit(task.name, task.carry_out, self._campaign)] = task

    def next_done(self) -> tuple[CampaignTask, Done]:
        """Wait for a task; raises AbortError if the operator has ended it, and so the campaign."""
        pending = self._workers.wait_for(self._pending)
        task, error = self._pending.pop(pending), pending.exception()
        if isinstance(error, AbortError):
            raise error
        return task, task.failed(error) if error else pending.result()


@contextmanager
def opened_folder(campaign: Path) -> Iterator[None]:
    """Hold the folder of many runs meanwhile, for one process at a time; unfinished tasks are removed.

    Raises ConfigurationError if another process is at work in it, or it cannot be written.
    """
    with Locks(Holder.of_this_process("emulated", f"many runs in {campaign.resolve()}")) as locks:
        try:
            campaign.mkdir(parents=True, exist_ok=True)
            locks.take_folder(campaign)
            shutil.rmtree(campaign / UNFINISHED, ignore_errors=True)
        except OSError as error:
            raise ConfigurationError(f"the folder of the campaign cannot be made: {error}") from None
        yield
        shutil.rmtree(campaign / UNFINISHED, ignore_errors=True)


@dataclass(frozen=True)
class Before:
    """What earlier starts have left."""

    done: dict[str, Done]  # by name of the task
    # By name of a task the one that it had then: what differs among the runs was something else.
    places: dict[str, str]
    lost: dict[str, str]  # by name of a task that has to be done again the file that has gone from its folder

    def put_in_place(self, campaign: Path) -> list[str]:
        """Rename the folders of tasks that have another name now, and of those that are not whole.

        Returns a line for each task that is done again as its folder is not whole.
        """
        lines = []
        for name, file in self.lost.items():
            aside = _aside(campaign / name)
            (campaign / name).replace(aside)
            lines.append(f"{name} is done again, as {file} is gone; what was left is in {aside.name} beside it")
        for name, former in self.places.items():
            (campaign / name).parent.mkdir(parents=True, exist_ok=True)
            (campaign / former).replace(campaign / name)
        return lines


def _aside(folder: Path) -> Path:
    """Return a name beside a folder that nothing has yet, and that is not the name of a task."""
    names = (f"{folder.name}.incomplete{suffix}" for suffix in ("", *(f"-{i}" for i in range(2, 1000))))
    return next(each for name in names if not (each := folder.with_name(name)).exists())


def done_before(tasks: Mapping[str, CampaignTask], campaign: Path) -> Before:
    """Return what earlier starts have left of tasks in the folder of a campaign."""
    before = Before({}, {}, {})
    missing: dict[str, CampaignTask] = {}
    for name, task in tasks.items():
        if (left := task.left_in(campaign / name)) is None:
            missing[task.identity[:SHOWN_DIGITS]] = task
        elif task.is_whole(campaign / name):
            before.done[name] = left
        else:
            before.lost[name] = task.leaves
    for file in campaign.glob(f"*/*/{DONE_NAME}") if missing else ():
        former = file.parent.relative_to(campaign).as_posix()
        moved = missing.get(former[-SHOWN_DIGITS:])
        left = None if moved is None or former in tasks else moved.left_in(file.parent)
        if moved is not None and left is not None and moved.is_whole(file.parent):
            before.done[moved.name], before.places[moved.name] = left, former
    return before


def carry_out_tasks(tasks: Mapping[str, CampaignTask], done: dict[str, Done], executor: Executor) -> dict[str, Done]:
    """Carry out all tasks that were not done before; return what each has left, by name, in the order of `tasks`.

    A task whose needs could not be carried out is refused. What is done meanwhile is added to what was `done` before.
    """
    order = TopologicalSorter({name: task.needs for name, task in tasks.items()})
    order.prepare()
    going = 0
    while order.is_active():
        for name in order.get_ready():
            task = tasks[name]
            wrong = next((need for need in task.needs if not done[need].carried_out), None)
            if name not in done and wrong is None:
                executor.submit(task)
                going += 1
                continue
            if name not in done:
                reason = f"needs {wrong}, which was not carried out: {done[str(wrong)].reason}"
                done[name] = Done(task.identity, "refused", reason)
            order.done(name)
        if going:
            task, done[task.name] = executor.next_done()
            going -= 1
            order.done(task.name)
    return {name: done[name] for name in tasks}
