"""PyMeasure's instruments in a role, against PyMeasure's own protocol tests and the emulated supply on TCP."""

import math
import socket
from importlib.util import find_spec

import numpy as np
import pytest
from cases import cases
from still_plant import Still

from bench.base import (
    ConfigurationError,
    DeviceConnectionError,
    DeviceError,
    DeviceRestartedError,
    LimitError,
    VirtualClock,
)
from bench.contracts import ActuatorContract, ActuatorLineLostContract, RestartedActuatorContract
from bench.devices import ActuatorTable
from bench.rig import load_rig
from drivers.pymeasure import Adapter, SensorAdapter, parse_action
from sim_devices.instruments.scpi import EmulatedTextInstrument, Meter
from sim_devices.wire.text import TextServer
from sim_devices.world import World

pytestmark = pytest.mark.skipif(find_spec("pymeasure") is None, reason="could not import 'pymeasure'")

TABLE = {
    "instrument": "pymeasure.instruments.keithley:Keithley2260B",
    "identity": "EXAMPLE,2260B,{any}",
    "setup": ["output_enabled = False"],
    "before_on": ["current_limit = 1.5"],
    "on": ["output_enabled = True"],
    "safe": ["voltage_setpoint = 0", "output_enabled = False"],
    "output": "output_enabled",
    "setpoint": {"property": "voltage_setpoint", "unit": "V", "limits": [0.0, 30.0], "resolution": 0.001},
    "signals": {"voltage": {"property": "voltage", "unit": "V"}, "current": {"property": "current", "unit": "A"}},
}


def expected_protocol(exchange):
    """Return the instrument on PyMeasure's own protocol test."""
    # Here, as it takes a second to load, and each worker of the tests loads each module.
    from pymeasure.instruments.keithley import Keithley2260B
    from pymeasure.test import expected_protocol

    return expected_protocol(Keithley2260B, exchange)


def on_protocol(instrument, kind=Adapter, table=TABLE):
    """Return the adapter of an instrument that PyMeasure itself has made."""
    settings, clock = kind.Settings(port="none", **table), VirtualClock()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("drivers.pymeasure.instrument_class", lambda _: lambda _: instrument)
        line = kind.Line("supply", settings, clock)
    return kind("supply", settings, clock, line)


def test_what_is_sent_is_what_pymeasure_expects():
    exchange = [
        ("OUTPut 0", None),
        (":SOUR:CURR 1.5", None),
        (":SOUR:VOLT 12.5", None),
        (":SOUR:VOLT?", "12.500"),
        ("OUTPut 1", None),
        ("OUTPut?", "1"),
        ("OUTPut?", "1"),
        (":SOUR:VOLT 3", None),
        (":SOUR:VOLT?", "3.000"),
        (":MEAS:VOLT?", "3.001"),
        (":MEAS:CURR?", "0.25"),
        ("OUTPut?", "1"),
        (":SOUR:VOLT?", "3.000"),
        (":SOUR:VOLT 0", None),
        ("OUTPut 0", None),
        ("OUTPut?", "0"),
    ]
    with expected_protocol(exchange) as instrument:
        supply = on_protocol(instrument)
        supply.set(12.5).wait()
        supply.set(3.0).wait()
        assert supply.setpoint == 3.0
        assert supply.measure() == {"supply_voltage": 3.001, "supply_current": 0.25}
        with pytest.raises(LimitError):
            supply.set(30.1)
        supply.safe()
        assert math.isnan(supply.setpoint)


@cases(
    ("exchange", "text"),
    [
        ([(":MEAS:VOLT?", "OL")], "voltage is 'OL', expected a number"),
        ([(":MEAS:VOLT?", "9.9E37")], "voltage is 9.9e[+]37; is it out of its range"),
        ([(":MEAS:VOLT?", "1,2")], r"voltage is \[1.0, 2.0\], expected a number"),
    ],
)
def test_what_is_no_number_is_an_error(exchange, text):
    table = {key: TABLE[key] for key in ("instrument", "signals")}
    with expected_protocol(exchange) as instrument:
        meter = on_protocol(instrument, SensorAdapter, table)
        with pytest.raises(DeviceError, match=f"supply: {text}"):
            meter.measure()


