"""A bench or its guardian is killed, stopped and hung; outputs go off. The tight figures: `make kill-safe`."""

import signal
import sys

import pytest
from benches import IN_TIME
from kill_safe import SETPOINTS, TRIALS, harm_bench, harm_guardian

from sim_devices.serving.process import serve

pytestmark = [
    pytest.mark.usefixtures("warm_popen"),
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it looks for processes as on Linux"),
]


KINDS = ("SIGKILL", "SIGUSR1", "endless loop", "stalled reader")
"""One trial of each kind: `make test-all` has all."""


def check(parts):
    for found in parts.values():
        # On a busy machine everything takes longer; outputs and exit codes are the same.
        assert not found.problem or found.problem.startswith("after "), found.problem
        assert found.seconds < found.within + IN_TIME


@pytest.mark.parametrize(
    "title", [pytest.param(title, marks=[] if title in KINDS else pytest.mark.seeds) for title in TRIALS]
)
def test_the_bench_goes_wrong(vo2, title):
    check(harm_bench(vo2, TRIALS[title], 0.2))


@pytest.mark.parametrize("name", [name for name in SETPOINTS if name != "vo2"])
def test_the_bench_is_killed_on_every_rig(name):
    with serve(name, clock="x1") as rig:
        check(harm_bench(rig, TRIALS["SIGKILL"], 0.2))


def test_the_guardian_is_killed(vo2):
    check(harm_guardian(vo2, signal.SIGKILL, 0.2))
