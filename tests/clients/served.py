"""A `bench emulate` in another process, and its control socket."""

import json
import re
import socket
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

from bench.clock import Stopwatch, WallClock

PATIENCE = 60.0
"""Wall-clock time that a busy machine may take for anything, s."""


class Served:
    """Rigs that another process serves."""

    def __init__(self, process, endpoints):
        self.process = process
        rigs = endpoints.get("rigs", [endpoints])
        self._ports = {rig["rig"]: {name: each["port"] for name, each in rig["instruments"].items()} for rig in rigs}
        self.control_address = address(endpoints["control"])
        self._control = socket.create_connection(self.control_address, timeout=PATIENCE)
        self._answers = self._control.makefile("rb")

    def port(self, rig, instrument):
        """Return where an instrument is."""
        return self._ports[rig][instrument]

    def send(self, line):
        """Send a line to the control socket; return what it answers."""
        self._control.sendall(line + b"\n")
        return json.loads(self._answers.readline())

    def control(self, do, rig, **keys):
        """Make a request that is obeyed."""
        answer = self.send(json.dumps({"do": do, "rig": rig, **keys}).encode())
        assert "error" not in answer, answer
        return answer

    def truth(self, rig, name):
        """Return a true value of a laboratory."""
        return self.control("state", rig)["values"][name]["value"]

    def advance(self, rig, seconds):
        """Let laboratory time pass at once."""
        self.control("advance", rig, seconds=seconds)

    def close(self):
        self._answers.close()
        self._control.close()


def address(url):
    """Return host and port of `tcp://HOST:PORT`."""
    host, port = re.fullmatch(r"tcp://(.+):(\d+)", url).groups()
    return host, int(port)


def emulate(*arguments):
    """Return the command line of `bench emulate`."""
    return [sys.executable, "-m", "bench", "emulate", *map(str, arguments)]


@contextmanager
def served_rigs(folder, *arguments):
    """Serve rigs until the end of this context."""
    endpoints, log = Path(folder) / "endpoints.json", Path(folder) / "emulate.log"
    with log.open("wb") as output:
        process = subprocess.Popen(emulate(*arguments, "--json", endpoints), stdout=output, stderr=output)
    watch, clock = Stopwatch(), WallClock()
    try:
        while not endpoints.exists():
            assert process.poll() is None, log.read_text()
            assert watch.seconds() < 3 * PATIENCE, log.read_text()
            clock.sleep(0.05)
        served = Served(process, json.loads(endpoints.read_text()))
        try:
            yield served
        finally:
            served.close()
    finally:
        process.terminate()
        code = process.wait(PATIENCE)
    assert code == 0, log.read_text()
