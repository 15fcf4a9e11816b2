"""A guardian in a process of its own, in front of instruments in another one."""

import contextlib
import json
import os
import signal
import struct
import subprocess
import sys
import threading

import pytest
from benches import IN_TIME, LONG, TOOLS, connected, is_alive, is_on, rescuer_of, seconds_until

from bench.base import (
    AbortError,
    ConfigurationError,
    DeviceConnectionError,
    DeviceError,
    GuardianError,
    InterlockError,
    LimitError,
    VirtualClock,
)
from bench.execution.guardian.remote import RemoteStation
from bench.rig import Look, Rig, load_rig

pytestmark = [
    pytest.mark.usefixtures("warm_popen"),
    pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="signals of POSIX"),
]

SAFE = {"tec": "safe", "psd": "safe"}


@pytest.fixture
def station(vo2):
    """A station whose TEC is on; its guardian is gone at the end, and the laboratory as it was."""
    with contextlib.ExitStack() as stack:
        # The watchdog of the TEC would have to be cleared by hand, and whoever opens a T7 next waits for 3 s if it
        # was not released.
        stack.callback(vo2.control.fault, "psd.power-cycle")
        stack.callback(vo2.control.fault, "tec.power-cycle")

        def make(file=None, **overrides):
            made = stack.enter_context(connected(vo2, file, **overrides))
            # Before it is left: what makes them safe goes on until they can be reached.
            stack.callback(vo2.control.plug_in, "psd")
            stack.callback(vo2.control.plug_in, "tec")
            made.promise(LONG, "a test")
            made.apply({"tec": 40.0})
            assert is_on(vo2)
            return made

        yield make


def guardian_of(station):
    return station._process


def raw(station):
    """The bench's end of the channel, to send what no station sends."""
    return station._channel._socket


def awaits_safety(station, vo2):
    """Wait until the output is off, and the guardian has left with exit code 0."""
    took = seconds_until(lambda: not is_on(vo2))
    assert guardian_of(station).wait(LONG) == 0
    return took


class TestRequests:
    def test_description_readings_setpoints_and_arrivals(self, station, vo2):
        it = station()
        # As in this process.
        with contextlib.closing(Rig(load_rig("vo2"), VirtualClock(), 0)) as rig:
            assert it.description.devices == rig.description.devices
            assert it.description.signals == rig.description.signals
        values = it.look(Look.GLANCE)
        assert values.keys() == {signal.name for signal in it.description.signals}
        assert values["tec_setpoint"] == it.setpoint("tec") == 40.0
        assert it.quick_reader(["psd_position"])().keys() == {"psd_position", "curvature"}
        it.check({"tec": [15.0, 95.0]})
        with pytest.raises(LimitError, match="tec: set-point 99 °C is outside"):
            it.apply({"tec": 99.0})
        with pytest.raises(ConfigurationError, match="psd is not a device that takes a set-point"):
            it.apply({"psd": 1.0})
        # So far that a busy machine asks before it is there.
        it.apply({"tec": 90.0})
        assert it.arrivals().waiting == ("tec",)
        while it.arrivals().waiting:
            # In steps that the watchdog of the TEC allows.
            vo2.control.advance(1.0)
            it.look(Look.GLANCE)
        it.mover(["tec"])([41.0])
        assert it.setpoint("tec") == 41.0
        assert it.end() == SAFE
        assert not is_on(vo2)
        with pytest.raises(GuardianError):
            it.apply({"tec": 40.0})

    def test_outputs_off_for_a_while(self, station, vo2):
        remote = station()
        remote.rest()
        assert not is_on(vo2)
        remote.apply({"tec": 41.0})
        assert is_on(vo2)
        assert remote.setpoint("tec") == 41.0
        assert remote.end() == SAFE

    def test_a_rig_that_cannot_be_connected_is_refused_in_the_words_of_its_driver(self, vo2):
        vo2.control.fault("tec.unplug")
        try:
            with pytest.raises(DeviceConnectionError, match="tec: no answer"), connected(vo2):
                pass
        finally:
            vo2.control.plug_in("tec")

    def test_a_rig_file_that_was_edited_since_the_bench_read_it_is_refused(self, vo2, tmp_path):
        path = tmp_path / "vo2.toml"
        path.write_text('extends = "vo2"\n')
        file = load_rig(str(path))
        path.write_text('extends = "vo2"\n[safety]\nrate = 4.0\n')
        with pytest.raises(ConfigurationError, match="was changed while the run was prepared"):
            RemoteStation(VirtualClock(), file, str(path), {}, vo2.endpoints_file, 0, "a test")


