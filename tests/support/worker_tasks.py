"""Tasks of the tests, in a module that worker processes can import."""

import itertools
import os
import signal
import threading
from pathlib import Path

import numpy as np

from bench.base import DeviceError, report, task_console
from bench.execution import Run, carry_out
from bench.protocol import find_protocol

_ordinals = itertools.count()


def process(value):
    """Return the process as well."""
    return value, os.getpid()


def ordinal():
    """Return how many such tasks this process carried out before."""
    return next(_ordinals)


def product(size):
    """Return a product of matrices, which BLAS shares out among its threads if it has several."""
    matrix = np.random.default_rng(size).normal(size=(size, size))
    return matrix @ matrix.T


def speak(text):
    report(1, 2, text)
    task_console().print(f"{text} is said")
    print("This is not for the bench.")


def fail(device):
    raise DeviceError(device, "answers with an error")


def break_down():
    raise ValueError("a defect")


def die(folder):
    """Be killed while there is a file left; each time one less is there."""
    left = sorted(Path(folder).iterdir())
    if left:
        left[0].unlink()
        os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))
    return "done"


def wait(folder):
    """Write down which process waits, for ever."""
    Path(folder, str(os.getpid())).touch()
    threading.Event().wait()


def meet(folder):
    """Wait until two processes are here."""
    Path(folder, str(os.getpid())).touch()
    while len(list(Path(folder).iterdir())) < 2:
        threading.Event().wait(0.01)


def run(folder):
    """Carry out a run of hours."""
    run = Run(
        find_protocol("damped-oscillation"), {}, "vo2", Path(folder), clock="x1", recording=False, rehearse=False
    )
    return carry_out(run, task_console())
