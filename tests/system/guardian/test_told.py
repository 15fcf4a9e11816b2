"""A bench that hangs or dies is told of by its guardian; its rig is free, and its record says what became of it."""

import contextlib
import json
import os
import re
import signal
import sys
from functools import partial

import pytest
from benches import IN_TIME, LONG, check_at_once, connected, is_alive, is_on, seconds_until
from guarded_run import SETPOINTS, GuardedRun
from kill_safe import DEATH, PATIENCE, PROMISE

from bench.analysis import list_runs
from bench.base import ConfigurationError
from bench.record import BLACK_BOX_NAME, Record, ending_of
from bench.rig import is_in_use, load_rig, opened
from sim_devices.serving.process import serve

pytestmark = [
    pytest.mark.usefixtures("warm_popen"),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it looks for processes as on Linux"),
]

TOKEN = "T0K3N"

SAFE = {"tec": "safe", "psd": "safe"}

HUNG = r"the bench hung: it has not come back within the \d s that it promised \(.*\)"
GONE = "the bench is gone: its process was killed, crashed or left"


def start_telling(rig, protocol, *targets):
    """Start a run that switches everything on, and tells targets of its end."""
    parameters = {"setpoints": json.dumps(SETPOINTS["vo2"])}
    options = [f"--notify={target}" for target in targets]
    return GuardedRun(rig, protocol, {"safety.patience": "3"}, parameters, options=options)


@pytest.fixture
def listener(tmp_path):
    """A program that writes down what it is told, a line each time; its command, and what it has written."""
    return make_listener(tmp_path)


def make_listener(folder):
    out = folder / "told.jsonl"
    program = folder / "listen.py"
    program.write_text(
        "import json, sys\n"
        "facts = json.loads(sys.stdin.buffer.read())\n"
        f"with open({str(out)!r}, 'a') as file:\n"
        "    file.write(json.dumps(facts) + '\\n')\n"
    )

    def told():
        return [json.loads(line) for line in out.read_text().splitlines()] if out.exists() else []

    return f'"{sys.executable}" "{program}" {TOKEN}', told


@pytest.fixture
def started(vo2, listener):
    """What starts a run that switches everything on, and tells the listener and one that cannot be reached."""

    def start(protocol, *targets):
        return start_telling(vo2, protocol, *(targets or (f"http://127.0.0.1:1/{TOKEN}", listener[0])))

    yield start
    for instrument in vo2.instruments:
        vo2.control.fault(f"{instrument}.power-cycle")


ENDINGS = {
    "endless loop": ("spin", None, HUNG, PATIENCE),
    "SIGSTOP": ("hold", signal.SIGSTOP, HUNG, PROMISE),
    "SIGKILL": ("hold", signal.SIGKILL, GONE, DEATH),
    "os._exit(0)": ("leave", None, GONE, DEATH),
}
"""By name: what runs, what the bench is sent, what is told, and the time within which the outputs are off, s."""


def test_it_is_told_once_and_recorded_and_the_rig_is_free(tmp_path):
    check_at_once(ENDINGS, partial(check_what_is_told, tmp_path))


def check_what_is_told(folder, name):
    protocol, sent, reason, within = ENDINGS[name]
    own = folder / protocol / str(sent)
    own.mkdir(parents=True)
    command, told = make_listener(own)
    with serve("vo2", clock="x1") as rig, start_telling(rig, protocol, f"http://127.0.0.1:1/{TOKEN}", command) as run:
        run.await_on(1)
        if sent is not None:
            run.process.send_signal(sent)
        assert seconds_until(lambda: not is_on(rig)) < within + IN_TIME
        seconds_until(told)
        # By its guardian, where it has not ended by itself.
        run.process.wait(LONG)
        assert run.has_freed_lines()
        assert not is_in_use(run.folder)
        (facts,) = told()
        assert facts["event"] == "end"
        assert re.fullmatch(rf"failed: {reason}; tec: safe, psd: safe", facts["text"])
        assert (facts["run"], facts["rig"], facts["protocol"]) == (str(run.folder), "vo2", protocol)
        assert facts["t"] > 0
        assert facts["values"]["tec_temperature"] > 0
        with Record(run.folder) as record:
            assert record.status == "failed"
            # What the bench has written as it was asked to end says the same.
            assert record.meta.get("status", "failed") == "failed"
            assert re.fullmatch(reason, record.reason)
            assert record.safe_state == SAFE
        (listed,) = list_runs(run.folder)
        assert (listed.status, listed.result) == ("failed", record.reason)
        notes = (run.folder / BLACK_BOX_NAME).read_text(encoding="utf-8")
        assert "http://127.0.0.1/… was not told of the end" in notes
        texts = [run.said, *(path.read_bytes().decode(errors="replace") for path in run.folder.rglob("*.*"))]
        assert not [text for text in texts if TOKEN in text]


