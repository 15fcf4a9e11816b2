"""`bench panel` at a terminal, in front of instruments in another process, whose own state is looked at."""

import os
import signal
import subprocess
import sys

import pytest
from benches import is_on, seconds_until

from bench.record import Record
from bench.rig import Holder, Locks

pexpect = pytest.importorskip("pexpect")
pytest.importorskip("textual")

pytestmark = [
    pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="terminals of POSIX"),
]


@pytest.fixture
def panel(terminal, vo2, tmp_path):
    """Start the panel of the served rig, or of a copy of its file."""

    def begin(rig="vo2"):
        arguments = ["panel", rig, "--attach", vo2.endpoints_file, "--out", tmp_path]
        return terminal(*arguments, columns=150, env={**os.environ, "TERM": "xterm"})

    return begin


def record_in(folder):
    (run,) = (each for each in folder.iterdir() if each.is_dir())
    return Record(run)


def temperature(vo2):
    return vo2.control.state()["plate_temperature"]


def test_set_40_degrees_then_the_terminal_hangs_up(panel, vo2, tmp_path):
    child = panel()
    child.expect("tec_temperature")
    child.send("set tec 40\r")
    seconds_until(lambda: is_on(vo2) and temperature(vo2) > 30.0)
    # As a closed window does, and nothing more: no signal of pexpect's own.
    child.ptyproc.fileobj.close()
    child.ptyproc.closed = child.closed = True
    seconds_until(lambda: not is_on(vo2))
    seconds_until(lambda: not child.isalive())

    def ended():
        with record_in(tmp_path) as record:
            return record.status == "aborted"

    seconds_until(ended)
    with record_in(tmp_path) as record:
        assert record.meta["reason"] == "ended by SIGHUP"
        assert set(record.meta["safe_state"].values()) == {"safe"}
        assert [dict(each.setpoints) for each in record.step_records()] == [{"tec": 40.0}]


@pytest.mark.usefixtures("warm_popen")
def test_a_rig_in_use_is_one_message(vo2, tmp_path):
    holder = Holder.of_this_process("vo2", "a test that is at work")
    with Locks(holder) as locks:
        locks.take_lines(endpoint.port for endpoint in vo2.instruments.values())
        done = subprocess.run(
            [sys.executable, "-m", "bench", "panel", "vo2", "--attach", vo2.endpoints_file, "--out", tmp_path],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
    assert done.returncode == 2
    assert not done.stdout
    (message,) = done.stderr.strip().splitlines()
    assert "a test that is at work" in message
    assert not [*tmp_path.iterdir()]
