"""Runs that are killed, and how far the model of a resumed one is from that of an uninterrupted one."""

from __future__ import annotations

import signal
import sqlite3
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import bench
from bench.record import FILE_NAME

_DYING = """
import os, signal, threading
from bench.cli import main
from bench.record import Journal

def die(journal):
    {before}
    os.kill(os.getpid(), signal.SIGKILL)

def step(journal, record, write=Journal.step):
    write(journal, record)
    if journal.steps >= {steps}:
        threading.Timer({delay}, die, [journal]).start() if {delay} else die(journal)

Journal.step = step
main({command})
"""
"""A command that dies once a step is durable: a process that watched it would come too late on a busy machine."""


class EndedFirstError(Exception):
    """A run was completed before it was killed."""


def finished_steps(folder: Path) -> int:
    """Return how many steps the one run below a folder has finished; 0 before it is there."""
    for journal in folder.glob(f"**/{FILE_NAME}"):
        try:
            db = sqlite3.connect(f"{journal.as_uri()}?mode=ro", uri=True)
            try:
                return int(db.execute("SELECT count(*) FROM steps").fetchone()[0])
            finally:
                db.close()
        except sqlite3.Error:
            return 0
    return 0


def kill_after(steps: int, folder: Path, *command: str, delay: float = 0.0, before: str = "") -> Path:
    """Carry out a `bench` command that writes one run below a folder, and that kills itself by SIGKILL on the way.

    Parameters
    ----------
    steps : int
        Finished steps after which it does.
    folder : Path
        Where the run is.
    *command : str
        Of `bench`.
    delay : float
        Wall-clock time after that step, s, so that it is killed within another one.
    before : str
        What the process does before it kills itself, in Python.

    Returns
    -------
    Path
        The folder of the run.

    Raises
    ------
    EndedFirstError
        If the run was completed before.
    """
    code = _DYING.format(steps=steps, delay=delay, before=before, command=list(command))
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", code],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
    )
    said = process.communicate()[1].decode()
    if process.returncode == 0:
        raise EndedFirstError("it was completed before it was killed")
    assert process.returncode == -signal.SIGKILL, f"it failed before it was killed: {said}"
    (journal,) = folder.glob(f"**/{FILE_NAME}")
    return journal.parent


def distance(resumed: Path, uninterrupted: Path, model: str, options: Mapping[str, Any]) -> float:
    """Return how far the coefficients of a model of two runs are apart: the RMS, in their standard uncertainties."""
    found = [bench.identify(run, model, **options).identification for run in (resumed, uninterrupted)]
    first, second = (each.model.coefficients for each in found)
    sigma = np.hypot(*(each.uncertainties for each in found))
    known = np.isfinite(sigma) & (sigma > 0)
    assert known.any()
    return float(np.sqrt(np.mean(((first - second)[known] / sigma[known]) ** 2)))