def test_errors_of_the_instrument_are_one_message():
    exchange = [
        (":MEAS:VOLT?", "1"),
        ("SYST:ERR?", '-310,"System error"'),
        ("SYST:ERR?", '-330,"Self-test failed"'),
        ("SYST:ERR?", '0,"No error"'),
    ]
    table = {"instrument": TABLE["instrument"], "check_errors": True}
    signals = {"voltage": TABLE["signals"]["voltage"]}
    with expected_protocol(exchange) as instrument:
        meter = on_protocol(instrument, SensorAdapter, {**table, "signals": signals})
        with pytest.raises(DeviceError, match=r"after measuring: .*System error.*; .*Self-test failed"):
            meter.measure()


def test_closing_shuts_the_instrument_down_unless_told_otherwise():
    with expected_protocol([("OUTPut 0", None)]) as instrument:
        on_protocol(instrument).close()
    with expected_protocol([]) as instrument:
        on_protocol(instrument, table={**TABLE, "shutdown": False}).close()


@cases("text", ["output_enabled", "a.b = c", "f(x)", "f(); g()", "_x = 1", "f(*[1])", "import os", "="])
def test_an_action_is_a_call_or_an_assignment_of_literals(text):
    with pytest.raises(ValueError, match="expected a call such as"):
        parse_action(text)


def test_actions_reach_channels():
    class Channel:
        def ramp(self, *values, **options):
            self.ramped = (values, options)

    class Instrument:
        ch_1 = Channel()

    parse_action("ch_1.voltage = -2.5")(Instrument)
    parse_action("ch_1.ramp(1, 'fast', step=0.1)")(Instrument)
    assert Instrument.ch_1.voltage == -2.5
    assert Instrument.ch_1.ramped == ((1, "fast"), {"step": 0.1})


SUPPLY = ActuatorTable(
    identity="EXAMPLE,2260B,{any}",
    error_query="SYST:ERR?",
    setup=["SOUR:CURR 1.5"],
    signals={"voltage": {"query": "MEAS:VOLT?", "unit": "V"}, "current": {"query": "MEAS:CURR?", "unit": "A"}},
    setpoint={"command": "SOUR:VOLT {value:g}", "query": "SOUR:VOLT?", "unit": "V", "limits": [0.0, 30.0]},
    output={"on": ["OUTPut 1"], "off": ["OUTPut 0"], "query": "OUTPut?"},
)


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def instrument(clock):
    meters = {"voltage": Meter(lambda: emulated.output), "current": Meter(lambda: 0.1 * emulated.output)}
    emulated = EmulatedTextInstrument("supply", World(Still(), clock), SUPPLY, meters, np.random.default_rng(0))
    return emulated


@pytest.fixture
def connect(instrument, clock, tcp_port):
    with tcp_port(TextServer(instrument)) as port:
        address = f"TCPIP0::127.0.0.1::{port}::SOCKET"
        options = {"visa_library": "@py", "write_termination": "\n", "timeout": 20_000}
        settings = Adapter.Settings(port=address, options=options, check_errors=True, **TABLE)
        yield lambda: Adapter.connect("supply", settings, clock)


@pytest.fixture
def supply(connect):
    device = connect()
    yield device
    device.close()


class TestContractOverTCP(ActuatorContract):
    driven = "voltage"

    @pytest.fixture
    def device(self, supply):
        return supply

    @pytest.fixture
    def effects(self, instrument):
        return lambda: instrument.output

    @pytest.fixture
    def identity(self):
        return "EXAMPLE 2260B, serial number emulated, firmware unknown"