class TestBenchGone:
    def test_end_of_file(self, station, vo2):
        it = station()
        raw(it).close()
        assert awaits_safety(it, vo2) < IN_TIME

    @pytest.mark.parametrize(
        "sent",
        [
            pytest.param(b"GET / HTTP/1.1\r\n\r\n", id="no frame"),
            pytest.param(struct.pack(">I", 10) + b'{"n": 7, "', id="torn JSON"),
        ],
    )
    def test_garbage(self, station, vo2, sent):
        it = station()
        raw(it).send(sent)
        assert awaits_safety(it, vo2) < IN_TIME

    def test_two_requests_at_once(self, station, vo2):
        it = station()
        body = json.dumps({"n": 7, "do": "look", "look": "measure", "wanted": []}).encode()
        raw(it).send(2 * (struct.pack(">I", len(body)) + body))
        assert awaits_safety(it, vo2) < IN_TIME

    def test_half_a_message_is_none(self, station, vo2):
        it = station()
        it.promise(0.5, "a test")
        raw(it).send(struct.pack(">I", 100) + b'{"n": ')
        assert seconds_until(lambda: not is_on(vo2)) < 0.5 + IN_TIME
        # It waits for the rest still.
        guardian_of(it).kill()
        guardian_of(it).wait(LONG)

    def test_unknown_requests_and_signals_meant_for_the_bench_change_nothing(self, station, vo2):
        it = station()
        with pytest.raises(Exception, match="KeyError: 'dance'"):
            it._ask("dance")
        with pytest.raises(Exception, match="KeyError"):
            it._ask("look")
        with pytest.raises(Exception, match="expected a time"):
            it._ask("promise", seconds=float("nan"), why="for ever")
        for name in ("SIGINT", "SIGHUP", "SIGQUIT", "SIGPIPE", "SIGUSR1", "SIGUSR2"):
            guardian_of(it).send_signal(signal.Signals[name])
            assert it.look(Look.GLANCE)["tec_setpoint"] == 40.0, name
            assert is_on(vo2)

    def test_a_child_of_the_bench_that_lives_on_keeps_nothing_on(self, vo2):
        """It keeps the bench's end of the channel open, so that the end of file never comes."""
        bench = subprocess.Popen(
            [sys.executable, str(TOOLS / "fork_and_die.py"), str(vo2.endpoints_file)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
        )
        child = None
        try:
            child = int(bench.stdout.readline())
            assert bench.wait(LONG) == -signal.SIGKILL
            assert seconds_until(lambda: not is_on(vo2)) < IN_TIME
            # It lives still.
            os.kill(child, 0)
        finally:
            bench.kill()
            bench.wait()
            bench.stdout.close()
            if child is not None:
                os.kill(child, signal.SIGKILL)
            vo2.control.fault("tec.power-cycle")


class TestPromises:
    def test_a_broken_one_is_the_safe_state_and_late_requests_are_refused(self, station, vo2, tmp_path):
        it = station()
        it.keep_record(tmp_path)
        it.promise(0.5, "a test computes")
        assert seconds_until(lambda: not is_on(vo2)) < 0.5 + IN_TIME
        for late in (lambda: it.apply({"tec": 41.0}), lambda: it.look(Look.GLANCE)):
            with pytest.raises(GuardianError, match=r"within the 0.5 s that it promised \(a test computes\)"):
                late()
        assert not is_on(vo2)
        assert it.end() == SAFE
        # Where this process stood.
        seconds_until(lambda: (tmp_path / "stacks.txt").stat().st_size > 0)
        assert "test_guardian.py" in (tmp_path / "stacks.txt").read_text()
        assert guardian_of(it).wait(LONG) == 0
        notes = [json.loads(line) for line in (tmp_path / "guardian.jsonl").read_text().splitlines()]
        kinds = [note["what"] for note in notes]
        assert kinds[0] == "begin"
        assert kinds[-1] == "end"
        assert kinds.index("look") < kinds.index("safe") < kinds.index("device")
        by_kind = {note["what"]: note for note in notes}
        assert by_kind["begin"]["rig"] == "vo2"
        assert by_kind["begin"]["process"] == guardian_of(it).pid
        assert any("tec_temperature" in note["values"] for note in notes if note["what"] == "look")
        assert "promised (a test computes)" in by_kind["safe"]["cause"]
        assert {note["device"]: note["state"] for note in notes if note["what"] == "device"} == SAFE
        assert by_kind["end"]["safe"] == SAFE


class TestInterlocks:
    @pytest.fixture
    def cautious(self, tmp_path):
        """The rig's file, with an interlock at 30 °C."""
        text = load_rig("vo2").text
        assert text.count("high = 100.0") == 1
        path = tmp_path / "vo2.toml"
        path.write_text(text.replace("high = 100.0", "high = 30.0"), encoding="utf-8")
        return str(path)

    def test_they_are_looked_at_while_the_bench_computes(self, station, vo2, cautious, tmp_path):
        it = station(file=cautious)
        it.keep_record(tmp_path)
        seconds_until(lambda: not is_on(vo2))
        with pytest.raises(InterlockError, match=r"tec_temperature = .* is outside of 5 to 30 °C"):
            it.look(Look.GLANCE)
        assert it.end() == SAFE

    def test_readings_of_the_bench_come_with_what_they_tripped(self, station, cautious):
        # No look of its own before the bench has looked.
        it = station(file=cautious, safety__rate="0.1")
        temperatures = [0.0]
        while max(temperatures) <= 30.0:
            temperatures.append(it.look(Look.GLANCE)["tec_temperature"])
        with pytest.raises(InterlockError):
            it.judge(0.0, {})
        assert it.end() == SAFE

    def test_a_blind_interlock_is_the_safe_state_of_what_can_be_reached(self, station, vo2):
        it = station(safety__reconnect="0.5")
        vo2.control.fault("tec.unplug")
        seconds_until(lambda: it._process.poll() is None and not is_on(vo2))
        # What comes first: the line counts as lost, or the TEC was not seen for too long.
        with pytest.raises(DeviceError, match=r"^tec: (no answer|could not be looked at)"):
            it.look(Look.GLANCE)
        states = it.end()
        assert states["psd"] == "safe"
        assert states["tec"] != "safe"
        # It goes on until the TEC is safe.
        assert guardian_of(it).poll() is None
        vo2.control.plug_in("tec")
        it.close()
        assert guardian_of(it).wait(LONG) == 0


class TestReconnection:
    def test_one_that_falls_silent_at_the_end_leaves_time_to_those_after_it(self, station, vo2):
        made = station(safety__order='["tec", "psd"]', devices__tec__timeout="2.0")
        vo2.control.fault("tec.hang")
        # A look at the interlocks waits for its answer then.
        vo2.control.wait(vo2.control.time() + 0.5)
        states = made.end()
        assert states["tec"] != "safe"
        assert states["psd"] == "safe"

    def test_a_line_that_comes_back_is_a_late_reply_and_news(self, station, vo2):
        it = station(devices__tec__watchdog="100", safety__reconnect="60")
        # It is lost after three requests of 0.2 s, and may be away for 2 s more. A guardian on a busy machine waits
        # longer for an answer, and a line that is back by then was not lost.
        for seconds in (1.0, 1.5, 2.0, 2.5, 2.5, 2.5):
            vo2.control.fault("tec.unplug")
            back = threading.Timer(seconds, vo2.control.plug_in, ["tec"])
            back.start()
            values = it.look(Look.GLANCE)
            back.join()
            assert values["tec_setpoint"] == 40.0
            assert is_on(vo2)
            it.look(Look.GLANCE)
            if any("tec: line lost for" in news.text for news in it.news()):
                return
        pytest.fail("no news of the line that was lost")

    def test_an_abandoned_request_is_not_taken_for_the_answer_to_the_end(self, station, vo2):
        it = station()
        vo2.control.fault("psd.hang")
        it.clock.interrupted = lambda: True
        try:
            with pytest.raises(AbortError, match="had not answered"):
                it.look(Look.MEASURE)
            assert set(it.end()) == {"tec", "psd"}
            assert it.end()["tec"] == "safe"
            assert not is_on(vo2)
        finally:
            vo2.control.plug_in("psd")
        it.close()
        assert guardian_of(it).wait(LONG) == 0


class TestGuardianGone:
    def test_asked_to_end(self, station, vo2):
        it = station()
        guardian_of(it).terminate()
        assert seconds_until(lambda: not is_on(vo2)) < IN_TIME
        with pytest.raises(GuardianError, match="asked to end by SIGTERM"):
            it.look(Look.GLANCE)
        assert it.end() == SAFE
        assert guardian_of(it).wait(LONG) == 0

    def test_killed(self, station, vo2):
        it = station()
        guardian_of(it).kill()
        with pytest.raises(GuardianError, match="was lost"):
            it.look(Look.GLANCE)
        assert it.end() == it.end() == SAFE
        assert not is_on(vo2)
        (news,) = [news for news in it.news() if news.kind == "guardian"]
        assert news.level == "ERROR"
        assert "was lost" in news.text

    def test_killed_while_somebody_edits_the_rig_file(self, station, vo2, tmp_path):
        path = tmp_path / "vo2.toml"
        path.write_text('extends = "vo2"\n')
        it = station(str(path))
        seconds_until(it._report.is_ready)
        path.write_text("[rig")
        guardian_of(it).kill()
        assert it.end() == SAFE
        assert not is_on(vo2)

    def test_stopped_while_the_bench_asks_for_nothing(self, station, vo2):
        """It is killed before the rescue, as it would keep the lines."""
        it = station()
        guardian_of(it).send_signal(signal.SIGSTOP)
        seconds_until(lambda: not is_on(vo2))
        with pytest.raises(GuardianError, match="was lost"):
            it.look(Look.GLANCE)
        assert it.end() == SAFE
        assert guardian_of(it).poll() == -signal.SIGKILL

    def test_killed_while_the_bench_is_stopped(self, vo2):
        bench = subprocess.Popen(
            [sys.executable, str(TOOLS / "fork_and_die.py"), str(vo2.endpoints_file), "stop"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            guardian = int(bench.stdout.readline())
            rescuer = rescuer_of(guardian)
            assert is_on(vo2)
            bench.send_signal(signal.SIGSTOP)
            os.kill(guardian, signal.SIGKILL)
            seconds_until(lambda: not is_on(vo2))
            seconds_until(lambda: not is_alive(rescuer))
        finally:
            bench.kill()
            bench.wait()
            bench.stdout.close()
            vo2.control.fault("tec.power-cycle")

    def test_without_a_rescuer(self, station, vo2):
        it = station()
        os.kill(rescuer_of(guardian_of(it).pid), signal.SIGKILL)
        it._report.path.unlink(missing_ok=True)
        guardian_of(it).kill()
        assert it.end() == SAFE
        assert not is_on(vo2)

    def test_a_rescuer_that_is_not_needed_leaves(self, station, vo2):
        it = station()
        rescuer = rescuer_of(guardian_of(it).pid)
        assert it.end() == SAFE
        it.close()
        seconds_until(lambda: not is_alive(rescuer))
        with connected(vo2):
            pass

    def test_a_rescue_that_fails_is_no_safe_state(self, station, vo2):
        it = station(safety__reconnect="0.5")
        seconds_until(it._report.is_ready)
        guardian_of(it).kill()
        vo2.control.fault("tec.unplug")
        assert "safe" not in it.end()["tec"].split()
