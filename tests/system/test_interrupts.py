import contextlib
import os
import pty
import signal
import subprocess
import sys
import threading

import pytest
from cases import cases
from places import SUPPORT

from bench.base import DataError, Interrupts
from bench.record import Record

pytestmark = pytest.mark.usefixtures("warm_popen")

PROTOCOLS = str(SUPPORT / "heater_protocols.py")


class TestFlags:
    def test_first_pauses_second_ends(self):
        told = []
        with Interrupts(told.append) as interrupts:
            assert not interrupts.pause_requested
            signal.raise_signal(signal.SIGINT)
            assert interrupts.pause_requested
            assert not interrupts.abort_requested()
            signal.raise_signal(signal.SIGINT)
            assert interrupts.abort_reason == "Ctrl-C, twice"
        assert len(told) == 2
        assert "pausing" in told[0]

    def test_after_a_resume_the_next_pauses_again(self):
        with Interrupts() as interrupts:
            signal.raise_signal(signal.SIGINT)
            interrupts.pause_requested = False
            signal.raise_signal(signal.SIGINT)
            assert interrupts.pause_requested
            assert not interrupts.abort_requested()

    @cases("name", ["SIGTERM", "SIGHUP", "SIGUSR1"])
    def test_the_system_ends_at_once(self, name):
        with Interrupts() as interrupts:
            signal.raise_signal(getattr(signal, name))
            assert interrupts.abort_requested()
            assert interrupts.abort_reason == name

    def test_no_signal_but_a_defect_ends_the_process_itself(self):
        broken = {signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGSEGV, signal.SIGSYS}
        not_caught = {signal.SIGKILL, signal.SIGSTOP}
        code = (
            "import signal, sys, time\n"
            "from bench.base.interrupts import Interrupts\n"
            "with Interrupts() as interrupts:\n"
            "    for number in map(int, sys.argv[1:]):\n"
            "        signal.raise_signal(number)\n"
            "    print('lives', interrupts.abort_requested())\n"
        )
        # Those that stop a process are not sent, as nobody would continue it.
        stopping = {signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU, signal.SIGTRAP}
        sent = signal.valid_signals() - broken - not_caught - stopping
        command = [sys.executable, "-c", code, *(str(int(number)) for number in sent)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout) == (0, "lives True\n"), done.stderr

    def test_former_handlers_come_back(self):
        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        before = [signal.getsignal(number) for number in numbers]
        with Interrupts():
            assert [signal.getsignal(number) for number in numbers] != before
        assert [signal.getsignal(number) for number in numbers] == before

    def test_what_is_ignored_stays_ignored(self):
        # As by nohup.
        former = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        try:
            with Interrupts() as interrupts:
                signal.raise_signal(signal.SIGHUP)
                assert not interrupts.abort_requested()
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        finally:
            signal.signal(signal.SIGHUP, former)

    def test_a_terminal_that_is_gone_raises_nothing(self):
        def gone(text):
            raise OSError(5, "Input/output error")

        with Interrupts(gone) as interrupts:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            assert interrupts.abort_requested()

    def test_in_another_thread_it_watches_nothing(self):
        before = signal.getsignal(signal.SIGTERM)
        seen = []

        def work():
            with Interrupts() as interrupts:
                seen.append(signal.getsignal(signal.SIGTERM))
                seen.append(interrupts.abort_requested())

        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        assert seen == [before, False]


AT_ITS_TERMINAL = """
import fcntl, runpy, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
del sys.argv[0]
runpy.run_path(sys.argv[0], run_name="__main__")
"""
"""Program that makes its standard input the terminal of its session, and runs a script."""


class Process:
    """A run in a process of its own, on the wall clock."""

    def __init__(self, tmp_path, rig, protocol, *settings, clock="wall", terminal=False, **keys):
        self.folder = tmp_path / "runs"
        self.witness = tmp_path / "witness.txt"
        script = str(SUPPORT / "run_heater.py")
        command = [script, str(self.folder), rig, clock, f"{PROTOCOLS}:{protocol}"]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(SUPPORT), str(SUPPORT.parents[1])])}
        self.terminal = None
        if terminal:
            self.terminal, inner = pty.openpty()
            streams = {"stdin": inner, "stdout": inner, "stderr": inner, "start_new_session": True}
            command = ["-c", AT_ITS_TERMINAL, *command]
        else:
            streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        self.process = subprocess.Popen([sys.executable, *command, *settings], env=environment, **streams, **keys)
        if terminal:
            os.close(inner)
        self.output = ""

    def until(self, text):
        """Read on until the process has said something."""
        number = self.terminal if self.terminal is not None else self.process.stdout.fileno()
        while text not in self.output:
            try:
                piece = os.read(number, 4096)
            except OSError:
                piece = b""
            if not piece:
                raise AssertionError(f"it never said {text!r}: {self.output}")
            self.output += piece.decode(errors="replace")

    def until_it_holds(self):
        """Wait until the run stands in a hold, as its journal tells."""
        while True:
            assert self.process.poll() is None
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(0.05)
            with contextlib.suppress(ValueError, DataError, FileNotFoundError), self.record() as run:
                if len(run.telemetry()) > 0:
                    return

    def send(self, number):
        self.process.send_signal(number)

    def end(self):
        """Read to the end; return the exit code."""
        with contextlib.suppress(AssertionError):
            self.until("\0")
        return self.process.wait(60)

    def record(self):
        (folder,) = self.folder.iterdir()
        return Record(folder)

    def safe_devices(self):
        return self.witness.read_text().split() if self.witness.exists() else []

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        if self.process.stdout:
            self.process.stdout.close()
        if self.terminal is not None:
            os.close(self.terminal)


