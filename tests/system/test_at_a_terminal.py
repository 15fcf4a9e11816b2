"""`bench run` as an operator uses it, at a terminal of its own."""

import os
import sys
from functools import partial

import pytest
from places import SUPPORT

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


def ended(child):
    child.expect(pexpect.EOF)
    child.close()
    return child.exitstatus


def test_ctrl_c_in_the_first_moments_says_what_is(start, tmp_path):
    # A module that takes long to import is the first thing that a run waits for.
    slow = tmp_path / "slow.py"
    slow.write_text("print('importing', flush=True)\nimport threading\nthreading.Event().wait(60)\n")
    child = start("run", f"{slow}:stairs", "--rig", "vo2")
    child.expect("importing")
    child.sendintr()
    child.expect("ended by Ctrl-C: no device was opened, nothing has moved; the outputs are as they were")
    assert ended(child) == 130


def test_ctrl_c_in_the_rehearsal_says_that_nothing_has_moved(start):
    child = start("run", "covering", "--rig", "sma", "--clock", "x60")
    child.expect("rehearsing covering on sma")
    child.sendintr()
    child.expect("ending the rehearsal; nothing has moved")
    child.expect("the rehearsal was ended by .*nothing has moved")
    assert ended(child) == 130
