"""Every method of the guardian fails once; the output goes off, and nothing is called safe that is on."""

import json
import subprocess
import sys

import pytest
from benches import IN_TIME, LONG, TOOLS
from chaos import LEASE, METHODS

from bench.execution.guardian.channel import LONGEST_ANSWER
from bench.rig import load_rig

RECONNECT = load_rig("vo2").safety.reconnect

pytestmark = [
    pytest.mark.usefixtures("warm_popen"),
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="it forks"),
]


PART = ["Guardian._turn", "Guardian._is_safe", "StationCore.reply", "LineThreads._next", "Channel.send"]
"""What `make test` lets fail, one for each way out of a failure; `make test-all` all methods."""


@pytest.mark.parametrize(
    "methods", [pytest.param(PART, id="part"), pytest.param(list(METHODS), id="all", marks=pytest.mark.seeds)]
)
def test_whatever_fails_the_output_goes_off(vo2, methods):
    done = subprocess.run(
        [sys.executable, str(TOOLS / "chaos.py"), str(vo2.endpoints_file), *methods],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=10 * LONG,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert [each["method"] for each in found] == methods
    # Some are called in runs of another kind only.
    assert sum(each["failed"] for each in found) >= 0.7 * len(methods)
    for each in found:
        # While a request is carried out the bench cannot be late; an answer that is lost is noticed by its time.
        allowed = LONGEST_ANSWER + RECONNECT if each["method"] == "Guardian._hand_over" else 1.1 * LEASE
        assert each["off_after"] is not None, each
        assert each["off_after"] < allowed + IN_TIME, each
    assert not [each for each in found if each["on_at_the_end"]]
    for each in found:
        assert each["safe"].keys() == {"tec", "psd"}
