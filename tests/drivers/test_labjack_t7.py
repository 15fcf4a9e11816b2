"""The T7 driver: its settings, its bytes, and what it makes of wrong devices and broken lines."""

import logging
import math
import socket
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from pydantic import ValidationError

from bench.clock import VirtualClock
from bench.errors import DeviceConnectionError, DeviceError
from drivers.labjack_t7 import LabJackT7, T7PositionSensor
from sim_devices.instruments.labjack_t7 import EmulatedT7
from sim_devices.wire.modbus_tcp import DEVICE_FAILURE, ModbusTcpServer, RegisterError
from sim_devices.world import World

Settings = T7PositionSensor.Settings


class Still:
    def advance(self, dt: float) -> None:
        pass


class Bench:
    """A T7 whose inputs are the numbers in `volts`."""

    def __init__(self) -> None:
        self.volts = dict.fromkeys(range(14), 0.0)
        self.clock = VirtualClock()
        self.world = World(Still(), self.clock)
        inputs: dict[int, Callable[[], float]] = {channel: lambda c=channel: self.volts[c] for channel in range(14)}
        self.t7 = EmulatedT7(self.world, inputs, rng=np.random.default_rng(3))
        self.server = ModbusTcpServer(self.t7)
        self.sensors: list[T7PositionSensor] = []

    def sensor(self, **settings) -> T7PositionSensor:
        made = T7PositionSensor.connect("psd", Settings(port=self.server.address, **settings), self.clock)
        self.sensors.append(made)
        return made


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    with bench.server:
        yield bench
        for sensor in bench.sensors:
            sensor.close()


class Scripted:
    """A server of one connection that expects bytes and answers bytes; None closes the connection."""

    def __init__(self, *exchanges: tuple[str, str | None]) -> None:
        self._exchanges = [
            (bytes.fromhex(sent), None if reply is None else bytes.fromhex(reply)) for sent, reply in exchanges
        ]
        self.received: list[bytes] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._serve)

    def __enter__(self) -> "Scripted":
        self._thread.start()
        return self

    def __exit__(self, *details) -> None:
        self._thread.join()

    def _serve(self) -> None:
        with self._listener:
            client, _ = self._listener.accept()
            with client:
                client.settimeout(5)
                for expected, reply in self._exchanges:
                    self.received.append(client.recv(4096))
                    assert self.received[-1] == expected
                    if reply is None:
                        return
                    client.sendall(reply)
                client.recv(1)  # until the driver hangs up


class Altered:
    """A T7 of which some registers read differently."""

    def __init__(self, instrument: EmulatedT7, alter: Callable[[int, list[int]], list[int]]) -> None:
        self._instrument = instrument
        self._alter = alter

    def read_registers(self, address: int, count: int) -> list[int]:
        return self._alter(address, self._instrument.read_registers(address, count))

    def write_registers(self, address: int, values: list[int]) -> None:
        self._instrument.write_registers(address, values)


# Settings


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("tcp://192.168.1.207:502", "tcp://192.168.1.207:502"),
        ("192.168.1.207", "tcp://192.168.1.207:502"),
        ("t7.local:1502", "tcp://t7.local:1502"),
        ("tcp://t7", "tcp://t7:502"),
        ("tcp://[fe80::1]:502", "tcp://[fe80::1]:502"),
    ],
)
def test_address_is_completed(given, kept):
    assert Settings(port=given).port == kept


