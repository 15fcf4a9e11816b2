"""Faults of lines, instruments, sensors and plants, in process on the virtual clock."""

import math
from functools import cache

import pytest
import serial
from cases import cases
from hypothesis import given, settings, strategies as st

from bench.base import ConfigurationError, VirtualClock
from bench.rig import ScheduledFault, load_rig, read_schedule
from sim_devices.wire import WireServer
from sim_devices.wire.modbus_tcp import FramingError

RIGS = ("vo2", "sma", "hybrid")
IDENTIFY = b"#0115AA?IF257D\r"
READ_PRODUCT = bytes.fromhex("0007 0000 0006 01 03 ea60 0002")
QUESTIONS = {
    "MeCom": IDENTIFY,
    "Modbus TCP": READ_PRODUCT,
    "Modbus RTU": bytes.fromhex("0103000000044409"),
    "Dynamixel 2.0": bytes.fromhex("fffffd0001030001194e"),
    "serial": b"\rC\rS4\rO\rt60184000100000000000\r",
}


def make(rig="vo2", seed=0):
    clock = VirtualClock()
    file = load_rig(rig)
    return file.laboratory(file.laboratory_settings, clock, seed), clock


@pytest.fixture
def vo2():
    laboratory, clock = make()
    ports = laboratory.open()
    yield laboratory, clock, ports
    laboratory.close()


@pytest.fixture
def ask(vo2):
    """Ask the TEC controller for its identity, on the laboratory's clock."""
    _, _, ports = vo2
    line = serial.serial_for_url(ports["tec"], baudrate=57600, timeout=0.2)

    def question(timeout=0.2):
        line.timeout = timeout
        line.write(IDENTIFY)
        return line.read_until(b"\r")

    yield question
    line.close()


def check_a_fault(rig, name):
    laboratory, clock = make(rig)
    fault = laboratory.faults[name]
    assert fault.summary
    for value in fault.values.values():
        assert value.low <= value.default <= value.high
        assert value.description
    laboratory.inject(name, duration=1.0 if fault.undo else None)
    clock.sleep(1.5)
    laboratory.catch_up()
    laboratory.truth()
    begun = [(event.fault, event.what) for event in laboratory.events]
    assert begun == ([(name, "begins"), (name, "ends")] if fault.undo else [(name, "begins")])
    if fault.undo:
        assert laboratory.events[1].time == pytest.approx(laboratory.events[0].time + 1.0)


@pytest.mark.parametrize("rig", RIGS)
def test_each_fault_says_what_it_is_and_leaves_no_trace_when_it_has_ended(rig):
    cases("name", make(rig)[0].faults)(check_a_fault)(rig=rig)


@cases("rig", RIGS)
def test_a_laboratory_without_faults_has_no_calendar_in_its_world(rig):
    laboratory, _ = make(rig)
    assert laboratory.next_change() == math.inf
    assert not any(line.is_watched for line in laboratory.lines.values())


def test_an_answer_is_dropped_and_the_next_one_comes(vo2, ask):
    laboratory, clock, _ = vo2
    right = ask()
    laboratory.inject("tec.drop")
    begun = clock.now()
    assert ask() == b""
    assert clock.now() >= begun + 0.2
    assert ask() == right
    assert [(event.what, dict(event.values)) for event in laboratory.events] == [
        ("begins", {"count": 1.0, "probability": 1.0}),
        ("ends", {"disturbed": 1.0}),
    ]


def test_a_corrupt_answer_has_one_wrong_bit(vo2, ask):
    laboratory, _, _ = vo2
    right = ask()
    laboratory.inject("tec.corrupt")
    wrong = ask()
    bits = [bin(a ^ b).count("1") for a, b in zip(right, wrong, strict=False)]
    assert sum(bits) == 1 or len(wrong) != len(right)


def test_a_doubled_answer_comes_twice(vo2, ask):
    laboratory, _, ports = vo2
    right = ask()
    laboratory.inject("tec.double")
    with serial.serial_for_url(ports["tec"], baudrate=57600, timeout=0.1) as line:
        line.write(IDENTIFY)
        assert line.read(1000) == 2 * right