def test_its_rescuer_tells_it_if_the_guardian_is_killed_as_well(vo2, started, listener):
    _, told = listener
    with started("hold") as run:
        run.await_on(1)
        run.process.send_signal(signal.SIGSTOP)
        os.kill(run.guardian, signal.SIGKILL)
        run.process.kill()
        seconds_until(lambda: not is_on(vo2))
        seconds_until(told)
        (facts,) = told()
        assert (facts["event"], facts["run"], facts["rig"]) == ("end", str(run.folder), "vo2")
        assert facts["text"].endswith("; tec: safe, psd: safe")


def test_a_bench_that_comes_back_does_not_tell_it_again(started, listener):
    _, told = listener
    with started("hold") as run:
        run.await_on(1)
        run.process.send_signal(signal.SIGSTOP)
        seconds_until(told)
        run.process.send_signal(signal.SIGCONT)
        run.process.wait(LONG)
        assert run.has_freed_lines()
        assert len(told()) == 1
        with Record(run.folder) as record:
            # Its own record, if the guardian did not have to end it.
            assert record.meta.get("status") in ("failed", "aborted", None)
            assert record.safe_state == SAFE


def test_the_rig_is_free_before_a_slow_message_is_sent(vo2, started, tmp_path):
    begun, go = tmp_path / "begun", tmp_path / "go"
    program = tmp_path / "slow.py"
    program.write_text(
        "import pathlib, time\n"
        f"pathlib.Path({str(begun)!r}).touch()\n"
        f"while not pathlib.Path({str(go)!r}).exists():\n"
        "    time.sleep(0.05)\n"
    )

    def is_free():
        # Its lines are locked and nothing is sent, as a message is waited for no longer than a busy machine starts.
        with contextlib.suppress(ConfigurationError), opened(load_rig("vo2"), vo2.endpoints_file, "a test"):
            return True
        return False

    with started("hold", f'"{sys.executable}" "{program}"') as run:
        run.await_on(1)
        run.process.kill()
        try:
            seconds_until(begun.exists)
            seconds_until(is_free)
            assert is_alive(run.guardian)
        finally:
            go.touch()
        assert run.has_freed_lines()
        assert "was not told" not in (run.folder / BLACK_BOX_NAME).read_text(encoding="utf-8")


@pytest.mark.parametrize("leaves", [True, False])
def test_a_run_that_was_refused_has_not_died(vo2, listener, tmp_path, leaves):
    command, told = listener
    with connected(vo2) as station:
        station.keep_record(tmp_path, [command], {"rig": "vo2", "protocol": "none"})
        if leaves:
            station.close()
        else:
            station._channel.close()
        station._process.wait(LONG)
    assert [facts["text"] for facts in told()] == (
        [] if leaves else ["failed: the bench is gone (the other side is gone); tec: safe, psd: safe"]
    )
    assert (ending_of(tmp_path) is None) is leaves


def test_a_device_that_cannot_be_reached_is_not_called_safe(vo2, listener, tmp_path):
    command, told = listener
    try:
        with connected(vo2) as station:
            station.keep_record(tmp_path, [command], {"rig": "vo2", "protocol": "none"})
            station.promise(LONG, "a test")
            station.apply({"tec": 40.0})
            vo2.control.fault("tec.unplug")
            station._channel.close()
            seconds_until(told)
            assert ending_of(tmp_path).safe_state["tec"] != "safe"
            # It goes on until the TEC is safe, and tells no more.
            vo2.control.plug_in("tec")
            station._process.wait(LONG)
            assert ending_of(tmp_path).safe_state == SAFE
    finally:
        vo2.control.plug_in("tec")
        vo2.control.fault("tec.power-cycle")
    (facts,) = told()
    assert re.search(r"; tec: NOT CONFIRMED SAFE, .*, psd: safe$", facts["text"])
