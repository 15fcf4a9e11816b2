"""An emulated text instrument in process, with what it was asked."""

import numpy as np

from bench.base import VirtualClock
from drivers.scpi import SCPIActuator
from sim_devices import protocol_emulated
from sim_devices.instruments.scpi import EmulatedTextInstrument, Meter
from sim_devices.wire.text import TextServer
from sim_devices.world import World

SUPPLY = {
    "identity": "EXAMPLE,PS-3005,{any}",
    "error_query": "SYST:ERR?",
    "completion_query": "*OPC?",
    "setup": ["VOLT:PROT 31"],
    "signals": {
        "voltage": {"query": "MEAS:VOLT?", "unit": "V"},
        "current": {"query": "MEAS:CURR?", "unit": "A", "scale": 1e-3},
    },
    "setpoint": {
        "command": "VOLT {value:.3f}",
        "query": "VOLT?",
        "unit": "V",
        "limits": [0.0, 30.0],
        "resolution": 0.001,
    },
    "output": {"on": ["CURR 1.0", "OUTP ON"], "off": ["OUTP OFF"], "query": "OUTP?"},
}


class Nothing:
    def advance(self, dt):
        pass


class Laboratory:
    """One emulated instrument of a table on a line in process, on the virtual clock."""

    def __init__(self, stack, table=SUPPLY, kind=SCPIActuator, **changes):
        self.clock = VirtualClock()
        self.kind = kind
        self.settings = kind.Settings(port="emulated://scpi-test", **{**table, **changes})
        self.delivered = []
        self.current = 0.25
        output = hasattr(self.settings, "output")
        meters = {name: Meter(self._read(name)) for name in self.settings.signals}
        self.instrument = EmulatedTextInstrument(
            "supply",
            World(Nothing(), self.clock),
            self.settings,
            meters,
            np.random.default_rng(1),
            self.delivered.append if output else None,
        )
        self.requests = []
        server = TextServer(self.instrument)
        receive = server.receive

        def record(data):
            self.requests.append(data.decode(errors="replace").strip())
            return self.answer(data, receive)

        server.receive = record
        self.answer = lambda data, usual: usual(data)
        self.server = server
        protocol_emulated.register("scpi-test", server, self.clock)
        stack.callback(protocol_emulated.unregister, "scpi-test")

    def _read(self, name):
        return lambda: self.instrument.output if name == "voltage" else self.current

    def connect(self):
        device = self.kind.connect("supply", self.settings, self.clock)
        self.requests.clear()
        return device