def test_a_late_answer_comes_at_its_instant_of_laboratory_time(vo2, ask):
    laboratory, clock, _ = vo2
    right = ask()
    laboratory.inject("tec.delay", {"seconds": 1.5})
    begun = clock.now()
    assert ask(timeout=0.2) == b""
    assert clock.now() < begun + 0.5
    assert ask(timeout=3.0) == right
    assert clock.now() == pytest.approx(begun + 1.5, abs=0.02)


@cases("rig", RIGS)
def test_each_protocol_with_addresses_readdresses_its_answers(rig):
    laboratory, _ = make(rig)
    for name, server in laboratory.servers.items():
        if f"{name}.readdress" not in laboratory.faults:
            continue
        stream = server if isinstance(server, WireServer) else server.connect()
        question = QUESTIONS[server.protocol]
        right = stream.receive(question)
        if server.protocol == "serial":
            right = stream.receive(b"t60184000100000000000\r")
            question = b"t60184000100000000000\r"
        laboratory.inject(f"{name}.readdress")
        wrong = stream.receive(question)
        assert wrong != right, name
        assert len(wrong) == len(right), name


def test_two_ports_that_change_their_numbers_are_away_and_lead_to_each_others_instrument():
    laboratory, clock = make("sma")
    cell, stage = (laboratory.servers[name] for name in ("load_cell", "stage"))
    asked = {line: QUESTIONS[line.protocol] for line in (cell, stage)}
    right = {line: line.receive(question) for line, question in asked.items()}
    laboratory.inject("load_cell+stage.renumber", {"seconds": 2.0})
    assert cell.receive(asked[stage]) == b""
    clock.sleep(2.1)
    assert cell.receive(asked[stage]) == right[stage]
    assert stage.receive(asked[cell]) == right[cell]
    assert cell.receive(asked[cell]) == b""
    laboratory.mend("stage")
    assert {line: line.receive(question) for line, question in asked.items()} == right


@pytest.mark.parametrize("fault", ["unplug", "hang"])
def test_a_dead_line_is_back_when_the_fault_ends(vo2, ask, fault):
    laboratory, clock, _ = vo2
    right = ask()
    laboratory.inject(f"tec.{fault}", duration=2.0)
    begun = clock.now()
    assert ask() == b""
    # A hanging instrument then answers what it was asked.
    assert ask(timeout=5.0) == (right if fault == "hang" else b"")
    if fault == "hang":
        assert clock.now() == pytest.approx(begun + 2.0, abs=0.02)
        ask()
    assert ask() == right


