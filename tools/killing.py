"""Runs that are killed, and how far the model of a resumed one is from that of an uninterrupted one."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

import bench
from bench.record import FILE_NAME, Record

LONG = 120.0
"""Wall-clock time that a busy machine may take, s."""


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


def kill_after(
    steps: int,
    folder: Path,
    *command: str,
    delay: float = 0.0,
    kill: Callable[[subprocess.Popen[bytes]], None] = subprocess.Popen.kill,
) -> Path:
    """Start a `bench` command that writes one run below a folder, and kill it by SIGKILL.

    Parameters
    ----------
    steps : int
        Finished steps after which it is killed.
    folder : Path
        Where the run is.
    *command : str
        Of `bench`.
    delay : float
        Wall-clock time after that step, s, so that it is killed within another one.
    kill : callable
        Kills the process, and others with it.

    Returns
    -------
    Path
        The folder of the run.

    Raises
    ------
    EndedFirstError
        If the run was completed before it was killed, as may be on a busy machine.
    """
    code = f"from bench.cli import main; main({list(command)!r})"
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", code],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
    )
    start = time.monotonic()
    while finished_steps(folder) < steps:
        ended = process.poll()
        if ended == 0:
            raise EndedFirstError("it was completed before it was killed")
        assert ended is None, f"it failed before it was killed: {process.stderr.read().decode()}"
        assert time.monotonic() - start < LONG, f"{steps} steps not within {LONG:g} s"
        time.sleep(0.002)
    time.sleep(delay)
    kill(process)
    process.communicate()
    (journal,) = folder.glob(f"**/{FILE_NAME}")
    with Record(journal.parent) as record:
        if record.status == "completed":
            raise EndedFirstError("it was completed before it was killed")
    return journal.parent


def distance(resumed: Path, uninterrupted: Path, model: str, options: Mapping[str, Any]) -> float:
    """Return how far the coefficients of a model of two runs are apart: the RMS, in their standard uncertainties."""
    found = [bench.identify(run, model, **options).identification for run in (resumed, uninterrupted)]
    first, second = (each.model.coefficients for each in found)
    sigma = np.hypot(*(each.uncertainties for each in found))
    known = np.isfinite(sigma) & (sigma > 0)
    assert known.any()
    return float(np.sqrt(np.mean(((first - second)[known] / sigma[known]) ** 2)))
