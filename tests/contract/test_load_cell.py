"""What every load cell promises, run against the emulated device and the driver on its wire."""

from dataclasses import dataclass

import numpy as np
import pytest
from cases import cases
from emulated_bench import Bench, Given, OnABench, over_the_wire, serial_port

from bench.base import DeviceError, VirtualClock
from bench.contracts import LineLostContract, LoadCellContract, RestartedInstrumentContract
from drivers.flintec_dad141 import FlintecDAD141
from sim_devices.instruments.flintec_dad141 import START_TIME, EmulatedDAD141, reading_interval
from sim_devices.protocol_emulated import register, unregister
from sim_devices.wire.modbus_rtu import ModbusRtuServer
from sim_devices.world import World


@dataclass(kw_only=True)
class CellBench(Bench):
    """A load cell and the specimen whose force the test sets."""

    port: str = ""

    def put(self, force):
        """Load the cell and let its filter settle."""
        self.plant.value = force
        self.clock.sleep(2.0)


def connected(kind, stack, seed=1, settings=None, **options):
    specimen, clock = Given(), VirtualClock()
    instrument = EmulatedDAD141(
        "load",
        World(specimen, clock),
        lambda: specimen.value,
        rng=np.random.default_rng(seed),
        zero_tracking=0,
        **options,
    )
    cell, port = instrument, ""
    if kind == "driver":
        port, _ = serial_port(stack, ModbusRtuServer(instrument), clock)
        calibration = {key: options[key] for key in ("newtons_per_unit", "zero_newtons") if key in options}
        given = FlintecDAD141.Settings(port=port, force_limits=(-70.0, 70.0), **calibration, **(settings or {}))
        cell = FlintecDAD141.connect("load", given, clock)
    stack.callback(cell.close)
    return CellBench(clock=clock, device=cell, instrument=instrument, plant=specimen, port=port)


class TestContract(OnABench, LoadCellContract):
    @pytest.fixture
    def device(self, bench):
        bench.put(10.0)
        return bench.device

    @pytest.fixture
    def identity(self):
        return "Flintec DAD 141.1, serial number 1410237, firmware 1.10"

    @pytest.fixture
    def resolution(self):
        return 2e-3


@over_the_wire
class TestAfterARestart(OnABench, RestartedInstrumentContract):
    @pytest.fixture(params=["untared", "tared"])
    def device(self, stack, kind, request):
        self.bench = connected(kind, stack, settings={"filter": 6})
        self.bench.put(10.0)
        if request.param == "tared":
            self.bench.device.tare()
        return self.bench.device

    @pytest.fixture(params=[START_TIME, 1.0])
    def restart(self, request):
        def power_cycle():
            self.bench.instrument.power_cycle()
            self.bench.clock.sleep(request.param)

        return power_cycle


@over_the_wire
class TestLineLost(OnABench, LineLostContract):
    @pytest.fixture
    def bench(self, stack, kind):
        bench = connected(kind, stack, settings={"filter": 6})
        bench.put(10.0)
        return bench

    @pytest.fixture(params=["unplugged", "silent"])
    def cut(self, bench, request):
        if request.param == "silent":
            return bench.instrument.unplug
        return lambda: unregister(bench.port)

    @pytest.fixture
    def mend(self, bench):
        def mend():
            bench.instrument.plug_in()
            unregister(bench.port)
            register(bench.port.removeprefix("emulated://"), ModbusRtuServer(bench.instrument), bench.clock)

        return mend

    @pytest.fixture
    def restart(self, bench):
        def power_cycle():
            bench.instrument.power_cycle()
            bench.clock.sleep(START_TIME)

        return power_cycle

    @pytest.fixture
    def exchange(self, bench):
        def exchange():
            bench.instrument.serial_number += 1

        return exchange

    @pytest.fixture
    def truth(self, bench):
        return lambda: {"load_force": bench.plant.value}

    @pytest.fixture
    def tolerance(self):
        return 2e-3


def force(reading: dict[str, float]) -> float:
    return reading["load_force"]


@cases("newtons", [-59.9, -0.5, 0.0, 12.345, 59.9])
def test_measures_the_force(bench, newtons):
    bench.put(newtons)
    assert force(bench.device.measure()) == pytest.approx(newtons, abs=1.5e-3)
    assert force(bench.device.glance()) == pytest.approx(newtons, abs=2e-3)


@cases(("newtons_per_unit", "zero_newtons"), [(9.80665, 0.0), (-2.0, 3.0), (0.5, -10.0)])
def test_calibration(kind, newtons_per_unit, zero_newtons, stack):
    calibration = {"newtons_per_unit": newtons_per_unit, "zero_newtons": zero_newtons}
    bench = connected(kind, stack, **calibration, noise=5e-5, decimals=4)
    bench.put(7.5)
    assert force(bench.device.measure()) == pytest.approx(7.5, abs=2e-3)
    bench.device.tare()
    bench.put(9.0)
    assert force(bench.device.measure()) == pytest.approx(1.5, abs=3e-3)


def test_tare_waits_until_the_signal_is_still(bench):
    bench.device.measure()
    bench.plant.value = 10.0
    bench.clock.sleep(0.05)
    bench.device.tare()  # the filter has not settled yet: without waiting, a part of the 10 N would remain
    assert force(bench.device.measure()) == pytest.approx(0.0, abs=2e-3)


def test_tare_of_a_moving_load_is_refused(bench):
    bench.plant.rate = 0.5
    begin = bench.clock.now()
    with pytest.raises(DeviceError, match=r"^load: .*still"):
        bench.device.tare()
    assert bench.clock.now() - begin == pytest.approx(10.0, abs=0.3)
    bench.plant.rate = 0.0
    bench.put(8.0)
    assert force(bench.device.measure()) == pytest.approx(8.0, abs=1.5e-3)


@cases(("newtons", "side"), [(60.1, "over"), (-60.1, "under"), (1e9, "over"), (-1e9, "under")])
def test_out_of_range_is_an_error_and_not_a_number(bench, newtons, side):
    bench.put(newtons)
    for take in (bench.device.measure, bench.device.glance, bench.device.read):
        with pytest.raises(DeviceError, match=f"^load: .*{side} its range"):
            take()


def test_range_is_that_of_the_gross_force(bench):
    bench.put(40.0)
    bench.device.tare()
    bench.put(61.0)
    with pytest.raises(DeviceError, match="over its range"):
        bench.device.measure()


def test_a_measurement_spaces_its_readings_by_the_filter(bench):
    begin = bench.clock.now()
    bench.device.measure()
    assert bench.clock.now() - begin == pytest.approx(4 * reading_interval(3), abs=0.01)
    begin = bench.clock.now()
    bench.device.glance()
    assert bench.clock.now() - begin < 0.01


def test_a_measurement_is_the_mean_over_its_time(bench):
    bench.put(0.0)
    bench.device.glance()
    bench.plant.rate = 1.0
    bench.clock.sleep(2.0)
    # Readings over 0.5 s, 0.25 s on the mean; both lags hold them back by 25.6 ms each.
    assert force(bench.device.measure()) == pytest.approx(2.0 + 0.25 - 2 * 0.0256, abs=8e-3)
