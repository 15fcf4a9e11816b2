"""The command `bench rig emulate`: several rigs, how it ends, and what it refuses."""

import json
import signal
import socket
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from bench.rig import ControlClient

pytestmark = pytest.mark.usefixtures("warm_popen")


def state_lines(file):
    return [json.loads(line) for line in file.read_text().splitlines()]


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_it_and_nothing_is_left(emulate, tmp_path, how):
    with emulate("vo2", "--control", f"unix:{tmp_path / 'control'}") as (process, endpoints):
        terminal = endpoints["instruments"]["tec"]["port"]
        port = int(endpoints["instruments"]["psd"]["port"].rpartition(":")[2])
        ControlClient(endpoints["control"]).close()
        assert Path(terminal).exists()
        process.send_signal(how)
        assert process.wait(60) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["output.txt"]
    with socket.socket() as probe, pytest.raises(OSError, match="refused"):
        probe.connect(("127.0.0.1", port))
    # The laboratory time is in the last line.
    assert "times as fast as the wall clock (of 1)" in (tmp_path / "output.txt").read_text()


def test_a_dash_prints_the_endpoints_on_a_line_and_texts_elsewhere(tmp_path):
    command = [sys.executable, "-P", "-m", "bench", "rig", "emulate", "vo2", "--json", "-"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            endpoints = json.loads(process.stdout.readline())
            with ControlClient(endpoints["control"]) as control:
                assert control.request("time")["server"] == endpoints["server"]
        finally:
            process.terminate()
        out, err = process.communicate(timeout=60)
    assert process.returncode == 0
    assert out == ""
    assert endpoints["instruments"]["tec"]["port"] in err
    assert [*tmp_path.iterdir()] == []


def test_several_rigs_have_a_name_each(emulate):
    with emulate("sma", "vo2", "mckibben", "--clock", "x1") as (_, endpoints):
        assert [each["rig"] for each in endpoints["rigs"]] == ["sma", "vo2", "mckibben"]
        addresses = [one["port"] for each in endpoints["rigs"] for one in each["instruments"].values()]
        assert len({*addresses}) == len(addresses) == 10
        # The instruments of sma and mckibben have the same names.
        with (
            ControlClient(endpoints["control"], "sma") as heavy,
            ControlClient(endpoints["control"], "mckibben") as light,
        ):
            heavy.operate("load", 4.9)
            heavy.advance(1.0)
            assert heavy.state()["force"] == pytest.approx(4.9, rel=1e-4)
            assert light.state()["force"] != pytest.approx(4.9, rel=1e-4)


def test_the_state_is_logged_each_period_and_at_each_change_of_an_output(emulate, tmp_path):
    log = tmp_path / "state.jsonl"
    with emulate("sma", "--clock", "x1", "--state", log, "--state-period", "100") as (_, endpoints):
        host, port = endpoints["instruments"]["t7"]["port"].removeprefix("tcp://").rsplit(":", 1)
        control = ControlClient(endpoints["control"])
        with control, socket.create_connection((host, int(port)), timeout=60) as connection:
            for level in (0, 1, 0):
                # FIO0, the fan.
                body = struct.pack(">BBHH", 1, 6, 2000, level)
                connection.sendall(struct.pack(">HHH", 1, 0, len(body)) + body)
                assert connection.recv(100)[7] == 6
                control.state()
            control.advance(350.0)
            control.state()
    lines = state_lines(log)
    assert [line["values"]["fan"]["value"] for line in lines[:4]] == [1.0, 0.0, 1.0, 0.0]
    assert len(lines) >= 5
    assert {line["rig"] for line in lines} == {"sma"}
    times = [line["time"] for line in lines]
    assert times == sorted(times)
    assert times[-1] > 350.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nonsense"], "there is no rig 'nonsense'"),
        (["vo2-hardware"], "rig vo2-hardware has no emulated laboratory"),
        (["vo2", "vo2"], "rig vo2 is named twice"),
        (["vo2", "--clock", "virtual"], "--clock: clock 'virtual' is unknown; a served laboratory has wall, or xN"),
        (["vo2", "--port", "psd=0"], "--port psd=0: allowed are 1 to 65535"),
        (["vo2", "--port", "psd=5.5"], "--port psd=5.5: allowed are 1 to 65535"),
        (["vo2", "--port", "x=5000"], "x is not served; there are: vo2.psd, vo2.tec"),
        (["sma", "mckibben", "--port", "t7=5000"], "t7 is in several rigs; there are: sma.t7,"),
        (["vo2", "--port", "psd"], "expected KEY=VALUE"),
        (["vo2", "--control", "tcp://127.0.0.1"], "expected tcp://HOST:PORT or unix:PATH"),
        (["vo2", "--json", "no/such/folder/x.json"], "--json no/such/folder/x.json cannot be written"),
        (["vo2", "--state", "no/such/folder/x"], "--state no/such/folder/x cannot be opened"),
        (["vo2", "--override", "emulation.specimen_seed=-1"], "vo2.toml: emulation.specimen_seed"),
    ],
)
def test_bad_input_is_one_message(bench, arguments, words):
    code, _, err = bench("rig", "emulate", *arguments)
    assert code == 2
    (line,) = err.splitlines()
    assert words in line


def test_a_port_in_use_is_one_message(bench):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, _, err = bench("rig", "emulate", "vo2", "--port", f"psd={port}")
        assert (code, len(err.splitlines())) == (2, 1)
        assert f"vo2: psd cannot be served at port {port} of 127.0.0.1" in err
        code, _, err = bench("rig", "emulate", "vo2", "--control", f"tcp://127.0.0.1:{port}")
        assert (code, len(err.splitlines())) == (2, 1)


def test_a_laboratory_without_lines_is_refused(bench, tmp_path):
    (tmp_path / "without_lines.py").write_text(
        "from bench.rig.file import LaboratorySettings\n"
        "class Laboratory:\n"
        "    Settings = LaboratorySettings\n"
        "    def open(self): ...\n"
    )
    (tmp_path / "bare.toml").write_text(
        'extends = "vo2"\nwithout = ["emulation"]\n[emulation]\nlaboratory = "without_lines:Laboratory"\n'
    )
    code, _, err = bench("rig", "emulate", tmp_path / "bare.toml")
    assert code == 2
    assert "rig bare: laboratory Laboratory has no lines, so it cannot be served" in err


def test_a_chosen_port_is_used_and_a_serial_instrument_can_have_one(emulate):
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    with emulate("vo2", "--port", f"vo2.tec={port}", "--host", "127.0.0.1") as (_, endpoints):
        assert endpoints["instruments"]["tec"]["port"] == f"socket://127.0.0.1:{port}"


def test_a_host_that_others_reach_is_warned_of(emulate, tmp_path):
    with emulate("vo2", "--host", "0.0.0.0"):
        assert "warning: everybody who reaches 0.0.0.0" in (tmp_path / "output.txt").read_text()
