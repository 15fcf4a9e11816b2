"""When a rescuer takes a rig over."""

import json
import queue
import subprocess
import sys

import pytest
from benches import seconds_until

from bench.execution.guardian.rescuer import SILENCE, Report, is_needed
from bench.rig import SAFE

pytestmark = pytest.mark.usefixtures("warm_popen")


class Signs:
    """What a guardian has written; `None` for a wait in which nothing has come, however long that took."""

    def __init__(self, *signs):
        self._signs = list(signs)
        self.waited = 0.0

    def get(self, timeout):
        sign = self._signs.pop(0)
        if sign is None:
            self.waited += timeout
            raise queue.Empty
        self.waited = 0.0
        return sign


SILENT = [None] * 1000


@pytest.mark.parametrize(
    ("signs", "needed"),
    [
        ([b".\n", b""], True),
        ([b""], True),
        ([b".\n", b"!\n"], False),
        # It is released while it still opens its lines.
        ([None] * 100 + [b"!\n"], False),
        ([None] * 100 + [b""], True),
        ([b".\n", *SILENT], True),
    ],
)
def test_a_guardian_that_is_gone_or_silent_and_no_other(signs, needed):
    assert is_needed(Signs(*signs)) is needed


def test_silence_is_told_from_signs_that_come_late():
    signs = Signs(b".\n", *[None, None, b".\n"] * 50, *SILENT)
    assert is_needed(signs)
    assert SILENCE <= signs.waited < SILENCE + 0.5
    assert len(signs._signs) < 1000


def test_one_that_is_released_before_it_is_ready_does_nothing(tmp_path):
    """As by a guardian that is refused the rig: what it writes comes at once."""
    report = tmp_path / "report.json"
    content = {"rig": "vo2", "overrides": {}, "attach": None, "report": str(report), "process": 1, "guardian": 1}
    command = [sys.executable, "-P", "-m", "bench.execution.guardian.rescuer"]
    done = subprocess.run(command, input=json.dumps(content).encode() + b"\n.\n!\n", check=False)
    assert done.returncode == 0
    # Nobody waits for what it reports.
    assert not report.exists()


@pytest.mark.parametrize(
    "line", [b"{\n", b"[]\n", b'{"targets": ["ftp://x"], "facts": {}, "t": 0}\n', b'{"targets": []}\n']
)
def test_whom_it_cannot_tell_does_not_keep_it_from_making_the_devices_safe(vo2, tmp_path, line):
    report = Report(tmp_path / "report.json")
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as bench:
        content = {"rig": "vo2", "overrides": {}, "attach": str(vo2.endpoints_file), "report": str(report.path)}
        content |= {"process": bench.pid, "guardian": 0}
        command = [sys.executable, "-P", "-m", "bench.execution.guardian.rescuer"]
        with subprocess.Popen(command, stdin=subprocess.PIPE) as rescuer:
            rescuer.stdin.write(json.dumps(content).encode() + b"\n" + line)
            rescuer.stdin.flush()
            seconds_until(report.is_ready)
            bench.kill()
    assert rescuer.returncode == 0
    assert report.states() == {"tec": SAFE, "psd": SAFE}
