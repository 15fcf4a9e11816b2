"""Which instrument is at which port: a desk of eight served instruments, whose ports are in any order."""

import json
import os
import random
import socket
import threading
import tomllib
import tty
from pathlib import Path

import pytest

from bench.rig import load_rig
from drivers.finding.places import answers, placements
from drivers.finding.ports import Port, ports
from sim_devices.serving.process import serve

pytestmark = pytest.mark.usefixtures("warm_popen")

DESK = Path(__file__).with_name("desk.toml")
SHARED = Path(__file__).parents[3] / "examples" / "shared-line.toml"


@pytest.fixture(scope="module")
def desk(warm_popen):
    """Serve the desk; its rig file, and the served rig."""
    with serve(str(DESK), clock="x1") as rig:
        yield DESK, rig


def shuffled(file, rig, seed):
    """Return the rig with the ports of its kinds in any order, and where each device truly is."""
    truly = {device: each.port for each in rig.instruments.values() for device in each.devices}
    overrides = {}
    for kind in ("tcp://", "/dev/"):
        names = [name for name, port in truly.items() if port.startswith(kind)]
        places = [truly[name] for name in names]
        random.Random(seed).shuffle(places)
        overrides |= {f"devices.{name}.port": json.dumps(port) for name, port in zip(names, places, strict=True)}
    return load_rig(str(file), overrides), truly


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.seeds) for seed in (1, 2))])
def test_every_instrument_of_a_desk_is_found_in_any_order_of_ports(desk, seed):
    file, rig = desk
    before = rig.control.state()
    mixed, truly = shuffled(file, rig, seed)
    known = [Port(address) for address in truly.values()]
    found = placements(mixed, answers(mixed, known), known)
    assert {each.device: each.answer and each.answer.port.address for each in found} == truly
    for each in found:
        (line,) = (entry.settings.port for entry in mixed.devices if entry.name == each.device)
        assert bool(each.remark) == (line != truly[each.device])
        if each.remark:
            assert each.remark.startswith("answers at the port of ")
    after = rig.control.state()
    assert {
        name for name in before if name.endswith(("_output", "_torque", "_fan")) and after[name] != before[name]
    } == set()
    assert after["muscle_supply_voltage"] == before["muscle_supply_voltage"] == 0.0


def test_twins_without_serial_numbers_are_not_guessed(desk):
    file, rig = desk
    _, truly = shuffled(file, rig, 3)
    twins = load_rig(str(file), {f"devices.{name}.serial_number": '""' for name in ("tec_a", "tec_b")})
    known = [Port(truly[name]) for name in ("tec_a", "tec_b")]
    found = {each.device: each for each in placements(twins, answers(twins, known), known)}
    assert not found["tec_a"].is_settled
    assert "interchangeable with tec_b" in found["tec_a"].remark
    assert "10910042" in found["tec_a"].remark
    # With one number the other one follows.
    one = load_rig(str(file), {"devices.tec_b.serial_number": '""'})
    found = {each.device: each for each in placements(one, answers(one, known), known)}
    assert [found[name].answer.port.address for name in ("tec_a", "tec_b")] == [truly["tec_a"], truly["tec_b"]]


def test_another_instrument_than_the_rig_file_names_is_refused(desk):
    file, rig = desk
    known = [Port(rig.port("tec_a"))]
    found = {
        each.device: each for each in placements(load_rig(str(file)), answers(load_rig(str(file)), known), known)
    }
    assert found["tec_a"].is_settled
    assert not found["tec_b"].is_settled
    assert "10910042" in found["tec_b"].remark
    assert "10910043" in found["tec_b"].remark


def test_what_is_found_is_written_with_the_comments_kept(desk, bench, tmp_path):
    file, rig = desk
    (tmp_path / "mine.toml").write_text(
        f"extends = {json.dumps(str(file))}\n\n[devices.tec_a]  # under the window\nbaudrate = 57600  # Bd\n"
    )
    endpoints = json.loads(rig.endpoints_file.read_text())
    (tmp_path / "ports.json").write_text(json.dumps(endpoints | {"rig": "mine"}))
    mine = tmp_path / "mine.toml"
    code, out, err = bench(
        "rig", "find", mine, "--attach", tmp_path / "ports.json", "--write", "--json", tmp_path / "f.json"
    )
    assert code == 0, out + err
    truly = {device: each.port for each in rig.instruments.values() for device in each.devices}
    written = load_rig(str(mine))
    assert {each.name: each.settings.port for each in written.devices} == truly
    text = mine.read_text()
    assert "# under the window" in text
    assert "# Bd" in text
    content = json.loads((tmp_path / "f.json").read_text())
    assert content["devices"]["stage"]["answer"]["identity"]["model"].startswith("MX-28")
    code, out, err = bench("rig", "find", "vo2", "--attach", tmp_path / "ports.json", "--write")
    assert code == 2
    assert "packaged rig" in err