@pytest.fixture
def start(tmp_path, rig_file):
    started = []

    def make(*arguments, **keys):
        witness = tmp_path / "witness.txt"
        path = rig_file(
            ('port = "emulated://heater"', f'port = "emulated://heater"\nwitness = "{witness}"'),
            ('port = "emulated://thermometer"', f'port = "emulated://thermometer"\nwitness = "{witness}"'),
        )
        # The bench guards that real devices see the wall clock; these are emulated and may see any.
        started.append(Process(tmp_path, path, *arguments, **keys))
        return started[-1]

    yield make
    for process in started:
        process.close()


class TestProcesses:
    def assert_aborted(self, process, reason, code=130):
        assert process.end() == code, process.output
        assert sorted(process.safe_devices()) == ["probe", "tec"]
        with process.record() as run:
            assert run.status == "aborted"
            assert reason in run.meta["reason"]
            assert run.meta["safe_state"] == {"tec": "safe", "probe": "safe"}
            return len(run.steps())

    def test_ctrl_c_once_without_a_terminal_ends_at_the_next_step(self, start):
        process = start("stairs", "dwell=0.5", "count=1000", "increment=0.05")
        process.until("step 0 at")
        process.send(signal.SIGINT)
        steps = self.assert_aborted(process, "no operator is present")
        assert "pausing" in process.output
        assert 1 <= steps < 100

    def test_ctrl_c_twice_ends_at_once(self, start):
        process = start("stairs", "dwell=3000")
        process.until_it_holds()
        process.send(signal.SIGINT)
        process.send(signal.SIGINT)
        assert self.assert_aborted(process, "Ctrl-C") == 0

    def test_the_system_ends_it_at_once(self, start):
        process = start("settle", "minimum=3000", "timeout=3600", clock="x2")
        process.until_it_holds()
        process.send(signal.SIGTERM)
        assert self.assert_aborted(process, "SIGTERM") == 0

    def test_killed_it_leaves_what_was_finished(self, start):
        process = start("stairs", "dwell=0.02", "count=2000", "increment=0.02")
        process.until("step 20 at")
        process.send(signal.SIGKILL)
        assert process.end() == -signal.SIGKILL
        assert process.safe_devices() == []
        with process.record() as run:
            assert run.status == "unfinished"
            steps = run.steps()["step"].tolist()
            assert steps == list(range(len(steps)))
            assert len(steps) >= 21
            assert run.meta["protocol"] == "stairs"

    def paused(self, start, *arguments):
        process = start(*arguments, terminal=True)
        process.until("step 0 at")
        os.write(process.terminal, b"\x03")
        process.until("PAUSED for")
        return process

    def test_at_a_terminal_ctrl_c_twice(self, start):
        # The question is left open while the process ends.
        process = self.paused(start, "stairs", "dwell=0.3", "count=500", "increment=0.1")
        os.write(process.terminal, b"\x03")
        self.assert_aborted(process, "Ctrl-C, twice")
        assert "Fatal" not in process.output

    def test_the_terminal_is_closed(self, start):
        process = start("stairs", "dwell=0.3", "count=2000", "increment=0.02", terminal=True)
        process.until("step 0 at")
        os.close(process.terminal)
        process.terminal = None
        process.process.wait(60)
        assert sorted(process.safe_devices()) == ["probe", "tec"]
        with process.record() as run:
            assert run.status == "aborted"
            assert run.meta["reason"] == "ended by SIGHUP"

    def test_without_any_standard_input(self, start):
        process = start("stairs", "dwell=0.1", clock="virtual", preexec_fn=lambda: os.close(0))
        assert process.end() == 0, process.output


@pytest.mark.skipif(sys.platform == "win32", reason="sends signals of POSIX")
def test_ctrl_c_while_the_command_loads_is_one_line():
    # Python itself reports what has been imported: numpy and typer come while the command loads.
    command = [sys.executable, "-v", "-P", "-m", "bench", "list"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        for line in process.stderr:
            if "import 'bench.cli'" in line or "import 'typer" in line:
                process.send_signal(signal.SIGINT)
                break
        rest = process.stderr.read()
    assert process.returncode == 130
    assert "Traceback" not in rest
    assert "ended by Ctrl-C: no device was opened, nothing has moved" in rest
