"""The maker's SDK on the served servo."""

import warnings

import pytest
from served import PATIENCE

from bench.base import Stopwatch, WallClock

TORQUE_ENABLE, PROFILE_VELOCITY, GOAL_POSITION, PRESENT_POSITION, BUS_WATCHDOG = 64, 112, 116, 132, 98
COUNT = 6.283185307179586 / 4096


@pytest.fixture(scope="module")
def sdk():
    with warnings.catch_warnings():
        # The SDK has invalid escape sequences.
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="dynamixel_sdk")
        warnings.filterwarnings("ignore", category=SyntaxWarning, module="dynamixel_sdk")
        return pytest.importorskip("dynamixel_sdk", reason="needs the package dynamixel-sdk")


@pytest.fixture
def connect(sdk, sma):
    """Open the line of the servo once more; closed at the end of the test."""

    class PatientPort(sdk.PortHandler):
        """The SDK allows some 35 ms, which a busy machine may need for the answer."""

        def setPacketTimeout(self, packet_length):  # noqa: ARG002 - the SDK's form
            self.setPacketTimeoutMillis(1e3 * PATIENCE)

    opened = []

    def connect():
        port = PatientPort(sma.port("stage"))
        assert port.setBaudRate(57_600)
        opened.append(port)
        return Servo(sdk.PacketHandler(2.0), port)

    yield connect
    for port in opened:
        if port.is_open:
            port.closePort()


class Servo:
    """Reads and writes of the SDK whose result is checked."""

    def __init__(self, handler, port):
        self.handler = handler
        self.port = port

    def read(self, address, size=4):
        read = {1: self.handler.read1ByteTxRx, 2: self.handler.read2ByteTxRx, 4: self.handler.read4ByteTxRx}[size]
        value, result, error = read(self.port, 1, address)
        assert (result, error) == (0, 0), self.handler.getTxRxResult(result)
        return value

    def write(self, address, value, size=4):
        write = {1: self.handler.write1ByteTxRx, 4: self.handler.write4ByteTxRx}[size]
        result, error = write(self.port, 1, address, value)
        assert (result, error) == (0, 0), self.handler.getTxRxResult(result)


def test_the_goal_position_moves_the_shaft(connect, sma):
    servo = connect()
    model, result, error = servo.handler.ping(servo.port, 1)
    assert (model, result, error) == (30, 0, 0)
    servo.write(TORQUE_ENABLE, 1, 1)
    assert sma.control.state()["stage_torque"] == 1.0
    for goal in (2000, 2400):
        servo.write(GOAL_POSITION, goal)
        sma.control.advance(5.0)
        assert servo.read(PRESENT_POSITION) == pytest.approx(goal, abs=2)
        assert sma.control.state()["stage_angle"] == pytest.approx(goal * COUNT, abs=2 * COUNT)
    servo.write(TORQUE_ENABLE, 0, 1)
    assert sma.control.state()["stage_torque"] == 0.0


def test_a_slow_profile_takes_the_wall_clock_of_the_server(connect):
    servo, watch, clock = connect(), Stopwatch(), WallClock()
    servo.write(TORQUE_ENABLE, 1, 1)
    start = servo.read(PRESENT_POSITION)
    servo.write(PROFILE_VELOCITY, 5)  # 78 counts a second
    servo.write(GOAL_POSITION, start + 100 if start < 3000 else start - 100)
    positions = [start]
    while abs(positions[-1] - start) < 90:
        assert watch.seconds() < PATIENCE
        clock.sleep(0.02)
        positions.append(servo.read(PRESENT_POSITION))
    # It has been seen on its way, and did not jump.
    assert len({round(position / 10) for position in positions}) > 4
    servo.write(PROFILE_VELOCITY, 0)
    servo.write(TORQUE_ENABLE, 0, 1)