def test_instruments_on_a_shared_line_are_found_and_their_port_is_that_of_the_line(bench, tmp_path):
    with serve(str(SHARED), clock="x1") as rig:
        mine = tmp_path / "mine.toml"
        # Each device says what is of the line, and wrongly.
        text = SHARED.read_text().partition("\n[emulation")[0]
        mine.write_text(text.replace("\naddress = ", "\necho = true  # perhaps\naddress = "))
        (port,) = {each.port for each in rig.instruments.values()}
        endpoints = json.loads(rig.endpoints_file.read_text())
        (tmp_path / "ports.json").write_text(json.dumps(endpoints | {"rig": "mine"}))
        code, out, err = bench("rig", "find", mine, "--attach", tmp_path / "ports.json", "--write")
        assert code == 0, out + err
    written = load_rig(str(mine))
    assert {each.settings.port for each in written.devices} == {port}
    assert {each.settings.echo for each in written.devices} == {False}
    assert tomllib.loads(mine.read_text())["lines"]["bus"]["port"] == port


@pytest.mark.seeds
def test_an_instrument_at_another_speed_is_found(desk, tmp_path):
    file, rig = desk
    slow = load_rig(str(file), {f"devices.{name}.baudrate": "9600" for name in ("tec_a", "tec_b")})
    master, slave = os.openpty()
    tty.setraw(slave)
    fast = 57600
    ended = threading.Event()

    def serve_at_its_speed():
        # The controller hears only what is sent at its speed.
        import termios

        import serial

        with serial.serial_for_url(rig.port("tec_a"), fast, timeout=0.05) as line:
            while not ended.is_set():
                try:
                    data = os.read(master, 256)
                except OSError:
                    return
                if termios.tcgetattr(slave)[4] == termios.B57600:
                    line.write(data)
                    os.write(master, line.read(256))

    thread = threading.Thread(target=serve_at_its_speed, daemon=True)
    thread.start()
    known = [Port(os.ttyname(slave))]
    (answer,) = (each for each in answers(slow, known) if each.device == "tec_a")
    ended.set()
    os.write(slave, b"\r")
    thread.join(10.0)
    assert dict(answer.changed) == {"baudrate": fast}
    os.close(master)
    os.close(slave)


def test_a_port_that_is_held_is_named_and_not_asked(desk, bench):
    import serial

    file, rig = desk
    port = rig.port("stage")
    with serial.serial_for_url(port, exclusive=True):
        (found,) = [each for each in ports([port]) if each.address == port]
        assert str(os.getpid()) in found.problem
        assert not answers(load_rig(str(file)), [found])
    code, out, _ = bench("rig", "find", "--port", port)
    assert code == 0
    assert port in out


def test_the_ports_of_the_rig_file_are_asked_although_no_system_lists_them(desk, bench, tmp_path):
    file, rig = desk
    mine = tmp_path / "mine.toml"
    left_out = [f"devices.{each.name}" for each in load_rig(str(file)).devices if each.name not in ("tec_a", "psd")]
    mine.write_text(
        f"extends = {json.dumps(str(file))}\nwithout = {json.dumps(['emulation', *left_out])}\n"
        f"devices.tec_a.port = {json.dumps(rig.port('tec_a'))}\ndevices.psd.port = {json.dumps(rig.port('t7_a'))}\n"
    )
    code, out, err = bench("rig", "find", mine, "--json", tmp_path / "found.json")
    assert code == 0, out + err
    found = json.loads((tmp_path / "found.json").read_text())["devices"]
    assert {name: each["remark"] for name, each in found.items()} == {"tec_a": "", "psd": ""}


def test_where_nothing_is_is_said_before_it_is_asked():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        host = f"127.0.0.1:{listener.getsockname()[1]}"
    for found in ports(["/dev/no-such-port"], [host, "127.0.0.1:99999"]):
        if found.name.endswith(("no-such-port", host, ":99999")):
            assert "check" in found.problem
            assert "LabJack" not in found.description


def test_a_missing_permission_says_what_to_do(tmp_path, monkeypatch):
    node = tmp_path / "port"
    node.touch()
    # Root may open every port.
    monkeypatch.setattr(os, "access", lambda *_: False)
    (found,) = [each for each in ports([str(node)]) if each.address == str(node)]
    assert "usermod -aG" in found.problem