def test_a_cut_ends_an_answer_in_its_middle_and_the_connection_with_it(vo2):
    laboratory, clock, ports = vo2
    line = serial.serial_for_url(ports["psd"], timeout=0.2)
    line.write(READ_PRODUCT)
    right = line.read(13)
    laboratory.inject("psd.cut", duration=3.0)
    line.write(READ_PRODUCT)
    assert right.startswith(line.read(len(right) // 2))
    with pytest.raises(serial.SerialException, match="ended the connection"):
        line.read(1)
    with pytest.raises(serial.SerialException, match="refused"):
        serial.serial_for_url(ports["psd"])
    clock.sleep(3.0)
    again = serial.serial_for_url(ports["psd"], timeout=0.2)
    again.write(READ_PRODUCT)
    assert again.read(13) == right


def test_an_instrument_without_power_is_off_and_starts_anew(vo2, ask):
    laboratory, clock, _ = vo2
    laboratory.tec.set(40.0)
    assert laboratory.truth()["tec_output"].value
    laboratory.inject("tec.power-loss", duration=1.0)
    assert not laboratory.truth()["tec_output"].value
    assert ask() == b""
    clock.sleep(1.0)
    assert ask().startswith(b"!0115AA8065")
    assert laboratory.tec.read_parameter(50000) == 0


@cases(
    ("rig", "instrument", "read"),
    [
        ("vo2", "psd", lambda laboratory: laboratory.t7.convert(0)),
        ("sma", "load_cell", lambda laboratory: laboratory.load_cell.read_registers(0x2000, 2)),
        ("sma", "stage", lambda laboratory: laboratory.servo.read_item(132)),
        ("sma", "supply", lambda laboratory: laboratory.supply.read_object(0x2102, 1)),
        ("hybrid", "t7", lambda laboratory: laboratory.t7.convert(1)),
    ],
)  # fmt: skip
def test_the_values_of_each_frozen_instrument_stand(rig, instrument, read):
    laboratory, clock = make(rig)
    laboratory.inject(f"{instrument}.freeze", duration=5.0)
    first = read(laboratory)
    if instrument == "stage":
        laboratory.servo.set(1.0)
    if instrument == "supply":
        laboratory.supply.set(2.0)
    clock.sleep(3.0)
    assert read(laboratory) == first
    clock.sleep(3.0)
    if instrument == "supply":
        laboratory.supply.set(2.0)
    if instrument in ("stage", "supply", "psd"):
        assert read(laboratory) != first


def test_a_stuck_a_noisy_a_drifting_and_a_lost_sensor_differ_from_the_truth(vo2):
    laboratory, clock, _ = vo2
    t7, plant = laboratory.t7, laboratory.plant

    def seen():
        return t7.convert(0) / 1e5

    assert seen() == pytest.approx(plant.tip_deflection, abs=0.3e-6)
    laboratory.inject("spot.drifting", {"slope": 1e-6}, duration=10.0)
    clock.sleep(5.0)
    assert seen() - plant.tip_deflection == pytest.approx(5e-6, abs=0.3e-6)
    clock.sleep(6.0)
    assert seen() == pytest.approx(plant.tip_deflection, abs=0.3e-6)
    laboratory.inject("spot.noisy", {"rms": 5e-6}, duration=1.0)
    values = [seen() for _ in range(200)]
    assert 3e-6 < (max(values) - min(values)) / 5 < 12e-6
    clock.sleep(2.0)
    laboratory.inject("spot.out-of-range", duration=1.0)
    assert t7.convert(0) == pytest.approx(10.0, abs=0.2)
    clock.sleep(2.0)
    laboratory.inject("spot.stuck")
    before = seen()
    laboratory.tec.set(70.0)
    for _ in range(10):
        clock.sleep(2.0)
        laboratory.tec.read_parameter(104)
    assert seen() == pytest.approx(before, abs=0.3e-6)
    assert abs(plant.tip_deflection - before) > 1e-6
    laboratory.end("spot.stuck")
    assert seen() == pytest.approx(plant.tip_deflection, abs=0.3e-6)


def test_a_clipped_supply_heats_more_slowly_and_a_stuck_cantilever_stands_in_truth_as_well(vo2):
    laboratory, clock, _ = vo2
    laboratory.inject("supply-clipped", {"amperes": 0.2}, duration=10.0)
    laboratory.tec.set(60.0)
    clock.sleep(3.0)
    assert abs(laboratory.truth()["tec_current"].value) <= 0.2 + 1e-9
    laboratory.inject("cantilever-stuck")
    stuck = laboratory.truth()["tip_deflection"].value
    clock.sleep(8.0)
    laboratory.tec.read_parameter(104)
    assert abs(laboratory.truth()["tec_current"].value) > 0.2
    clock.sleep(1.0)
    assert laboratory.truth()["tip_deflection"].value == stuck
    assert laboratory.plant.tip_deflection != stuck


def test_a_broken_muscle_carries_neither_current_nor_force():
    laboratory, clock = make("sma")
    laboratory.operate("load", 4.9)
    laboratory.supply.set(2.0)
    clock.sleep(1.0)
    assert laboratory.truth()["supply_current"].value > 0.0
    assert laboratory.truth()["force"].value == pytest.approx(4.9, rel=1e-4)
    laboratory.inject("broken-muscle")
    clock.sleep(2.0)
    truth = laboratory.truth()
    assert (truth["supply_current"].value, truth["force"].value) == (0.0, 0.0)
    assert laboratory.magnet.output() == pytest.approx(0.9 * laboratory.magnet.supply())


def test_a_fan_that_stands_cools_nothing():
    def temperature(*faults):
        laboratory, clock = make("sma")
        laboratory.supply.set(2.5)
        clock.sleep(4.0)
        laboratory.supply.safe()
        laboratory.t7.write_registers(2000, [1])
        for each in faults:
            laboratory.inject(each)
        clock.sleep(2.0)
        assert laboratory.truth()["fan"].value
        return laboratory.truth()["muscle_temperature"].value

    assert temperature("fan-stands") > temperature() + 1.0


def test_a_clipped_amplifier_gives_no_more():
    laboratory, clock = make("hybrid")
    laboratory.amplifier.drive(5.0, True)
    clock.sleep(0.1)
    assert laboratory.truth()["piezo_voltage"].value > 15.0
    laboratory.inject("amplifier-clipped", {"volts": 8.0}, duration=1.0)
    clock.sleep(0.1)
    assert laboratory.truth()["piezo_voltage"].value == pytest.approx(8.0)
    clock.sleep(2.0)
    assert laboratory.truth()["piezo_voltage"].value > 15.0


@cases("rig", RIGS)
def test_looking_at_the_truth_feeds_no_watchdog(rig):
    laboratory, clock = make(rig)
    if rig == "sma":
        laboratory.servo.write_item(64, 1)
        laboratory.servo.write_item(98, 50)

        def expired():
            return laboratory.servo._values[98] != 50
    else:
        laboratory.tec.set(20.0 if rig == "vo2" else 30.0)
        laboratory.tec.write_parameter(2060, 1.0)

        def expired():
            return laboratory.tec.status.name == "ERROR"

    for _ in range(40):
        clock.sleep(0.1)
        laboratory.truth()
    assert expired()


def test_a_schedule_happens_at_its_instants_when_time_passes_them():
    laboratory, clock = make()
    clock.sleep(7.0)
    laboratory.schedule(
        [
            ScheduledFault(fault="tec.unplug", at=2.5, duration=1.25),
            ScheduledFault(fault="displaced-spot", at=1.0, values={"metres": 1e-5}),
        ]
    )
    clock.sleep(100.0)
    laboratory.catch_up()
    assert [(each.time, each.fault, each.what) for each in laboratory.events] == [
        (8.0, "displaced-spot", "begins"), (9.5, "tec.unplug", "begins"), (10.75, "tec.unplug", "ends"),
    ]  # fmt: skip


def test_a_rate_gives_the_same_instants_for_one_seed_and_about_as_many_as_it_says():
    def instants(seed):
        laboratory, clock = make()
        entry = ScheduledFault(fault="psd.drop", rate=120.0, seed=seed, until=3600.0)
        laboratory.schedule([entry])
        for _ in range(40):
            clock.sleep(100.0)
            laboratory.catch_up()
        return [each.time for each in laboratory.events if each.what == "begins"]

    assert instants(1) == instants(1) != instants(2)
    assert 80 < len(instants(1)) < 160
    assert max(instants(1)) <= 3600.0


@cases(
    ("entry", "words"),
    [
        ({"fault": "tec.melt", "at": 1.0}, "has no fault 'tec.melt'; it has: tec-over-current"),
        ({"fault": "tec.delay", "at": 1.0, "values": {"hours": 1.0}}, "takes no value 'hours'; it takes: count"),
        ({"fault": "tec.delay", "at": 1.0, "values": {"seconds": 1e6}}, "seconds = 1e+06: allowed are 0 to 3600 s"),
        ({"fault": "tec.drop", "at": 1.0, "values": {"probability": 0.0}}, "probability = 0: allowed are 1e-06 to 1"),
        ({"fault": "tec-over-current", "at": 1.0, "duration": 2.0}, "happens at an instant; it takes no duration"),
    ],
)
def test_a_schedule_with_a_mistake_is_one_message_and_nothing_of_it_happens(entry, words):
    laboratory, clock = make()
    with pytest.raises(ConfigurationError) as caught:
        laboratory.schedule([ScheduledFault(fault="tec.unplug", at=0.5), ScheduledFault(**entry)])
    (line,) = str(caught.value).splitlines()
    assert line.startswith("fault 2 of the schedule: ")
    assert words in line
    clock.sleep(10.0)
    laboratory.catch_up()
    assert laboratory.events == []


TOML = """
[[fault]]
at = 3
fault = "tec.delay"
values = { seconds = 0.4 }
duration = 5.0

[[fault]]
rate = 6.0
seed = 1
fault = "psd.drop"
"""
LINES = """
{"at": 3, "fault": "tec.delay", "values": {"seconds": 0.4}, "duration": 5.0}

{"rate": 6.0, "seed": 1, "fault": "psd.drop"}
"""


def test_a_schedule_is_toml_or_lines_of_json(tmp_path):
    (tmp_path / "a.toml").write_text(TOML)
    (tmp_path / "a.jsonl").write_text(LINES)
    assert read_schedule(tmp_path / "a.toml") == read_schedule(tmp_path / "a.jsonl")
    assert read_schedule(tmp_path / "a.toml")[0].values == {"seconds": 0.4}


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.toml", "", "has no faults"),
        ("a.toml", "[[fault", "is not TOML"),
        ("a.jsonl", "{", "is not JSON lines"),
        ("a.toml", "x = 1", "x: expected tables [[fault]] only"),
        ("a.toml", "fault = 1", "fault: expected tables [[fault]] only"),
        ("a.toml", "[[fault]]\nfault = 'a'", "fault 1: needs at (s) or rate (1/h)"),
        ("a.toml", "[[fault]]\nfault = 'a'\nat = 1\nrate = 2", "needs at (s) or rate (1/h), and not both"),
        ("a.toml", "[[fault]]\nfault = 'a'\nat = 1\nseed = 2", "seed and until belong to a rate"),
        ("a.toml", "[[fault]]\nfault = 'a'\nat = -1", "at = -1"),
        ("a.toml", "[[fault]]\nfault = 'a'\nat = inf", "at = inf"),
        ("a.toml", "[[fault]]\nfault = 'a'\nat = 1\n[[fault]]\nat = 1", "fault 2: fault: is missing"),
        ("a.toml", "[[fault]]\nfault = 'a'\nat = 1\nwhat = 2", "what: there is no such key"),
        ("a.jsonl", "[1]", "fault 1"),
    ],
)
def test_a_wrong_file_of_faults_is_one_message(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(ConfigurationError) as caught:
        read_schedule(tmp_path / name)
    (line,) = str(caught.value).splitlines()
    assert line.startswith(str(tmp_path / name))
    assert words in line


@cache
def laboratory_of(rig):
    """The laboratory of a rig, and its clock, for all examples."""
    return make(rig)


STREAMS = {}


def streams(rig):
    """The lines of a laboratory; on TCP a connection that is opened again once it is over."""
    laboratory, _ = laboratory_of(rig)
    for name, server in laboratory.servers.items():
        if isinstance(server, WireServer):
            yield name, server
            continue
        stream = STREAMS.get((rig, name))
        if stream is None or not stream.is_open:
            try:
                STREAMS[rig, name] = stream = server.connect()
            except ConnectionRefusedError:
                continue
        yield name, stream


@settings(max_examples=150, deadline=None)
@given(
    rig=st.sampled_from(RIGS),
    acts=st.lists(
        st.tuples(st.integers(0, 99), st.sampled_from(["begin", "end", "ask", "wait"]), st.binary(max_size=12)),
        max_size=25,
    ),
)
def test_no_fault_makes_a_server_raise_or_hang(rig, acts):
    laboratory, clock = laboratory_of(rig)
    known = list(laboratory.faults)
    for number, what, garbage in acts:
        name = known[number % len(known)]
        if what == "begin":
            laboratory.inject(name, duration=0.5 + number / 20 if laboratory.faults[name].undo else None)
        elif what == "end":
            laboratory.end(name)
        elif what == "wait":
            clock.sleep(number / 50)
        for instrument, stream in streams(rig):
            question = QUESTIONS[laboratory.servers[instrument].protocol]
            try:
                sent = stream.receive(garbage + question if what == "ask" else question) + stream.unsolicited()
                assert isinstance(sent, bytes)
                assert stream.next_unsolicited() >= 0.0
            except (FramingError, ConnectionResetError):
                assert not isinstance(stream, WireServer)
    assert clock.now() < math.inf
    laboratory.truth()
