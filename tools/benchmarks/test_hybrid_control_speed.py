"""CPU time of a sample of the hybrid's control at 200 Hz, with its journal and interlocks, by controller.

On the virtual clock in process, through the real drivers of TEC and T7; prints, asserts no time.
"""

import io
import time

import numpy as np
import pytest
from rich.console import Console

from bench.execution import Run, carry_out
from bench.identification import ModelFile
from bench.models import Polynomial, PrandtlIshlinskii
from bench.protocol import find_protocol
from rigs.hybrid.design import Design
from rigs.hybrid.model import PUBLISHED_DYNAMICS, HybridModel

pytestmark = pytest.mark.benchmark

CONTROLLERS = ("hybrid", "hybrid-low-pass", "thermal-feedback", "open-loop")
SHORT, LONG = 1.0, 31.0
"""Holds whose difference leaves the start out, s."""
REPEATS = 5


@pytest.fixture
def model(tmp_path):
    hysteresis = PrandtlIshlinskii(
        np.arange(15) * 40.0 / 15,
        np.array([150.0, *np.linspace(30.0, 2.0, 14)]) * 1e-9,
        input_range=(-40.0, 40.0),
    )
    polynomial = Polynomial([-7.363e-6 * 25.0], (-25.0, 25.0))
    path = tmp_path / "hybrid.json"
    ModelFile("hybrid", HybridModel(Design().network(), polynomial, hysteresis, PUBLISHED_DYNAMICS)).save(path)
    return path


def carried_out(model, controller, hold, folder):
    """Return CPU time (s) and number of samples of a hold."""
    settings = {
        "model": str(model),
        "controller": controller,
        "reference": "hold",
        "hold": f"{hold:g}",
        "witness": "true",
        # Not the identified model, whose lateness is that of the rig.
        "probe": "0",
    }
    begin = time.process_time()
    result = carry_out(
        Run(
            protocol=find_protocol("hybrid-control"),
            settings=settings,
            rig="hybrid-witness",
            seed=1,
            clock="virtual",
            folder=folder,
            live=False,
            recording=False,
        ),
        Console(file=io.StringIO()),
    )
    seconds = time.process_time() - begin
    assert result.outcome.error is None
    return seconds, result.outcome.lateness["hold"]["samples"]


def test_a_sample_of_the_control(model, tmp_path, capsys):
    found = {}
    for controller in CONTROLLERS:
        costs = []
        for repeat in range(1 + REPEATS):
            (short, few), (long, many) = (
                carried_out(model, controller, hold, tmp_path / f"{controller}-{repeat}-{hold:g}")
                for hold in (SHORT, LONG)
            )
            assert many > few
            # The first compiles.
            if repeat:
                costs.append(1e6 * (long - short) / (many - few))
        found[controller] = costs
    with capsys.disabled():
        print(f"\nhybrid-control at 200 Hz, CPU time a sample, median and least of {REPEATS}:")
        for controller, costs in found.items():
            print(f"  {controller}: {np.median(costs):.1f} and {min(costs):.1f} µs")
