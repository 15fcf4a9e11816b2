"""What `bench emulate` and its control socket say when something is wrong."""

import json
import socket
import subprocess

import pytest
from served import PATIENCE, emulate


def outcome(*arguments):
    finished = subprocess.run(emulate(*arguments), capture_output=True, text=True, timeout=2 * PATIENCE, check=False)
    assert "Traceback" not in finished.stderr
    return finished.returncode, " ".join((finished.stdout + finished.stderr).split())


def test_a_port_in_use_is_named():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, said = outcome("vo2", "--port", f"psd={port}")
    assert code == 2
    assert "psd" in said
    assert str(port) in said
    assert "in use" in said


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["vo2-hardware"], ["vo2-hardware", "[emulation]"]),
        (["nonsense"], ["nonsense", "vo2"]),
        (["vo2", "--clock", "virtual"], ["virtual", "wall", "x20"]),
        (["vo2", "--port", "nobody=5020"], ["nobody", "vo2.psd", "vo2.tec"]),
        (["vo2", "vo2"], ["vo2", "twice"]),
        (["vo2", "--control", "pigeon:1"], ["pigeon:1", "tcp://HOST:PORT"]),
    ],
)
def test_a_wrong_command_is_refused_before_anything_is_served(arguments, named):
    code, said = outcome(*arguments)
    assert code == 2
    assert all(each in said for each in named), said
    assert "control: tcp" not in said


@pytest.mark.parametrize(
    ("line", "named"),
    [
        (b'{"do": "fault", "rig": "sma", "fault": "earthquake"}', ["earthquake", "servo-overload"]),
        (b'{"do": "fault", "rig": "sma", "fault": "low-battery", "values": {"amps": 1}}', ["amps", "volts"]),
        (b'{"do": "fault", "rig": "sma"}', ["fault"]),
        (b'{"do": "operate", "rig": "sma", "task": "load", "value": 1e6}', ["1e+06"]),
        (b'{"do": "operate", "rig": "sma", "task": "juggle", "value": 1}', ["juggle", "load", "stage"]),
        (b'{"do": "unplug", "rig": "sma", "instrument": "kettle"}', ["kettle", "load_cell"]),
        (b'{"do": "state", "rig": "moon"}', ["moon", "sma", "vo2"]),
        (b'{"do": "state"}', ["rig", "sma", "vo2"]),
        (b'{"do": "dance"}', ["dance", "power-cycle"]),
        (b'{"do": "advance", "rig": "sma", "seconds": -1}', ["seconds"]),
        (b'{"do": "advance", "rig": "sma", "seconds": NaN}', ["seconds"]),
        (b'{"do": "state", "rig": "sma", "and": "more"}', ["and"]),
        (b"[1, 2]", ["do"]),
        (b"GET / HTTP/1.1", ["JSON"]),
        (b"\xff\xfe\x00", ["JSON"]),
        (b'{"do":' * 5000, ["JSON"]),
    ],
)
def test_a_wrong_request_is_one_message_and_harms_nothing(served, line, named):
    answer = served.send(line)
    assert set(answer) == {"error"}
    assert all(each in answer["error"] for each in named), answer
    assert len(answer["error"].splitlines()) == 1
    assert served.control("time", "sma")["time"] > 0.0


def test_a_control_client_may_flood_or_leave_in_the_middle_of_a_line(served):
    place = served.control_address
    for data in (b'{"do": "state", "rig": "s', b"x" * 100_000, b'{"do": "help"}\n' * 5000):
        with socket.create_connection(place, PATIENCE) as client:
            try:
                client.setblocking(False)
                client.send(data)
            except ConnectionError:
                pass
    with socket.create_connection(place, PATIENCE) as client, client.makefile("rb") as answers:
        for byte in b'{"do": "time", "rig": "vo2"}\n':
            client.sendall(bytes((byte,)))
        assert json.loads(answers.readline())["time"] > 0.0