@pytest.mark.parametrize(
    "wrong",
    [
        {"port": "serial:///dev/ttyUSB0"},
        {"port": "host:0"},
        {"port": "host:70000"},
        {"port": ""},
        {"range": 5.0},
        {"range": math.nan},
        {"channels": (14,)},
        {"channels": (0, 1)},
        {"channels": (3, 3), "readout": "currents"},
        {"channels": (3,), "readout": "currents"},
        {"resolution_index": 9},
        {"samples": 0},
        {"samples": 200},  # 0.2 s at 1 kHz
        {"sample_rate": 0.0},
        {"timeout": 0.05, "samples": 60},
        {"volts_per_metre": 0.0},
        {"metres_per_metre": math.inf},
        {"position_limits": (1e-6, -1e-6)},
        {"position_limits": (-96e-6, 0.0), "readout": "currents", "channels": (0, 1)},
        {"colour": "red"},
    ],
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(ValidationError):
        Settings(**{"port": "host"} | wrong)


def test_every_setting_is_described():
    assert all(field.description for field in Settings.model_fields.values())


# Bytes


def test_byte_vectors():
    exchanges = (
        ("0001 0000 0006 01 03 d73c 0002", "0001 0000 0007 01 03 04 0011 2233"),  # TEST
        ("0002 0000 0006 01 03 d754 0002", "0002 0000 0007 01 03 04 c61c 3c00"),  # TEST_FLOAT32
        ("0003 0000 0006 01 03 0000 0002", "0003 0000 0007 01 03 04 4020 0000"),  # AIN0
        ("0004 0000 000b 01 10 9c40 0002 04 3dcc cccd", "0004 0000 0006 01 10 9c40 0002"),  # AIN0_RANGE
        ("0005 0000 0006 01 03 9c40 0002", "0005 0000 0007 01 03 04 3dcc cccd"),
    )
    with Scripted(*exchanges) as server:
        t7 = LabJackT7("psd", server.address, 2.0)
        assert t7.read_u32(55100) == 0x00112233
        assert t7.read_f32(55124) == [-9999.0]
        assert t7.read_f32(0) == [2.5]
        t7.set_f32("AIN0_RANGE", 40000, 0.1)
        t7.close()
    assert len(server.received) == len(exchanges)


# Setting up


def test_connect_sets_the_inputs_up(bench):
    bench.sensor(
        readout="currents",
        channels=(4, 7),
        range=1.0,
        resolution_index=6,
        settling_us=50.0,
        samples=25,
        sample_rate=2000.0,
    )
    for channel in (4, 7):
        assert bench.t7.read_value(40000 + 2 * channel) == 1.0
        assert bench.t7.read_value(41000 + channel) == 199
        assert bench.t7.read_value(41500 + channel) == 6
        assert bench.t7.read_value(42000 + 2 * channel) == 50.0
        assert bench.t7.read_value(9000 + 2 * channel) == 3
        assert bench.t7.read_value(9300 + 2 * channel) == 25
        assert bench.t7.read_value(10200 + 2 * channel) == 2000.0
    assert bench.t7.read_value(4008) == 50.0
    assert bench.t7.read_value(4010) == 6


def test_one_sample_needs_no_burst(bench):
    bench.volts[0] = 1.0
    sensor = bench.sensor(samples=1)
    assert bench.t7.read_value(9000) == 0
    assert sensor.measure()["psd_position"] == pytest.approx(10e-6, abs=1e-8)
    assert bench.clock.now() == 0.0


@pytest.mark.parametrize("channels", [(0, 1), (1, 0), (5, 2)])
def test_currents_on_any_two_inputs(bench, channels):
    first, second = channels
    bench.volts[first], bench.volts[second] = 3.0, 5.0
    sensor = bench.sensor(readout="currents", channels=channels)
    expected = 0.037 / 2 * (5.0 - 3.0) / 8.0 / 185.0
    assert sensor.measure()["psd_position"] == pytest.approx(expected, rel=1e-4)
    assert sensor.glance()["psd_position"] == pytest.approx(expected, rel=1e-4)


def test_calibration_of_a_voltage(bench):
    sensor = bench.sensor(zero_volts=2.5, volts_per_metre=-2e4, position_limits=(-1e-3, 1e-3))
    bench.volts[0] = 4.5
    assert sensor.measure()["psd_position"] == pytest.approx(-100e-6, abs=1e-8)


def test_a_refused_setting_is_explained(bench):
    t7 = LabJackT7("psd", bench.server.address, 1.0)
    with pytest.raises(DeviceError, match=r"exception 4 \(device failure\).*40000.*2370 \(AIN range"):
        t7.set_f32("AIN0_RANGE", 40000, 5.0)
    with pytest.raises(DeviceError, match="2373"):
        t7.set_u16("AIN0_NEGATIVE_CH", 41000, 7)
    with pytest.raises(DeviceError, match="2375"):
        t7.set_u16("AIN0_RESOLUTION_INDEX", 41500, 13)
    t7.close()


def test_a_setting_that_is_not_taken_is_noticed(bench):
    def alter(address: int, words: list[int]) -> list[int]:
        return [5] if address == 41500 else words

    with (
        ModbusTcpServer(Altered(bench.t7, alter)) as server,
        pytest.raises(DeviceError, match="AIN0_RESOLUTION_INDEX reads back 5 after 4"),
    ):
        T7PositionSensor.connect("psd", Settings(port=server.address), bench.clock)


# Wrong devices


@pytest.mark.parametrize(
    ("alter", "message"),
    [
        (lambda _, words: words[::-1], "swapped order"),
        (lambda _, words: [(w & 0xFF) << 8 | w >> 8 for w in words], "bytes of a word in swapped"),
        (lambda _, words: [0] * len(words), "no LabJack T-series: register TEST is 0x00000000"),
        (lambda address, words: [0] * len(words) if address == 55124 else words, "TEST_FLOAT32 is 0"),
        (lambda address, words: [0x4080, 0] if address == 60000 else words, "LabJack T4, not a T7"),
        (lambda address, words: [0x4110, 0] if address == 60000 else words, "another product.*is 9"),
    ],
)
def test_a_wrong_device_is_refused(bench, alter, message):
    with (
        ModbusTcpServer(Altered(bench.t7, alter)) as server,
        pytest.raises(DeviceConnectionError, match=message) as raised,
    ):
        T7PositionSensor.connect("psd", Settings(port=server.address), bench.clock)
    assert server.address in str(raised.value)


def test_a_device_without_test_registers_is_refused(bench):
    def refuse(address: int, words: list[int]) -> list[int]:
        raise RegisterError(2, "not here")

    with (
        ModbusTcpServer(Altered(bench.t7, refuse)) as server,
        pytest.raises(DeviceConnectionError, match=r"no LabJack T-series.*exception 2"),
    ):
        T7PositionSensor.connect("psd", Settings(port=server.address), bench.clock)


# Broken lines


def test_a_dead_address_is_named(caplog, capfd):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with (
        caplog.at_level(logging.DEBUG),
        pytest.raises(DeviceConnectionError, match=rf"psd: nobody .*tcp://127.0.0.1:{port}"),
    ):
        T7PositionSensor.connect("psd", Settings(port=f"127.0.0.1:{port}"), VirtualClock())
    assert not caplog.records
    assert capfd.readouterr() == ("", "")


def test_a_silent_host_costs_one_timeout():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(DeviceConnectionError, match=rf"no reply from tcp://127.0.0.1:{port} within 0.1 s"):
            T7PositionSensor.connect("psd", Settings(port=f"127.0.0.1:{port}", timeout=0.1), VirtualClock())


def test_a_connection_that_breaks_stays_broken(bench):
    sensor = bench.sensor()
    bench.server.close()
    with pytest.raises(DeviceConnectionError, match="connection broke"):
        sensor.measure()
    # A T7 that came back would have lost its settings: readings from it must not be taken for good ones.
    with ModbusTcpServer(bench.t7, port=bench.server.port):
        for take in (sensor.measure, sensor.glance):
            with pytest.raises(DeviceConnectionError, match="connect again"):
                take()


def test_closed_is_closed(bench):
    sensor = bench.sensor()
    sensor.close()
    sensor.close()
    sensor.safe()
    with pytest.raises(DeviceConnectionError, match="closed"):
        sensor.measure()


def test_a_host_that_hangs_up_in_the_middle():
    with Scripted(("0001 0000 0006 01 03 d73c 0002", None)) as server:
        t7 = LabJackT7("psd", server.address, 1.0)
        with pytest.raises(DeviceConnectionError, match="connection broke"):
            t7.read_u32(55100)


def test_too_few_registers_are_noticed():
    with Scripted(("0001 0000 0006 01 03 d73c 0002", "0001 0000 0005 01 03 02 0011")) as server:
        t7 = LabJackT7("psd", server.address, 1.0)
        with pytest.raises(DeviceError, match="1 registers where 2"):
            t7.read_u32(55100)
        t7.close()


# Bad signals


@pytest.mark.parametrize("volts", [10.0, -10.0, 10.4, -20.0, 30.0])
def test_over_range(bench, volts):
    sensor = bench.sensor(position_limits=(-1.0, 1.0))
    bench.volts[0] = volts
    for take in (sensor.measure, sensor.glance):
        with pytest.raises(DeviceError, match=r"psd: AIN0 reads .* over its range of ±10 V; choose a larger"):
            take()


def test_over_range_of_a_small_range(bench):
    sensor = bench.sensor(range=0.1, position_limits=(-1.0, 1.0))
    bench.volts[0] = 0.09
    assert sensor.measure()["psd_position"] == pytest.approx(0.9e-6, rel=1e-3)
    bench.volts[0] = 0.11
    with pytest.raises(DeviceError, match=r"±0\.1 V"):
        sensor.measure()


def test_one_clipped_conversion_spoils_a_mean(bench):
    sensor = bench.sensor()
    readings = iter([0.0] * 4 + [12.0] + [0.0] * 5)
    bench.t7._sources[0] = lambda: next(readings)
    with pytest.raises(DeviceError, match="over its range"):
        sensor.measure()


def test_outside_of_the_calibration(bench):
    sensor = bench.sensor(position_limits=(-50e-6, 50e-6))
    bench.volts[0] = 5.1
    with pytest.raises(DeviceError, match="outside of its calibrated range -5e-05 to 5e-05 m"):
        sensor.measure()
    bench.volts[0] = 4.9
    assert sensor.measure()["psd_position"] == pytest.approx(49e-6, rel=1e-3)


def test_light_lost(bench):
    sensor = bench.sensor(readout="currents", channels=(0, 1), minimum_sum_volts=1.0)
    bench.volts[0] = bench.volts[1] = 0.49
    for take in (sensor.measure, sensor.glance):
        with pytest.raises(DeviceError, match=r"light lost: .* 0.98 V, less than 1 V; check the laser"):
            take()
    bench.volts[0] = bench.volts[1] = 0.51
    assert sensor.measure()["psd_position"] == pytest.approx(0.0, abs=1e-7)


def test_darkness_does_not_divide_by_zero(bench):
    sensor = bench.sensor(readout="currents", channels=(0, 1))
    with pytest.raises(DeviceError, match="light lost"):
        sensor.measure()


@pytest.mark.parametrize("words", [[0xC61C, 0x3C00], [0x7FC0, 0x0000], [0x7F80, 0x0000]])
def test_an_invalid_conversion_is_no_reading(bench, words):
    def alter(address: int, actual: list[int]) -> list[int]:
        return words if address == 7600 else actual

    with ModbusTcpServer(Altered(bench.t7, alter)) as server:
        sensor = T7PositionSensor.connect("psd", Settings(port=server.address), bench.clock)
        with pytest.raises(DeviceError, match="no valid conversion"):
            sensor.measure()
        sensor.close()


def test_a_failure_in_the_instrument_is_passed_on(bench):
    def alter(address: int, words: list[int]) -> list[int]:
        if address == 7000:
            raise RegisterError(DEVICE_FAILURE, "no")
        return words

    with ModbusTcpServer(Altered(bench.t7, alter)) as server:
        sensor = T7PositionSensor.connect("psd", Settings(port=server.address), bench.clock)
        with pytest.raises(DeviceError, match=r"exception 4.*reading register 7000"):
            sensor.measure()
        sensor.close()