class OnASupply:
    @pytest.fixture
    def device(self, supply):
        return supply

    @pytest.fixture
    def set_points(self):
        return 7.5, 22.5

    @pytest.fixture
    def restart(self, instrument):
        return instrument.power_cycle

    @pytest.fixture
    def output(self, instrument):
        return lambda: instrument.output


class TestRestart(OnASupply, RestartedActuatorContract):
    def test_a_restart_at_rest_is_found_before_the_output_goes_on(self, in_use, restart, instrument, monkeypatch):
        """The safe state has set 0 V as a restart does, so none is seen; but the limits are written first."""
        in_use.safe()
        restart()
        sent, obey = [], instrument.obey
        monkeypatch.setattr(instrument, "obey", lambda line: sent.append(line) or obey(line))
        in_use.set(6.0)
        assert sent.index(":SOUR:CURR 1.5") < sent.index(":SOUR:VOLT 6") < sent.index("OUTPut 1")


class TestLineLost(OnASupply, ActuatorLineLostContract):
    @pytest.fixture
    def cut(self, supply, monkeypatch):
        def cut():
            supply._line.instrument.adapter.connection.close()
            monkeypatch.setattr("drivers.pymeasure.instrument_class", unreachable)

        def unreachable(reference):
            raise OSError("the cable is out")

        return cut

    @pytest.fixture
    def mend(self, monkeypatch):
        return monkeypatch.undo

    @pytest.fixture
    def exchange(self, instrument):
        def exchange():
            instrument._actions["*IDN?"] = lambda: "EXAMPLE,2260B,another"
            instrument._heard.clear()

        return exchange

    @pytest.fixture
    def truth(self, instrument):
        return lambda: {"supply_voltage": instrument.output, "supply_current": 0.1 * instrument.output}

    @pytest.fixture
    def tolerance(self):
        return 1e-6


def test_an_instrument_of_another_kind_is_refused(connect, instrument, monkeypatch):
    monkeypatch.setitem(instrument._actions, "*IDN?", lambda: "OTHER,METER,1,1")
    with pytest.raises(DeviceConnectionError, match=r"is 'OTHER,METER,1,1', expected 'EXAMPLE,2260B,\{any\}'"):
        connect()


RIG = """
[rig]
title = "one supply"

[devices.supply]
driver = "pymeasure"
instrument = "pymeasure.instruments.keithley:Keithley2260B"
port = "GPIB0::5::INSTR"
safe = ["output_enabled = False"]

[devices.supply.setpoint]
property = "voltage_setpoint"
unit = "V"
limits = [0.0, 30.0]

[devices.supply.signals.voltage]
property = "voltage"
unit = "V"
"""

WRONG = {
    "instrument=pymeasure.instruments.keithley:Keithley1": ("instrument = ", "has no attribute 'Keithley1'"),
    "instrument=pathlib:Path": ("instrument = 'pathlib:Path': is no instrument of PyMeasure",),
    "setpoint.property=volts": ("setpoint", "'volts': pymeasure.instruments.keithley:Keithley2260B has no such"),
    "signals.voltage.property=volts": (
        "signals",
        "'volts': pymeasure.instruments.keithley:Keithley2260B has no such",
    ),
    "signals.voltage.unit=volts-ish": ("signals.voltage.unit", "is no unit"),
    'safe=["output_enabled"]': ("safe.0 = 'output_enabled'", "expected a call such as"),
    "safe=[]": ("safe",),
}


@pytest.mark.parametrize("change", WRONG)
def test_a_wrong_key_is_one_message_before_anything_is_opened(change, tmp_path):
    (tmp_path / "rig.toml").write_text(RIG)
    key, _, value = change.partition("=")
    with pytest.raises(ConfigurationError) as raised:
        load_rig(str(tmp_path / "rig.toml"), {f"devices.supply.{key}": value})
    assert str(raised.value).startswith(f"{tmp_path / 'rig.toml'}: devices.supply.{WRONG[change][0]}")
    for part in WRONG[change]:
        assert part in str(raised.value)
    assert len(str(raised.value).splitlines()) == 1


