"""`bench run` as an operator uses it, at a terminal of its own."""

import json
import os
import sys
from functools import partial

import pytest
from places import SUPPORT

from bench.protocol import PARAMETER, ParameterChange
from bench.record import Record

pexpect = pytest.importorskip("pexpect")
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")


@pytest.fixture
def start(terminal, tmp_path):
    """Start `bench` with arguments at a terminal, where the rigs of the tests are found."""
    environment = {
        **os.environ, "PYTHONPATH": os.pathsep.join([str(SUPPORT), str(SUPPORT.parents[1])]), "TERM": "xterm",
        "NO_COLOR": "1",
    }  # fmt: skip
    return partial(terminal, columns=160, cwd=tmp_path, env=environment)


def run_of(tmp_path):
    (folder,) = (tmp_path / "recordings").iterdir()
    return folder


def ended(child):
    child.expect(pexpect.EOF)
    child.close()
    return child.exitstatus


@pytest.mark.seeds
def test_a_pause_with_all_that_it_offers(start, tmp_path, rig_file):
    told = tmp_path / "told"
    listener = tmp_path / "listener.py"
    listener.write_text(f"import os; open({str(told)!r}, 'a').write(os.environ['BENCH_EVENT'] + '\\n')\n")
    child = start(
        "run", f"{SUPPORT / 'heater_protocols.py'}:stairs", "--rig", rig_file(), "--set", "dwell=0.6",
        "--set", "count=8", "--set", "increment=1",
        "--clock", "wall", "--no-rehearse", "--notify", f"{sys.executable} {listener}",
    )  # fmt: skip
    child.expect("step 1 at")
    child.sendintr()
    child.expect("paused by the operator; the set-points stand")
    child.expect(r"set dwell=…  now 0\.6 s, hold")
    child.expect("PAUSED for 0:00:00")
    child.expect("PAUSED for 0:00:02")  # it is drawn anew, without an answer
    child.sendline("pardon")
    child.expect("please answer r")
    child.sendline("set dwell=-5")
    child.expect("is not allowed; allowed: 0 to 3600 s")
    child.sendline("set dwell=0.1")
    child.expect(r"set dwell=…  now 0\.1 s")
    child.sendline("note the door was open")
    child.expect("remark: the door was open")
    child.sendline("s")
    child.expect("paused by one step")
    child.sendline("r")
    child.expect("completed: 8 steps")
    assert ended(child) == 0
    with Record(run_of(tmp_path)) as run:
        (change,) = ParameterChange.among((each.kind, each.text) for each in run.events())
        assert (change.name, change.value, change.former) == ("dwell", 0.1, 0.6)
        assert [each.text for each in run.events() if each.kind == "remark"] == ["the door was open"]
        steps = list(run.step_records())
        # On the wall clock: those before the change are held for longer.
        assert all(step.finished - step.started >= 0.6 for step in steps[: change.step + 1])
        assert json.loads(json.dumps(run.meta["parameters"]))["dwell"] == 0.6
        assert not [each for each in run.events() if each.kind == "notify"]
        assert len([each for each in run.events() if each.kind == PARAMETER]) == 1
    assert told.read_text().split() == ["pause", "pause", "end"]
    assert not (run_of(tmp_path) / "operator").exists()


def test_ctrl_c_in_the_first_moments_says_what_is(start, tmp_path):
    # A module that takes long to import is the first thing that a run waits for.
    slow = tmp_path / "slow.py"
    slow.write_text("print('importing', flush=True)\nimport threading\nthreading.Event().wait(60)\n")
    child = start("run", f"{slow}:stairs", "--rig", "vo2")
    child.expect("importing")
    child.sendintr()
    child.expect("ended by Ctrl-C: no device was opened, nothing has moved; the outputs are as they were")
    assert ended(child) == 130


def test_the_times_are_whole_on_a_terminal_of_eighty_columns(start):
    child = start("run", "creep", "--rig", "sma", "--set", "duration=20", "--clock", "x60", columns=80)
    child.expect(r"creep.*?\d+/\d+  t \d:\d\d:\d\d, left \d:\d\d:\d\d.*?, ends (\d+-\d+-\d+ )?\d\d:\d\d")
    child.expect(r"supply_voltage [\d.]+ V  load_cell_force [\d.-]+ N  wire_end_position [\d.-]+ mm")
    child.expect("completed: 84 steps")
    assert ended(child) == 0


def test_ctrl_c_in_the_rehearsal_says_that_nothing_has_moved(start):
    child = start("run", "covering", "--rig", "sma", "--clock", "x60")
    child.expect("rehearsing covering on sma")
    child.sendintr()
    child.expect("ending the rehearsal; nothing has moved")
    child.expect("the rehearsal was ended by .*nothing has moved")
    assert ended(child) == 130
