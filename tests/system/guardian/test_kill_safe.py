"""A bench or its guardian is killed, stopped and hung; outputs go off. The tight figures: `make kill-safe`."""

import signal
import sys

import pytest
from benches import IN_TIME, check_at_once
from kill_safe import SETPOINTS, TRIALS, harm_bench, harm_guardian

from sim_devices.serving.process import serve

pytestmark = [
    pytest.mark.usefixtures("warm_popen"),
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it looks for processes as on Linux"),
]

CASES = {
    **{f"vo2, {title}": ("vo2", title) for title in TRIALS},
    **{name: (name, "SIGKILL") for name in SETPOINTS if name != "vo2"},
    "guardian": ("vo2", None),
}
# `test_told` has an endless loop, SIGKILL and SIGSTOP on the rig vo2.
PART = ["vo2, SIGUSR1", "vo2, stalled reader", "sma", "hybrid", "guardian"]


@pytest.mark.parametrize(
    "names", [pytest.param(PART, id="part"), pytest.param([*CASES], id="all", marks=pytest.mark.seeds)]
)
def test_outputs_go_off(names):
    check_at_once(names, check)


def check(name):
    rig_name, trial = CASES[name]
    with serve(rig_name, clock="x1") as rig:
        parts = harm_guardian(rig, signal.SIGKILL, 0.2) if trial is None else harm_bench(rig, TRIALS[trial], 0.2)
    for found in parts.values():
        # On a busy machine everything takes longer; outputs and exit codes are the same.
        assert not found.problem or found.problem.startswith("after "), found.problem
        assert found.seconds < found.within + IN_TIME
