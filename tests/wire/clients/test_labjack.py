"""pymodbus and mbpoll on the served LabJack T7, which takes two connections."""

import asyncio
import re

import pytest
from pymodbus.client import AsyncModbusTcpClient, ModbusTcpClient
from served import PATIENCE, address

AIN0, DAC0, FIO0, TEST, SERIAL = 0, 1000, 2000, 55100, 60028


@pytest.fixture
def place(sma):
    """Host and port."""
    return address(sma.port("t7"))


@pytest.fixture
def client(place):
    with ModbusTcpClient(place[0], port=place[1], timeout=PATIENCE, retries=0) as client:
        yield client


def real(client, register):
    words = client.read_holding_registers(register, count=2, device_id=1).registers
    return client.convert_from_registers(words, client.DATATYPE.FLOAT32)


def test_an_output_reads_back(client):
    words = client.convert_to_registers(2.5, client.DATATYPE.FLOAT32)
    assert not client.write_registers(DAC0, words, device_id=1).isError()
    assert real(client, DAC0) == 2.5


def test_a_digital_line_switches_the_fan(client, sma):
    for level in (1, 0):
        assert not client.write_register(FIO0, level, device_id=1).isError()
        assert sma.control.state()["fan"] == level


def test_an_input_follows_the_wire(client, sma):
    sma.control.operate("load", 1.0)
    sma.control.advance(10.0)
    shares, positions = [], []
    for newtons in (1.0, 9.0):
        sma.control.operate("load", newtons)
        sma.control.advance(10.0)
        shares.append(real(client, AIN0) / real(client, AIN0 + 2))
        positions.append(sma.control.state()["position"])
    # 0.5 to 4.5 V of 5 V over a stroke of 35 mm.
    assert (shares[1] - shares[0]) / 0.8 * 35e-3 == pytest.approx(positions[1] - positions[0], abs=2e-4)
    assert positions[1] - positions[0] > 2e-4


def test_a_refusal_is_an_exception_frame(client):
    words = client.convert_to_registers(3.0, client.DATATYPE.FLOAT32)
    refused = client.write_registers(40_000, words, device_id=1)
    assert refused.isError()
    assert client.read_holding_registers(55_000, count=1, device_id=1).registers == [2370]


def test_asyncio_reads_at_the_same_time(place):
    async def read():
        clients = [AsyncModbusTcpClient(place[0], port=place[1], timeout=PATIENCE, retries=0) for _ in range(2)]
        try:
            for client in clients:
                assert await client.connect()
            answers = await asyncio.gather(
                *(client.read_holding_registers(TEST, count=2, device_id=1) for client in clients for _ in range(20))
            )
            return {tuple(answer.registers) for answer in answers}
        finally:
            for client in clients:
                client.close()

    assert asyncio.run(read()) == {(0x0011, 0x2233)}


def test_mbpoll_reads(place, mbpoll):
    polled = mbpoll("-m", "tcp", "-p", place[1], "-0", "-r", TEST, "-t", "4:hex", "-c", 2, "-1", "-o", 10, place[0])
    assert polled.returncode == 0, polled.stderr
    assert re.findall(r"0x([0-9A-F]{4})", polled.stdout) == ["0011", "2233"]


def test_mbpoll_writes(place, client, mbpoll):
    polled = mbpoll(
        "-m", "tcp", "-p", place[1], "-0", "-r", DAC0, "-t", "4:float", "-B", "-1", "-o", 10, place[0], 1.25
    )
    assert polled.returncode == 0, polled.stderr
    assert real(client, DAC0) == 1.25
