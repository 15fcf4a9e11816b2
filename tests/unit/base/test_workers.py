"""Tasks in worker processes: their results, their deaths, and their ends."""

import io
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import worker_tasks
from cases import cases
from places import SUPPORT
from rich.console import Console

from bench.base import AbortError, BenchError, DeviceError, TasksDisplay, Workers, available_cores
from bench.record import Record

pytestmark = pytest.mark.usefixtures("warm_popen")

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="asks the system for processes by their number")


def there(number):
    """Whether a process is there, and no zombie."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_until(condition):
    for _ in range(6000):
        if condition():
            return
        threading.Event().wait(0.01)
    raise AssertionError("did not come about within a minute")


@pytest.fixture(scope="module")
def text():
    return io.StringIO()


@pytest.fixture(scope="module")
def workers(text):
    with Workers(2, Console(file=text, width=200)) as workers:
        yield workers


def test_a_task_in_a_hurry_is_begun_before_all_that_wait(text):
    begun = []
    with Workers(1, Console(file=text)) as alone:
        first, second, third = (alone.submit(name, begun.append, name) for name in ("first", "second", "third"))
        third.hurry()
        first.result()
        assert begun == ["third", "first"]
        # Too late for those that are finished.
        third.hurry()
        second.result()
    assert begun == ["third", "first", "second"]


def test_a_task_in_a_hurry_is_the_next_of_a_worker_process(tmp_path):
    with Workers(2) as workers:
        # One of the two has something to do until the end.
        waiting = workers.submit("meet", worker_tasks.meet, tmp_path)
        tasks = [workers.submit("ordinal", worker_tasks.ordinal) for _ in range(10)]
        tasks[-1].hurry()
        # The first one may have been begun.
        assert tasks[-1].result() <= 1
        assert tasks[1].result() == 2
        workers.submit("meet", worker_tasks.meet, tmp_path).result()
        waiting.result()


def test_workers_without_a_task_end():
    with Workers(2) as workers:
        pass
    assert not workers._processes


def test_results_come_in_the_order_in_which_they_are_taken_from_processes_that_go_on(workers):
    tasks = [workers.submit("process", worker_tasks.process, value) for value in range(20)]
    results = [task.result() for task in tasks]
    assert [value for value, _ in results] == list(range(20))
    processes = {number for _, number in results}
    assert 1 <= len(processes) <= 2
    assert os.getpid() not in processes


def test_results_come_as_tasks_finish(workers):
    tasks = [workers.submit("process", worker_tasks.process, value) for value in range(5)]
    found = set()
    while tasks:
        found.add((done := workers.wait_for(tasks)).result()[0])
        tasks.remove(done)
    assert found == set(range(5))


def test_a_result_is_the_same_in_a_worker_as_here(workers):
    with Workers(1) as alone:
        here = alone.submit("product", worker_tasks.product, 300).result()
    assert np.array_equal(workers.submit("product", worker_tasks.product, 300).result(), here)


def test_what_a_task_says_is_printed_and_what_it_prints_does_no_harm(workers, text):
    workers.submit("speak", worker_tasks.speak, "a word of it").result()
    wait_until(lambda: "a word of it is said\n" in text.getvalue())
    assert "not for the bench" not in text.getvalue()


def test_an_error_of_the_bench_comes_back_as_it_is(workers):
    with pytest.raises(DeviceError, match=r"^tec: answers with an error$") as caught:
        workers.submit("fail", worker_tasks.fail, "tec").result()
    assert caught.value.device == "tec"
    assert not hasattr(caught.value, "__notes__")


def test_a_defect_comes_back_with_its_traceback(workers):
    with pytest.raises(ValueError, match="a defect") as caught:
        workers.submit("break_down", worker_tasks.break_down).result()
    assert "in break_down" in caught.value.__notes__[0]


def test_the_task_of_a_killed_worker_is_done_again_twice(workers, tmp_path):
    for name in "ab":
        (tmp_path / name).touch()
    assert workers.submit("die", worker_tasks.die, tmp_path).result() == "done"


def test_a_task_that_kills_three_workers_fails_and_the_others_go_on(workers, tmp_path):
    for name in "abcd":
        (tmp_path / name).touch()
    deadly = workers.submit("the deadly one", worker_tasks.die, tmp_path)
    others = [workers.submit("process", worker_tasks.process, value) for value in range(5)]
    assert [task.result()[0] for task in others] == list(range(5))
    with pytest.raises(BenchError, match=r"^the deadly one: its worker process died 3 times, the last time by "):
        deadly.result()
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


def test_a_function_that_cannot_be_sent_is_refused_at_once(workers):
    with pytest.raises((pickle.PicklingError, AttributeError)):
        workers.submit("none", lambda: 1)


def test_a_function_of_a_script_is_refused_at_once(workers, monkeypatch):
    monkeypatch.setattr(worker_tasks.process, "__module__", "__main__")
    with pytest.raises(TypeError, match="put it into a module"):
        workers.submit("process", worker_tasks.process, 1)


def test_one_worker_is_this_process():
    with Workers(1) as workers:
        assert workers.submit("process", worker_tasks.process, 1).result() == (1, os.getpid())
        late = workers.submit("process", worker_tasks.process, 2)
        assert not late.done()
    assert late.result() == (2, os.getpid())


@cases("number", [1, 2])
def test_the_end_raises_what_nobody_has_asked_for(number):
    with pytest.raises(DeviceError), Workers(number) as workers:
        workers.submit("fail", worker_tasks.fail, "tec")


def test_a_terminal_shows_each_task_that_runs_and_how_many_are_finished():
    text = io.StringIO()
    display = TasksDisplay(Console(file=text, width=120, force_terminal=True), "study")
    for _ in range(3):
        display.add()
    display.start()
    first = display.begin("tracking controller=latched")
    second = display.begin("creep")
    display.advance(first, 3, 60, "curvature 12.5 1/m")
    display.end(second)
    display.stop()
    last = text.getvalue().rpartition("study")[2]
    assert "1/3" in last
    assert re.search(r"tracking controller=latched.*curvature 12.5 1/m.*3/60", last)
    assert "creep" not in last


def test_there_are_as_many_as_cores():
    assert Workers().number == available_cores() >= 1


@POSIX
def test_an_exception_ends_all_processes(tmp_path):
    def leave():
        with Workers(2) as workers:
            for _ in range(3):
                workers.submit("wait", worker_tasks.wait, tmp_path)
            wait_until(lambda: len(list(tmp_path.iterdir())) == 2)
            raise KeyError

    with pytest.raises(KeyError):
        leave()
    assert not any(there(path.name) for path in tmp_path.iterdir())


def test_a_signal_ends_the_runs_in_their_safe_state(tmp_path):
    def interrupt():
        with Workers(2) as workers:
            runs = [workers.submit("run", worker_tasks.run, tmp_path) for _ in range(2)]
            wait_until(lambda: len(list(tmp_path.glob("*/journal.sqlite-wal"))) == 2)
            signal.raise_signal(signal.SIGINT)
            runs[0].result()

    with pytest.raises(AbortError, match=r"^ended by Ctrl-C$"):
        interrupt()
    for folder in tmp_path.iterdir():
        with Record(folder) as record:
            assert record.status == "aborted"
            assert record.meta["safe_state"] == {"tec": "safe", "psd": "safe"}


@POSIX
def test_the_workers_of_a_killed_bench_end(tmp_path):
    bench = subprocess.Popen([sys.executable, SUPPORT / "run_workers.py", tmp_path])
    wait_until(lambda: len(list(tmp_path.iterdir())) == 2)
    bench.kill()
    bench.wait()
    wait_until(lambda: not any(there(path.name) for path in tmp_path.iterdir()))