def test_without_the_library_one_message_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "rig.toml").write_text(RIG)
    monkeypatch.setattr("drivers.pymeasure.importlib.util.find_spec", lambda _: None)
    with pytest.raises(ConfigurationError, match=r"pip install '.+\[pymeasure\]'") as raised:
        load_rig(str(tmp_path / "rig.toml"))
    assert len(str(raised.value).splitlines()) == 1


def test_an_address_without_an_instrument_is_a_connection_error():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        address = f"TCPIP0::127.0.0.1::{listener.getsockname()[1]}::SOCKET"
    settings = Adapter.Settings(port=address, options={"visa_library": "@py"}, **TABLE)
    with pytest.raises(DeviceConnectionError, match=r"^supply: (cannot open|lost the line)"):
        Adapter.connect("supply", settings, VirtualClock())


class Supply:
    """An instrument of another library's making: what was done to it, and properties that fail."""

    id = "EXAMPLE,2260B,7,1.0"

    def __init__(self):
        from types import SimpleNamespace

        self.done, self.failing, self.closed = [], {}, 0
        self.values = {"voltage_setpoint": 0.0, "output_enabled": False, "voltage": 0.0, "current": 0.25}
        self.errors = []
        self.adapter = SimpleNamespace(close=lambda: setattr(self, "closed", self.closed + 1))

    def __getattr__(self, name):
        if name in ("values", "failing") or name not in self.values:
            raise AttributeError(name)
        if name in self.failing:
            raise self.failing[name]
        return self.values[name]

    def __setattr__(self, name, value):
        if name in ("done", "failing", "closed", "values", "errors", "adapter"):
            return super().__setattr__(name, value)
        if name in self.failing:
            raise self.failing[name]
        self.done.append((name, value))
        self.values[name] = value
        return None

    def check_errors(self):
        return self.errors

    def shutdown(self):
        self.done.append(("shutdown", None))


@pytest.fixture
def instruments(monkeypatch):
    """The instruments that were opened, one after the other; opening one more fails while `refuses` is set."""

    class Opened(list):
        refuses = False

    opened = Opened()

    def of_reference(_):
        def make(_address, **_options):
            if opened.refuses:
                raise OSError("no such device")
            opened.append(Supply())
            if len(opened) > 1:
                opened[-1].values = opened[-2].values
            return opened[-1]

        return make

    settings = Adapter.Settings(port="none", **TABLE)
    monkeypatch.setattr("drivers.pymeasure.instrument_class", of_reference)
    opened.connect = lambda **changes: Adapter.connect("supply", settings.model_copy(update=changes), VirtualClock())
    return opened


def test_a_set_point_is_scaled_and_its_read_back_too(instruments):
    from drivers.pymeasure import PropertySetpointTable

    table = {**TABLE["setpoint"], "scale": 1e-3, "limits": (0.0, 0.03), "resolution": 1e-4}
    device = instruments.connect(setpoint=PropertySetpointTable(**table))
    device.set(0.0125)
    assert instruments[0].values["voltage_setpoint"] == 12.5
    instruments[0].values["voltage_setpoint"] = 12.75
    with pytest.raises(DeviceError, match=r"reads its set-point back as 0\.01275 V, not 0\.0125 V"):
        device.reconnect()


def test_what_is_not_read_back_is_not_compared(instruments):
    from drivers.pymeasure import PropertySetpointTable

    device = instruments.connect(setpoint=PropertySetpointTable(**{**TABLE["setpoint"], "read_back": False}))
    device.set(5.0)
    instruments[0].values["voltage_setpoint"] = 4.0
    device.reconnect()
    device.measure()
    # An output that is off may have restarted; that cannot be known.
    instruments[-1].values["output_enabled"] = False
    with pytest.raises(DeviceError, match="its output is off although it was switched on") as caught:
        device.measure()
    assert not isinstance(caught.value, DeviceRestartedError)


