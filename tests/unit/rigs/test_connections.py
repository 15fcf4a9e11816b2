"""The devices of a rig over real sockets: a T7 accepts two connections, and a rig has more devices on it."""

import socket
from contextlib import ExitStack

import pytest
from modbus_tcp import ModbusTcpServer

from bench.base import VirtualClock
from bench.rig import Rig, load_rig
from drivers.labjack_t7.device import T7Device
from rigs.hybrid.laboratory import HybridLaboratory
from rigs.muscles.laboratory import SMALaboratory

ON_THE_T7 = {"hybrid": ["displacement", "base", "tip", "piezo"], "sma": ["wire_end", "fan"]}
READ_TEST = bytes.fromhex("0001 0000 0006 01 03 d73c 0002")


@pytest.fixture
def served(monkeypatch):
    """Have the laboratories serve their T7 on a socket of this machine."""
    with ExitStack() as stack:
        servers = []

        def on_a_socket(kind):
            opening = kind.open

            def open_(laboratory):
                servers.append(stack.enter_context(ModbusTcpServer(laboratory.t7)))
                return {**opening(laboratory), "t7": servers[-1].address}

            monkeypatch.setattr(kind, "open", open_)

        for kind in (HybridLaboratory, SMALaboratory):
            on_a_socket(kind)
        yield servers


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("hybrid", {}),
        ("hybrid", {"devices.base.timeout": "30.0", "devices.tip.timeout": "20.0", "devices.piezo.timeout": "40.0"}),
        ("sma", {}),
    ],
    ids=["hybrid", "hybrid, with a time-out each", "sma"],
)
def test_the_devices_of_a_rig_share_one_of_two_connections(name, overrides, served):
    with Rig(load_rig(name, overrides), VirtualClock(), 1) as rig:
        on_the_t7 = [each for each, device in rig.devices.items() if isinstance(device, T7Device)]
        assert on_the_t7 == ON_THE_T7[name]
        assert set(rig.glance()) == {signal.name for signal in rig.signals}
        (server,) = served
        with socket.create_connection(("127.0.0.1", server.port), timeout=60) as second:
            second.sendall(READ_TEST)
            assert second.recv(100)[-4:] == bytes.fromhex("0011 2233")
            with socket.create_connection(("127.0.0.1", server.port), timeout=60) as third:
                try:
                    third.sendall(READ_TEST)
                    assert third.recv(100) == b""
                except ConnectionError:
                    pass
            rig.measure()
