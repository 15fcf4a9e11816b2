"""A bluesky RunEngine drives the bench's devices as it stands: over the wire, on the virtual clock."""

from contextlib import closing

import pytest

from bench.api import open_rig
from bench.base import DeviceError, LimitError, VirtualClock
from bench.base.clock import VIRTUAL_EPOCH
from bench.rig import Rig, load_rig

bluesky = pytest.importorskip("bluesky")
plans = pytest.importorskip("bluesky.plans")
plan_stubs = pytest.importorskip("bluesky.plan_stubs")


@pytest.fixture
def engine():
    # No context managers: the handlers of signals are not the tests' to replace.
    return bluesky.RunEngine({}, context_managers=[])


@pytest.fixture
def rig():
    with closing(Rig(load_rig("vo2", {"emulation.disturbances": "false"}), VirtualClock(), seed=1)) as rig:
        yield rig


def run(engine, plan):
    documents = {}
    engine(plan, lambda name, document: documents.setdefault(name, []).append(document))
    return documents


def test_a_scan_gives_documents_with_units_values_and_times_of_the_laboratory(engine, rig):
    documents = run(engine, plans.scan([rig.devices["psd"]], rig.devices["tec"], 40.0, 60.0, 5))
    counts = {name: len(entries) for name, entries in documents.items()}
    assert counts == {"start": 1, "descriptor": 1, "event": 5, "stop": 1}
    assert documents["stop"][0]["exit_status"] == "success"
    assert documents["start"][0]["motors"] == ("tec",)
    keys = documents["descriptor"][0]["data_keys"]
    units = {"temperature": "°C", "sink_temperature": "°C", "current": "A", "voltage": "V"}
    assert {name: key["units"] for name, key in keys.items()} == {
        "psd_position": "m", **{f"tec_{name}": unit for name, unit in units.items()}
    }  # fmt: skip
    assert all(key["dtype"] == "number" and key["shape"] == [] for key in keys.values())
    data = [event["data"] for event in documents["event"]]
    temperatures = [entry["tec_temperature"] for entry in data]
    assert temperatures == pytest.approx([40.0, 45.0, 50.0, 55.0, 60.0], abs=0.1)
    # Below the transition the film expands, above 55 °C it begins to bend the other way.
    positions = [entry["psd_position"] for entry in data]
    assert positions[:4] == sorted(positions[:4], reverse=True)
    assert positions[4] > positions[3]
    assert all(-6e-6 < position < 100e-6 for position in positions)
    assert data[-1]["tec_current"] > data[0]["tec_current"] > 0
    stamps = [event["timestamps"]["tec_temperature"] for event in documents["event"]]
    assert stamps == sorted(stamps)
    assert VIRTUAL_EPOCH.timestamp() < stamps[0] < stamps[-1] <= VIRTUAL_EPOCH.timestamp() + rig.clock.now()
    assert rig.clock.now() < 200.0


class TestFailures:
    def test_a_setpoint_outside_of_the_limits_ends_the_plan(self, engine, rig):
        with pytest.raises(LimitError, match=r"tec: set-point 99 °C is outside of 15 to 95 °C"):
            engine(plan_stubs.mv(rig.devices["tec"], 99.0))
        assert not rig.devices["tec"].output_enabled

    def test_a_fault_on_the_way_ends_the_plan(self, engine, rig):
        rig.laboratory.tec.unplug()
        with pytest.raises(DeviceError, match="tec"):
            engine(plan_stubs.mv(rig.devices["tec"], 50.0))


class TestReadables:
    def test_set_points_and_derived_signals_are_read_as_devices_are(self, engine, rig):
        readables = rig.readables
        assert {"psd", "tec", "tec_setpoint", "curvature"} <= readables.keys()
        documents = run(
            engine, plans.scan([readables["curvature"], readables["tec_setpoint"]], rig.devices["tec"], 40.0, 60.0, 3)
        )
        keys = documents["descriptor"][0]["data_keys"]
        assert (keys["curvature"]["units"], keys["tec_setpoint"]["units"]) == ("1/m", "°C")
        data = [event["data"] for event in documents["event"]]
        assert [entry["tec_setpoint"] for entry in data] == [40.0, 50.0, 60.0]
        measured = rig.measure()["curvature"]
        assert data[-1]["curvature"] == pytest.approx(measured, abs=10.0)
        assert data[0]["curvature"] != data[-1]["curvature"]

    def test_an_adaptive_scan_triggers_them(self, engine, rig):
        readables = [rig.readables["curvature"], rig.devices["psd"]]
        scan = plans.adaptive_scan(readables, "curvature", rig.devices["tec"], 40.0, 44.0, 0.5, 2.0, 20.0, True)
        assert len(run(engine, scan)["event"]) >= 3

    def test_documents_and_readings_have_one_time_base(self, engine):
        with open_rig("vo2") as rig:
            documents = run(engine, plans.count([rig.readables["curvature"]], 2))
        stamps = [event["timestamps"]["curvature"] for event in documents["event"]]
        # The laboratory's clock has run ahead of the one on the wall by what it jumped over; not by 26 years.
        assert all(abs(stamp - documents["start"][0]["time"]) < 3600.0 for stamp in stamps)
        assert stamps == sorted(stamps)


class TestSafely:
    @pytest.fixture
    def heated(self, rig):
        def plan():
            yield from plan_stubs.mv(rig.devices["tec"], 50.0)
            assert rig.devices["tec"].output_enabled
            yield from plan_stubs.null()

        return plan

    def test_a_plan_that_ends(self, engine, rig, heated):
        engine(rig.safely(heated()))
        assert not rig.devices["tec"].output_enabled

    def test_a_plan_that_fails(self, engine, rig, heated):
        def failing():
            yield from heated()
            raise ValueError("of the plan")

        with pytest.raises(ValueError, match="of the plan"):
            engine(rig.safely(failing()))
        assert not rig.devices["tec"].output_enabled

    @pytest.mark.parametrize("end", ["abort", "stop", "halt"])
    def test_a_plan_that_is_left_at_a_pause(self, engine, rig, heated, end):
        def pausing():
            yield from heated()
            yield from plan_stubs.pause()

        with pytest.raises(Exception, match=r"(?i)paus|interrupt"):
            engine(rig.safely(pausing()))
        assert rig.devices["tec"].output_enabled
        getattr(engine, end)()
        assert not rig.devices["tec"].output_enabled

    def test_a_device_that_does_not_confirm_it_is_named(self, engine, rig, heated):
        def unplugged():
            yield from heated()
            rig.laboratory.tec.unplug()

        with pytest.raises(DeviceError, match="NOT in its safe state"):
            engine(rig.safely(unplugged()))
