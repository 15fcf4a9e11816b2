"""canopen over python-can's slcan on the served voltage supply."""

import pytest
from served import PATIENCE

from bench.base import Stopwatch, WallClock

canopen = pytest.importorskip("canopen")

NODE = 1


@pytest.fixture
def connect(sma):
    """Open the adapter once more; closed at the end of the test."""
    opened = []

    def connect():
        network = canopen.Network()
        network.connect(interface="slcan", channel=sma.port("supply"), bitrate=125_000, sleep_after_open=0)
        opened.append(network)
        node = network.add_node(NODE, canopen.ObjectDictionary())
        node.sdo.RESPONSE_TIMEOUT = PATIENCE
        return network, node

    yield connect
    for network in opened:
        network.disconnect()


def upload(node, index, sub, signed=False):
    return int.from_bytes(node.sdo.upload(index, sub), "little", signed=signed)


def command(node, value):
    node.sdo.download(0x2000, 1, value.to_bytes(4, "little", signed=True))


def test_the_heartbeat_is_heard_on_an_idle_line(connect):
    _, node = connect()
    # Nothing is sent from here on.
    for _ in range(3):
        assert node.nmt.wait_for_heartbeat(PATIENCE) == "OPERATIONAL"


def test_a_command_applies_a_voltage_and_the_current_heats(connect, sma):
    _, node = connect()
    command(node, 0)
    cold = sma.control.state()["muscle_temperature"]
    for _ in range(4):
        command(node, 300)
        sma.control.advance(1.0)
    assert upload(node, 0x2102, 1, signed=True) == 300
    assert upload(node, 0x2100, 1, signed=True) / 10 == pytest.approx(sma.control.state()["supply_current"], abs=0.3)
    assert sma.control.state()["supply_voltage"] == pytest.approx(3.0)
    assert sma.control.state()["muscle_temperature"] > cold + 5.0
    command(node, 0)
    assert sma.control.state()["supply_voltage"] == 0.0


def test_silence_of_commands_trips_the_watchdog(connect, sma):
    _, node = connect()
    command(node, 200)
    # Queries do not feed it; 5 s are set.
    for _ in range(7):
        sma.control.advance(1.0)
        upload(node, 0x210D, 2)
    assert sma.control.state()["supply_voltage"] == 0.0
    command(node, 0)


def test_texts_come_in_segments(connect):
    _, node = connect()
    assert node.sdo.upload(0x1008, 0) == b"Roboteq SDC2160"


def test_an_abort_is_raised(connect):
    _, node = connect()
    with pytest.raises(canopen.SdoAbortedError) as refused:
        node.sdo.upload(0x5FFF, 0)
    assert refused.value.code == 0x0602_0000


def test_network_management_and_the_boot_up_after_a_restart(connect, sma):
    network, node = connect()
    node.nmt.state = "PRE-OPERATIONAL"
    watch = Stopwatch()
    while node.nmt.wait_for_heartbeat(PATIENCE) != "PRE-OPERATIONAL":
        assert watch.seconds() < PATIENCE
    boots = []
    network.subscribe(0x700 + NODE, lambda _, data, __: boots.append(data[0]))
    sma.control.fault("supply.power-cycle")
    while 0 not in boots:
        assert watch.seconds() < PATIENCE
        WallClock().sleep(0.01)
    assert node.nmt.wait_for_heartbeat(PATIENCE) == "OPERATIONAL"


def test_the_adapter_is_opened_again(connect):
    for _ in range(3):
        network, node = connect()
        assert upload(node, 0x1000, 0) == 0x000F0191
        network.disconnect()