def test_a_line_that_failed_is_opened_again_by_the_next_call(instruments):
    device = instruments.connect()
    device.set(5.0)
    instruments[0].failing["voltage"] = OSError("timeout")
    with pytest.raises(DeviceConnectionError, match="reading voltage: OSError: timeout"):
        device.measure()
    assert device.measure() == {"supply_voltage": 0.0, "supply_current": 0.25}
    assert len(instruments) == 2
    assert instruments[0].closed == 1
    # On the way it is looked whether the output is as it was left.
    instruments[1].failing["voltage"] = OSError("timeout")
    with pytest.raises(DeviceConnectionError):
        device.measure()
    instruments[1].values["voltage_setpoint"] = 4.0
    with pytest.raises(DeviceError, match="reads its set-point back as 4 V, not 5 V"):
        device.measure()


def test_another_error_is_none_of_the_line(instruments):
    device = instruments.connect()
    instruments[0].failing["voltage_setpoint"] = ValueError("out of range")
    with pytest.raises(DeviceError, match=r"setting voltage_setpoint to 5: ValueError: out of range") as caught:
        device.set(5.0)
    assert not isinstance(caught.value, DeviceConnectionError)
    instruments[0].failing.clear()
    device.set(5.0)
    assert len(instruments) == 1


def test_the_safe_state_is_tried_over_a_fresh_line_and_confirmed(instruments):
    device = instruments.connect()
    device.set(5.0)
    instruments[0].failing["voltage_setpoint"] = OSError("timeout")
    device.safe()
    assert len(instruments) == 2
    assert instruments[1].done == [("voltage_setpoint", 0), ("output_enabled", False)]
    # A line that was lost before is not asked first.
    instruments[1].failing["voltage"] = OSError("timeout")
    with pytest.raises(DeviceConnectionError):
        device.measure()
    instruments[1].done.clear()
    device.safe()
    assert instruments[1].done == []
    assert len(instruments) == 3


def test_a_safe_state_that_is_not_confirmed(instruments):
    device = instruments.connect()
    device.set(5.0)
    instruments[0].failing["voltage_setpoint"] = OSError("timeout")
    instruments.refuses = True
    with pytest.raises(DeviceError, match=r"does not confirm that its output is off \(supply: .*timeout"):
        device.safe()
    # Without a failure before it, that of the line stands there.
    with pytest.raises(DeviceError, match=r"does not confirm .*no such device"):
        device.safe()
    instruments.refuses = False
    device.safe()
    instruments[-1].failing["output_enabled"] = ValueError("locked")
    with pytest.raises(DeviceError, match=r"does not confirm .*output_enabled = False: ValueError: locked"):
        device.safe()


def test_an_output_that_stays_on(instruments):
    device = instruments.connect(safe=("voltage_setpoint = 0",))
    device.set(5.0)
    with pytest.raises(DeviceError, match=r"does not confirm .*output_enabled is true"):
        device.safe()
    device = instruments.connect(safe=("voltage_setpoint = 0",), output=None)
    device.set(5.0)
    device.safe()


def test_an_arrival_is_read_from_the_signals(instruments):
    from drivers.pymeasure import PropertySetpointTable

    arrival = {"signal": "voltage", "tolerance": 0.25, "timeout": 3.0}
    device = instruments.connect(setpoint=PropertySetpointTable(**{**TABLE["setpoint"], "arrival": arrival}))
    status = device.set(5.0)
    instruments[0].values["voltage"] = 4.7
    assert not status.update()
    instruments[0].values["voltage"] = 4.75
    assert status.update()


def test_a_module_that_may_not_be_imported_is_refused():
    from drivers.pymeasure import instrument_class

    with pytest.raises(ValueError, match=r"module wsgiref .* may not be imported"):
        instrument_class("wsgiref:Keithley")
    with pytest.raises(ValueError, match="is no instrument of PyMeasure"):
        instrument_class("pymeasure.instruments:list_resources")
