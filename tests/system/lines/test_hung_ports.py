"""An adapter that hangs: its port stays open and takes nothing any more. Every driver says so within its bound."""

import os
import select
import sys
import threading
import tty
from contextlib import contextmanager
from pathlib import Path

import pytest

from bench.base import DeviceConnectionError, DeviceError, WallClock
from bench.rig import load_rig
from drivers.serial_line import holder_of
from sim_devices.wire.shared import joined

if sys.platform == "win32":
    pytest.skip("needs pseudo-terminals", allow_module_level=True)

EXAMPLES = Path(__file__).parents[3] / "examples"
TIMEOUT, LONGEST = 0.1, 30.0
"""Wait for an answer, and the wall-clock time after which a call hangs, s; on an idle computer they take 1 s."""


class Adapter:
    """A pseudo-terminal to an emulated instrument, which can hang."""

    def __init__(self, server):
        self._server = server
        self._host, self._node = os.openpty()
        for end in (self._host, self._node):
            tty.setraw(end)
        self.port = os.ttyname(self._node)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._pass_on, daemon=True)
        self._thread.start()

    def _pass_on(self):
        while not self._ended.is_set():
            if select.select([self._host], [], [], 0.02)[0]:
                os.write(self._host, self._server.receive(os.read(self._host, 4096)))

    def hang(self):
        """Take nothing any more; what the system keeps for it is full."""
        self._ended.set()
        self._thread.join()
        os.set_blocking(self._node, False)
        # The system moves bytes on after a while.
        while select.select([], [self._node], [], 0.05)[1]:
            try:
                os.write(self._node, b"#")
            except BlockingIOError:
                continue

    def close(self):
        self._ended.set()
        self._thread.join()
        os.close(self._host)
        os.close(self._node)


@contextmanager
def hanging(path, name, *, is_shared=False):
    """Connect a device of a rig, with its neighbours if they share, over an adapter that hangs from then on."""
    path, clock = Path(path), WallClock()
    file = load_rig(str(path))
    entries = {each.name: each for each in file.devices}
    line = getattr(entries[name].settings, "line", "")
    sharing = [each for each in entries.values() if is_shared and each.settings.line == line] or [entries[name]]
    servers = file.laboratory(file.laboratory_settings, clock, 0).servers
    adapter = Adapter(joined("+".join(each.name for each in sharing), servers))
    devices = []
    try:
        for entry in sharing:
            if path.stem == "pymeasure-supply":
                port, brief = f"alt://{adapter.port}", {"options": {"timeout": TIMEOUT}}
            else:
                port, brief = adapter.port, {"timeout": TIMEOUT}
            update = {"port": port} | brief | ({"line": ""} if line and not is_shared else {})
            devices.append(entry.driver.connect(entry.name, entry.settings.model_copy(update=update), clock))
            devices[-1].glance()
        adapter.hang()
        yield devices, port
    finally:
        adapter.close()


def outcome(call):
    """Return what a call raises; fail if it does not return."""
    raised = []

    def carry_out():
        try:
            call()
        except Exception as error:
            raised.append(error)

    thread = threading.Thread(target=carry_out, daemon=True)
    thread.start()
    thread.join(LONGEST)
    assert not thread.is_alive(), "it hangs"
    return raised[0] if raised else None


@pytest.mark.parametrize("name", ["load1", "heater1", "tec1", "servo1", "supply1", "meter", "supply"])
def test_a_port_that_hangs_is_a_lost_line(buses, name):
    path = {"meter": EXAMPLES / "bench-supply.toml", "supply": EXAMPLES / "pymeasure-supply.toml"}.get(name, buses)
    if name == "supply":
        pytest.importorskip("pymeasure")
    with hanging(path, name) as ((device,), port):
        # Other programs are kept out.
        assert sys.platform != "linux" or holder_of(port.removeprefix("alt://"))[0] == os.getpid()
        for call in (device.glance, device.reconnect):
            error = outcome(call)
            assert isinstance(error, DeviceConnectionError)
            assert f"lost the line {port} " in error.text or f"cannot open {port}: " in error.text
        if name not in ("load1", "meter"):
            assert isinstance(outcome(device.safe), DeviceError)
        outcome(device.close)


@pytest.mark.parametrize("name", ["tec1", "supply1"])
def test_a_port_that_hangs_is_lost_for_all_that_share_it(buses, name):
    with hanging(buses, name, is_shared=True) as (devices, port):
        assert len(devices) == 2
        for device in devices:
            error = outcome(device.glance)
            assert isinstance(error, DeviceConnectionError)
            assert f"lost the line {port} " in error.text
            outcome(device.close)
