"""minimalmodbus, mbpoll and pymodbus on the served load cell."""

import asyncio
import re

import pytest
from pymodbus.client import AsyncModbusSerialClient, ModbusSerialClient
from served import PATIENCE

GROSS, IDENTITY, COMMAND, FILTER, MOTION_RANGE, MOTION_TIME = 0x2000, 0x202C, 0x2061, 0x2106, 0x2112, 0x2114
SET_TARE, RESET_TARE = 8, 4


@pytest.fixture
def port(sma):
    return sma.port("load_cell")


@pytest.fixture
def hang(sma):
    """Hang a load (N) on the wire, and let it come to rest."""

    def hang(newtons):
        sma.control.operate("load", newtons)
        sma.control.advance(10.0)
        assert sma.control.state()["force"] == pytest.approx(newtons, abs=1e-3)

    return hang


SERIAL = ("-m", "rtu", "-a", 1, "-b", 38_400, "-P", "none", "-0", "-B", "-1", "-o", 10)


@pytest.fixture
def minimal(port):
    minimalmodbus = pytest.importorskip("minimalmodbus", reason="needs the package minimalmodbus")
    opened = []

    def connect():
        instrument = minimalmodbus.Instrument(port, 1)
        instrument.serial.baudrate, instrument.serial.timeout = 38_400, PATIENCE
        opened.append(instrument.serial)
        return instrument

    yield connect
    for line in opened:
        line.close()


@pytest.mark.parametrize("newtons", [2.0, 6.0])
def test_minimalmodbus_weighs(minimal, hang, newtons):
    cell = minimal()
    hang(newtons)
    assert cell.read_float(GROSS) == pytest.approx(newtons, abs=0.2)
    assert cell.read_float(GROSS, functioncode=4) == pytest.approx(newtons, abs=0.2)


def test_minimalmodbus_sets_the_filter(minimal):
    cell = minimal()
    for setting in (6, 3):
        cell.write_long(FILTER, setting)
        assert cell.read_long(FILTER) == setting


def test_mbpoll_weighs(port, hang, mbpoll):
    hang(4.0)
    polled = mbpoll(*SERIAL, "-r", GROSS, "-t", "4:float", port)
    assert polled.returncode == 0, polled.stderr
    shown = re.search(rf"\[{GROSS}\]:\s+(\S+)", polled.stdout)
    assert float(shown[1]) == pytest.approx(4.0, abs=0.2)


def test_mbpoll_writes(port, minimal, mbpoll):
    polled = mbpoll(*SERIAL, "-r", MOTION_TIME, "-t", "4:int", port, 900)
    assert polled.returncode == 0, polled.stderr
    cell = minimal()
    assert cell.read_long(MOTION_TIME) == 900
    cell.write_long(MOTION_TIME, 1000)


def test_pymodbus_tares(port, hang):
    hang(3.0)
    with ModbusSerialClient(port, baudrate=38_400, timeout=PATIENCE, retries=0) as client:
        # A cell as noisy as this one is never still within the 1 d as delivered.
        assert not client.write_registers(MOTION_RANGE, [0, 1000], device_id=1).isError()
        hang(3.0)
        assert not client.write_register(COMMAND, SET_TARE, device_id=1).isError()
        hang(5.0)
        words = client.read_holding_registers(GROSS, count=4, device_id=1).registers
        gross, net = client.convert_from_registers(words, client.DATATYPE.FLOAT32, "big")
        assert gross == pytest.approx(5.0, abs=0.2)
        assert net == pytest.approx(2.0, abs=0.3)
        assert not client.write_register(COMMAND, RESET_TARE, device_id=1).isError()
        assert not client.write_registers(MOTION_RANGE, [0, 1], device_id=1).isError()


def test_pymodbus_gets_refusals(port):
    with ModbusSerialClient(port, baudrate=38_400, timeout=PATIENCE, retries=0) as client:
        assert client.write_registers(FILTER, [0, 9], device_id=1).exception_code == 3
        assert client.read_holding_registers(0x1234, count=1, device_id=1).exception_code == 2
        assert client.read_coils(0, count=1, device_id=1).exception_code == 1


def test_pymodbus_with_asyncio_weighs(port, hang):
    hang(2.5)

    async def weigh():
        client = AsyncModbusSerialClient(port, baudrate=38_400, timeout=PATIENCE, retries=0)
        assert await client.connect()
        try:
            answers = [await client.read_input_registers(GROSS, count=2, device_id=1) for _ in range(5)]
            return [client.convert_from_registers(each.registers, client.DATATYPE.FLOAT32) for each in answers]
        finally:
            client.close()

    assert asyncio.run(weigh()) == pytest.approx([2.5] * 5, abs=0.2)
