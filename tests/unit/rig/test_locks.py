"""Locks of lines and instruments: one bench each, whatever name it uses; freed by the death of the holder."""

import errno
import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from cases import cases

from bench.base import ConfigurationError
from bench.devices import Identity
from bench.rig import Holder, Locks, is_in_use, line_names

HOLDER = """
import subprocess, sys
from bench.rig import Holder, Locks
locks = Locks(Holder.of_this_process("other", "recordings/other-creep"))
locks.take_lines(sys.argv[1:])
child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=sys.stdin, close_fds=False)
print(child.pid, flush=True)
child.wait()
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """A folder for locks of this test's own."""
    folder = tmp_path / "shared"
    folder.mkdir()
    monkeypatch.setenv("ACTUATOR_BENCH_LOCKS", str(folder))
    return folder


@pytest.fixture
def locks():
    """Make locks of a rig; all are freed at the end."""
    made = []

    def make(rig):
        made.append(Locks(Holder.of_this_process(rig, "bench test")))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def holding():
    """Hold lines in another process, which has started a program; give both."""
    processes = []

    def hold(*ports):
        command = [sys.executable, "-P", "-c", HOLDER, *map(str, ports)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        processes.append(process)
        return process, int(process.stdout.readline())

    yield hold
    for process in processes:
        process.kill()
        process.communicate()


def port(path):
    path.touch()
    return str(path)


class TestNames:
    def test_a_link_is_the_node_behind_it(self, tmp_path):
        node = port(tmp_path / "ttyUSB0")
        (tmp_path / "by-id").symlink_to(node)
        (tmp_path / "further").symlink_to(tmp_path / "by-id")
        assert line_names(node) == line_names(str(tmp_path / "further")) != line_names(port(tmp_path / "ttyUSB1"))

    def test_a_relative_path_is_the_absolute_one(self, tmp_path, monkeypatch):
        node = port(tmp_path / "ttyUSB0")
        monkeypatch.chdir(tmp_path)
        assert line_names("./ttyUSB0") == line_names("ttyUSB0") == line_names(node)

    @cases(
        "other",
        [
            "socket://127.0.0.1:502",
            "tcp://localhost:502",
            "tcp://LOCALHOST:502/",
            "tcp://[::1]:502",
            "tcp://localhost",
            "tcp://[::ffff:127.0.0.1]:502",
            "rfc2217://localhost:502?ign_set_control",
            "visa://TCPIP0::127.0.0.1::502::SOCKET",
        ],
    )
    def test_a_host_name_is_its_address(self, other):
        assert set(line_names("tcp://127.0.0.1:502")) & set(line_names(other))

    def test_names_and_addresses_of_this_computer_are_one(self):
        try:
            socket.getaddrinfo(socket.gethostname(), 502)
        except OSError:
            pytest.skip("the name of this computer has no address")
        assert set(line_names(f"tcp://{socket.gethostname()}:502")) & set(line_names("tcp://127.0.0.1:502"))

    @cases("other", ["tcp://127.0.0.1:503", "tcp://192.0.2.7:502", "/dev/ttyUSB0", "COM3"])
    def test_other_lines_have_other_names(self, other):
        assert not set(line_names("tcp://127.0.0.1:502")) & set(line_names(other))

    def test_visa_names_a_serial_port(self, tmp_path):
        node = port(tmp_path / "ttyUSB0")
        assert line_names(f"ASRL{node}::INSTR") == line_names(node)
        assert line_names("visa://ASRL3::INSTR") == line_names("com3") == line_names("COM3")
        assert line_names("GPIB0::24::INSTR") == line_names("visa://gpib0::24::instr")

    def test_an_instrument_in_this_process_has_no_line(self):
        assert line_names("emulated://tec") == line_names("") == ()


class TestOneHolder:
    def test_another_bench_is_refused_until_the_lock_is_freed(self, locks, tmp_path):
        one, other = locks("one"), locks("other")
        node = port(tmp_path / "ttyUSB0")
        one.take_lines([node])
        one.take_lines([node])
        with pytest.raises(ConfigurationError, match=r"^rig other is in use: line .*ttyUSB0 is held by .*rig one"):
            other.take_lines([node])
        one.close()
        other.take_lines([node])

    def test_all_lines_or_none(self, locks, tmp_path):
        nodes = [port(tmp_path / name) for name in "abc"]
        locks("one").take_lines([nodes[2]])
        with pytest.raises(ConfigurationError, match="in use"):
            locks("other").take_lines(nodes)
        locks("third").take_lines(nodes[:2])

    def test_devices_on_one_line_take_it_once(self, locks):
        locks("one").take_lines(["tcp://127.0.0.1:502", "tcp://localhost:502", "emulated://x"])

    def test_an_instrument_on_another_line_is_found(self, locks):
        tec = Identity("Meerstetter Engineering", "TEC-1091", "12", "4.10")
        locks("one").take_instrument(tec)
        with pytest.raises(ConfigurationError, match="in use: Meerstetter Engineering TEC-1091, serial number 12 is"):
            locks("other").take_instrument(tec)
        locks("other").take_instrument(Identity("Meerstetter Engineering", "TEC-1091", "13", "4.10"))

    @pytest.mark.parametrize("number", ["12", " 12 ", "A0", "1"])
    def test_a_serial_number_tells_an_instrument_from_others(self, locks, number):
        tec = Identity("Meerstetter Engineering", "TEC-1091", number, "4.10")
        locks("one").take_instrument(tec)
        with pytest.raises(ConfigurationError, match=f"serial number {number.strip()} is"):
            locks("other").take_instrument(tec)

    @pytest.mark.parametrize("number", ["unknown", "", "id 1", "0"])
    def test_what_has_no_serial_number_is_not_mistaken(self, locks, number):
        for rig in ("one", "other"):
            locks(rig).take_instrument(Identity("Roboteq", "SDC2160", number, "2.0"))

    def test_nothing_is_left_behind(self, locks, tmp_path, folder):
        one = locks("one")
        one.take_lines([port(tmp_path / "a"), "tcp://127.0.0.1:502"])
        assert len(list(folder.iterdir())) == 2
        one.close()
        assert list(folder.iterdir()) == []


class TestProcesses:
    def test_the_refused_one_learns_who_it_is(self, holding, locks, tmp_path):
        node = port(tmp_path / "ttyUSB0")
        process, _ = holding(node)
        with pytest.raises(ConfigurationError) as caught:
            locks("mine").take_lines([node])
        for word in (f"process {process.pid}", "recordings/other-creep", "rig other", " on ", "since 20", "end it"):
            assert word in str(caught.value)

    def test_a_killed_holder_holds_nothing_although_its_program_lives_on(self, holding, locks, tmp_path):
        node = port(tmp_path / "ttyUSB0")
        process, child = holding(node)
        process.kill()
        process.wait()
        os.kill(child, 0)
        locks("mine").take_lines([node])
        os.kill(child, signal.SIGKILL)

    def test_a_stopped_holder_still_holds(self, holding, locks, tmp_path):
        node = port(tmp_path / "ttyUSB0")
        process, _ = holding(node)
        process.send_signal(signal.SIGSTOP)
        with pytest.raises(ConfigurationError, match="in use"):
            locks("mine").take_lines([node])

    def test_what_a_dead_holder_wrote_is_replaced(self, holding, locks, tmp_path, folder):
        node = port(tmp_path / "ttyUSB0")
        process, _ = holding(node)
        process.kill()
        process.wait()
        locks("mine").take_lines([node])
        (file,) = folder.iterdir()
        assert json.loads(file.read_text())["rig"] == "mine"

    def test_one_of_many_that_ask_at_once_has_all_lines(self, tmp_path, warmly):
        ports = [port(tmp_path / name) for name in "abcde"]
        code = HOLDER.replace("child = ", "input(); sys.exit(print('has'))\nchild = ")
        # Each in an order of its own.
        commands = [[sys.executable, "-P", "-c", code, *ports[i:], *ports[:i]] for i in range(5)]
        ends = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        with warmly():
            processes = [subprocess.Popen(command, text=True, **ends) for command in commands]
        refused = 0
        holders = list(processes)
        while len(holders) > 1:
            for process in list(holders):
                try:
                    process.wait(0.2)
                except subprocess.TimeoutExpired:
                    continue
                assert "in use" in process.stderr.read()
                refused += 1
                holders.remove(process)
        out, _ = holders[0].communicate("\n", timeout=60)
        assert (refused, out) == (4, "has\n")
        for process in processes:
            process.stdin.close()
            process.stdout.close()
            process.stderr.close()


@pytest.mark.skipif(sys.platform == "win32", reason="needs links, pipes and users of POSIX")
class TestOtherUsers:
    """Everybody adds files to the folder of the locks: nothing of another user is followed, written or believed."""

    @pytest.fixture
    def lock(self, locks, tmp_path, folder):
        """Return the path of the lock of a line, and the line."""
        node = port(tmp_path / "ttyUSB0")
        one = locks("one")
        one.take_lines([node])
        (path,) = folder.iterdir()
        one.close()
        return path, node

    @pytest.fixture
    def strange(self, monkeypatch):
        """Make a file one of another user."""

        def give_away(path):
            if os.geteuid() == 0:
                os.chown(path, 65534, -1)
            else:
                monkeypatch.setattr(os, "geteuid", lambda: 65533)

        return give_away

    def test_the_folder_does_not_depend_on_the_environment_of_a_user(self, monkeypatch, tmp_path):
        monkeypatch.delenv("ACTUATOR_BENCH_LOCKS")
        monkeypatch.setenv("TMPDIR", str(tmp_path))
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
        node = port(tmp_path / "ttyUSB0")
        with Locks(Holder.of_this_process("one", "bench test")) as held:
            held.take_lines([node])
            monkeypatch.setenv("TMPDIR", str(tmp_path / "other"))
            with pytest.raises(ConfigurationError, match="in use"):
                Locks(Holder.of_this_process("other", "bench test")).take_lines([node])

    @pytest.mark.parametrize("exists", [True, False])
    def test_a_link_is_not_followed(self, lock, locks, tmp_path, exists):
        path, node = lock
        target = tmp_path / "target"
        if exists:
            target.write_text("precious")
        path.symlink_to(target)
        with pytest.raises(ConfigurationError, match="it is a link; remove it"):
            locks("mine").take_lines([node])
        assert target.exists() == exists
        assert not exists or target.read_text() == "precious"

    def test_a_second_name_of_a_file_is_not_written(self, lock, locks, tmp_path):
        path, node = lock
        target = tmp_path / "target"
        target.write_text("precious")
        path.hardlink_to(target)
        with pytest.raises(ConfigurationError, match="remove it"):
            locks("mine").take_lines([node])
        assert target.read_text() == "precious"

    def test_a_pipe_keeps_nobody_waiting(self, lock, locks):
        path, node = lock
        os.mkfifo(path)
        with pytest.raises(ConfigurationError, match="remove it"):
            locks("mine").take_lines([node])

    def test_a_file_of_another_user_is_locked_but_not_written(self, lock, locks, strange):
        path, node = lock
        path.write_text("theirs")
        strange(path)
        locks("mine").take_lines([node])
        assert path.read_text() == "theirs"
        with pytest.raises(ConfigurationError, match="in use"):
            locks("other").take_lines([node])

    def test_a_holder_of_another_user_is_not_believed(self, lock, locks, strange):
        path, node = lock
        held = locks("one")
        held.take_lines([node])
        strange(path)
        with pytest.raises(ConfigurationError) as caught:
            locks("mine").take_lines([node])
        assert "cannot say who it is" in str(caught.value)
        assert "bench test" not in str(caught.value)


class TestFolders:
    def test_benches_with_locks_in_different_places_see_each_other(self, locks, tmp_path, monkeypatch):
        record = tmp_path / "record"
        record.mkdir()
        first, second = locks("vo2"), locks("sma")
        first.take_folder(record)
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir()
        monkeypatch.setenv("ACTUATOR_BENCH_LOCKS", str(elsewhere))
        assert is_in_use(record)
        with pytest.raises(ConfigurationError, match=rf"in use: it is held by .*process {os.getpid()}, bench test"):
            second.take_folder(record)
        first.close()
        assert not is_in_use(record)
        second.take_folder(record)
        second.close()
        assert list(record.iterdir()) == []

    @pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it looks for files as on Linux")
    def test_a_folder_on_a_file_system_without_locks_has_that_of_the_computer(self, locks, tmp_path, monkeypatch):
        record = tmp_path / "record"
        record.mkdir()
        without_locks(monkeypatch, record)
        first, second = locks("vo2"), locks("sma")
        first.take_folder(record)
        assert is_in_use(record)
        with pytest.raises(ConfigurationError, match="is held by"):
            second.take_folder(record)

    @pytest.mark.skipif(not sys.platform.startswith("linux"), reason="it looks for files as on Linux")
    def test_a_place_for_locks_without_locks_is_named_with_a_remedy(self, locks, tmp_path, monkeypatch, folder):
        without_locks(monkeypatch, folder)
        with pytest.raises(ConfigurationError, match=r"cannot be taken: No locks available; .*ACTUATOR_BENCH_LOCKS"):
            locks("vo2").take_lines([str(tmp_path / "port")])


def without_locks(monkeypatch, folder):
    """Let the file system of a folder have no locks."""
    import fcntl

    flock = fcntl.flock

    def refuse(file, operation):
        if Path(f"/proc/self/fd/{file}").readlink().is_relative_to(folder):
            raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
        flock(file, operation)

    monkeypatch.setattr(fcntl, "flock", refuse)
