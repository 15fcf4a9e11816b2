"""A MeCom client that was written from the specification alone, on the served TEC controller."""

import pytest
from cases import cases
from mecom_client import MeComClient, checksum

READY, RUN, ERROR = 1, 2, 3
STATUS, ERROR_NUMBER, OBJECT, CURRENT = 104, 105, 1000, 1020
INPUT, ENABLE, TARGET, LIVE_ENABLE, LIVE_CURRENT = 2000, 2010, 3000, 50000, 50001

VECTORS = (
    "#0015AA?IF62AE", "!0015AA8065-TEC SW G01     7199", "#0015AB?VR0064018000", "!0015AB000004411DBD",
    "#0015AC?VR0066018125", "!0015AC000000706F2C", "#0015AEVS07DA01000000028F97", "#0015AB?VR03E801C21A",
    "!0015AB41CD2F28D5C2", "#0015B0VS0BB80141AE0000C482", "#0015AC?VR04D2017BFE", "!0015AC+0532DA",
    "#00BDE2RS9780", "#0115AA?IF257D", "!0115AA8065-TEC SW G01     342D", "!0115AC+057509",
)  # fmt: skip
"""Frames of the maker's documents 5136AL and 5117C."""


@pytest.fixture
def connect(vo2):
    """Open the line of the controller once more; closed at the end of the test."""
    opened = []

    def connect(address=1):
        opened.append(MeComClient(vo2.port("tec"), address))
        return opened[-1]

    yield connect
    for client in opened:
        client.close()


@pytest.fixture
def tec(connect, vo2):
    """The controller, off and without an error, at the beginning and at the end."""
    client = connect()

    def switch_off():
        client.reset()
        vo2.control.advance(1.0)
        client.set_integer(LIVE_ENABLE, 0)
        client.set_integer(ENABLE, 0)
        assert client.integer(STATUS) == READY

    switch_off()
    yield client
    switch_off()


@cases("vector", VECTORS)
def test_the_client_agrees_with_the_frames_of_the_maker(vector):
    assert f"{checksum(vector[:-4].encode('ascii')):04X}" == vector[-4:]


def test_identity_and_type(tec):
    assert "TEC" in tec.identify()
    assert len(tec.identify()) == 20
    assert tec.integer(100) == 1091
    assert tec.integer(STATUS) == READY


def test_a_live_current_flows_and_heats(tec, vo2):
    tec.set_integer(INPUT, 1)
    before = vo2.control.state()["plate_temperature"]
    for amperes in (1.0, -0.5):
        tec.set_real(LIVE_CURRENT, amperes)
        tec.set_integer(ENABLE, 2)
        tec.set_integer(LIVE_ENABLE, 1)
        vo2.control.advance(2.0)
        assert tec.integer(STATUS) == RUN
        assert tec.real(CURRENT) == pytest.approx(amperes, abs=2e-3)
        assert vo2.control.state()["tec_current"] == pytest.approx(amperes, abs=1e-6)
        if amperes > 0:
            assert vo2.control.state()["plate_temperature"] > before + 0.5
    tec.set_integer(LIVE_ENABLE, 0)
    assert vo2.control.state()["tec_output"] == 0.0
    vo2.control.advance(1.0)
    assert vo2.control.state()["tec_current"] == pytest.approx(0.0, abs=1e-3)


def test_the_temperature_goes_to_its_target(tec, vo2):
    tec.set_integer(INPUT, 2)
    tec.set_real(TARGET, 31.5)
    tec.set_integer(ENABLE, 1)
    vo2.control.advance(200.0)
    assert tec.real(OBJECT) == pytest.approx(31.5, abs=0.05)
    assert vo2.control.state()["plate_temperature"] == pytest.approx(31.5, abs=0.05)


def test_each_reading_is_one_of_its_own(tec, connect, vo2):
    """Four hosts, one after the other, begin with the same sequence number while the plate heats."""
    tec.set_integer(INPUT, 1)
    tec.set_real(LIVE_CURRENT, 1.0)
    tec.set_integer(ENABLE, 2)
    tec.set_integer(LIVE_ENABLE, 1)
    readings = []
    for _ in range(4):
        vo2.control.advance(1.0)
        other = connect()
        readings.append(other.real(OBJECT))
        other.close()
    assert sorted(set(readings)) == readings


def test_any_device_answers_to_address_0(connect):
    assert connect(address=0).integer(100) == 1091


def test_a_lost_answer_is_asked_for_again(tec, vo2):
    tec.line.timeout = 2.0
    vo2.control.fault("tec.drop")
    assert tec.integer(100) == 1091
    vo2.control.fault("tec.corrupt")
    assert tec.integer(100) == 1091
