"""Emulated instruments on one line hear each other, and answer only what is theirs, however the bytes are cut."""

import numpy as np
import pytest

from bench.base import VirtualClock
from bench.rig import load_rig
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire import WireServer
from sim_devices.wire.shared import joined


class Recording(WireServer):
    """A line that keeps what was asked and answered on it."""

    def __init__(self, server):
        self.server, self.kept = server, []

    def receive(self, data):
        answer = self.server.receive(data)
        self.kept.append((data, answer))
        return answer


def recorded(buses, line):
    """Return the requests and answers of two looks at all devices of a line, and the names of their instruments."""
    file, clock = load_rig(buses), VirtualClock()
    laboratory = file.laboratory(file.laboratory_settings, clock, 0)
    entries = [entry for entry in file.devices if entry.settings.line == line]
    name = entries[0].settings.port.removeprefix("emulated://")
    recording = Recording(joined(name, laboratory.servers))
    address = register("recorded", recording, clock)
    devices = [
        entry.driver.connect(entry.name, entry.settings.model_copy(update={"port": address}), clock)
        for entry in entries
    ]
    for _ in range(2):
        for device in devices:
            device.measure()
    for device in devices:
        device.close()
    unregister(address)
    return recording.kept, name


@pytest.mark.parametrize(("line", "head"), [("cells", 2), ("heaters", 2), ("tecs", 7), ("servos", 8)])
def test_requests_in_pieces_are_answered_by_whom_they_are_meant_for(buses, line, head):
    kept, name = recorded(buses, line)
    assert len(kept) > 10
    file, rng = load_rig(buses), np.random.default_rng(1)
    laboratory = file.laboratory(file.laboratory_settings, VirtualClock(), 0)
    shared = joined(name, laboratory.servers)
    for request, answer in kept:
        cut = int(rng.integers(len(request)))
        found = shared.receive(request[:cut]) + shared.receive(request[cut:])
        # What is measured has noise.
        assert (len(found), found[:head]) == (len(answer), answer[:head])


def test_noise_between_the_frames_of_others_is_passed_over(buses):
    kept, name = recorded(buses, "cells")
    file = load_rig(buses)
    laboratory = file.laboratory(file.laboratory_settings, VirtualClock(), 0)
    shared, rng = joined(name, laboratory.servers), np.random.default_rng(2)
    for request, answer in kept:
        assert shared.receive(bytes(rng.integers(128, 256, int(rng.integers(1, 20))))) == b""
        found = shared.receive(request)
        assert (len(found), found[:2]) == (len(answer), answer[:2])


def test_what_is_no_instrument_with_a_serial_line_cannot_be_joined(buses):
    file = load_rig("sma")
    laboratory = file.laboratory(file.laboratory_settings, VirtualClock(), 0)
    for name in ("stage+nothing", "stage+t7", "echo"):
        with pytest.raises(ValueError, match=f"'{name.replace('+', '.')}': .*load_cell, stage"):
            joined(name, laboratory.servers)
