"""Runs on shared lines: right values only, whatever happens on the lines, and a loss is that of one device."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from benches import IN_TIME, connected as guarded, seconds_until

import bench as face
from bench.base import DeviceConnectionError, DeviceError, DeviceRestartedError, InterlockError
from bench.execution.station.local import LocalStation
from bench.rig import BLIND, Look
from sim_devices.serving.process import serve

SUPPLY = str(Path(__file__).parents[3] / "examples" / "shared-line.toml")
WITHIN = {"force": 0.01, "temperature": 0.06, "position": 0.02, "power": 0.06, "voltage": 0.06, "current": 0.02}


def check(values, laboratory_values):
    """Check that each reading is that of its own instrument: no two have the same value."""
    for name, value in laboratory_values.items():
        assert values[name] == pytest.approx(value, abs=WITHIN[name.rpartition("_")[2]]), name


def look_on(station, *look):
    """Look until something goes wrong."""
    for _ in range(1000):
        station.look(*look)
        station.clock.sleep(0.05)


AT_REST = {
    "load1_force": 10.0,
    "load2_force": -20.0,
    "heater1_temperature": 21.5,
    "heater2_temperature": 31.5,
    "servo1_position": math.pi,
    "servo2_position": math.pi + 0.5,
    "servo3_position": math.pi - 0.5,
    "tec1_temperature": 25.0,
    "tec2_temperature": 35.0,
}


class TestInProcess:
    @pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.seeds)])
    def test_on_disturbed_lines_each_value_is_right_or_an_error(self, connected, seed):
        with connected() as rig:
            rng, good, failed = np.random.default_rng(seed), 0, 0
            # Not of lines whose instruments speak unasked.
            names = [name for name in rig.devices if not name.startswith("supply")]
            # MeCom and Modbus repeat, and Dynamixel; a bit that is wrong costs one repetition.
            for name in names:
                for fault in ("drop", "corrupt", "double"):
                    rig.laboratory.inject(f"{name}.{fault}", {"probability": 0.03, "count": 0}, duration=1e6)
                rig.laboratory.inject(f"{name}.delay", {"probability": 0.02, "seconds": 0.15}, duration=1e6)
            for _ in range(150):
                for name in rng.permutation(names):
                    device = rig.devices[name]
                    try:
                        values = device.glance()
                    except DeviceConnectionError:
                        failed += 1
                        device.reconnect()
                        continue
                    good += 1
                    check(values, {key: value for key, value in AT_REST.items() if key in values})
            assert good > 50 * failed
            assert sum(rig.devices[name].repeats for name in names) > 50
            for name in names:
                rig.laboratory.mend(name)

    def test_one_that_is_away_comes_back_and_the_others_are_as_they_were(self, connected):
        with connected(devices__servo2__watchdog="0") as rig:
            station = LocalStation(rig)
            setpoints = {"servo1": 3.3, "servo2": 3.5, "tec1": 0.1, "tec2": -0.2, "heater1": 5.0, "heater2": 7.0}
            station.apply(setpoints)
            for names in (["load2"], ["servo2"], ["tec1"], ["heater2"]):
                for name in names:
                    rig.laboratory.inject(f"{name}.unplug", duration=1.0)
                values = station.look(Look.GLANCE)
                check(values, {"load1_force": 10.0, "load2_force": -20.0, "tec1_current": 0.1, "tec2_current": -0.2})
                check(values, {"heater1_power": 5.0, "heater2_power": 7.0})
                news = station.news()
                assert [(each.kind, each.text.partition(":")[0]) for each in news] == [("line", *names)]
            rig.laboratory.instruments["tec2"].power_cycle()
            with pytest.raises(DeviceRestartedError, match=r"^tec2: "):
                station.look(Look.GLANCE)
            assert set(station.end().values()) == {"safe"}
            assert [rig.laboratory.output(name) for name in setpoints] == [0.0] * len(setpoints)
            counted = [each.text for each in station.news() if each.kind == "requests"]
            assert [text.partition(": ")[0] for text in counted] == [*rig.devices]

    @pytest.mark.parametrize("silent", ["load1", "tec1", "servo1", "heater1", "supply1"])
    def test_each_is_made_safe_beside_a_neighbour_that_is_silent(self, connected, silent):
        with connected() as rig:
            station = LocalStation(rig)
            setpoints = {"servo1": 3.3, "servo2": 3.5, "servo3": 2.7, "tec1": 0.1, "tec2": 0.2}
            setpoints |= {"heater1": 5.0, "heater2": 7.0, "supply1": 3.0, "supply2": 4.0}
            station.apply(setpoints)
            rig.laboratory.inject(f"{silent}.unplug")
            begin = station.clock.now()
            found = station.end()
            assert station.clock.now() - begin < 5.0
            others = [name for name in setpoints if name != silent]
            assert {found[name] for name in others} == {"safe"}
            assert all(rig.laboratory.output(name) == 0.0 for name in others)
            # It says itself that it could not be reached, if it has an output.
            assert (found[silent] == "safe") == (silent == "load1")
            rig.laboratory.mend(silent)

    def test_a_run_on_lines_of_text_repeats_itself_and_counts_its_requests(self, tmp_path):
        runs = [
            face.run("creep", SUPPLY, clock="virtual", seed=3, out=tmp_path / str(i), hot=8.0, cool=4.0)
            for i in (0, 1)
        ]
        assert [run.status for run in runs] == ["completed"] * 2
        hottest = [max(run.readings["plate_temperature"]) for run in runs]
        assert hottest[0] == hottest[1] == pytest.approx(22.0 + 4.0 * 6.4, abs=0.8)
        assert np.allclose(runs[0].readings["room_temperature"], 22.0, atol=0.2)


@pytest.fixture(scope="class")
def served():
    """The laboratory, in another process; bytes take the time of their line."""
    with serve(str(Path(__file__).parent / "buses.toml"), clock="x1", baud_time=True) as rig:
        yield rig


@pytest.mark.usefixtures("warm_popen")
@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")
class TestServed:
    @pytest.fixture
    def station(self, served, buses):
        # A TEC that lost its host keeps an error until it is reset.
        for name in ("tec1", "tec2"):
            served.control.fault(f"{name}.power-cycle")
        keys = {f"devices__servo{number}__watchdog": "0" for number in (1, 2, 3)}
        with guarded(served, buses, safety__reconnect="60", **keys) as station:
            station.promise(60.0, "a test")
            yield station
            for name in ("load1", "load2", "servo3", "tec2"):
                served.control.plug_in(name)

    def test_each_line_is_one_terminal(self, served):
        lines = {name: each.port for name, each in served.instruments.items()}
        assert [*lines] == [
            "load1+load2", "servo1+servo2+servo3", "tec1+tec2", "heater1+heater2", "supply1+supply2"
        ]  # fmt: skip
        assert len(set(lines.values())) == len(lines)
        assert served.instruments["tec1+tec2"].devices == ("tec1", "tec2")

    def test_one_away_and_one_restarted(self, served, station):
        station.apply({"servo1": 3.3, "servo2": 3.5, "servo3": 2.7, "tec1": 0.2, "tec2": -0.3})
        while station.arrivals().waiting:
            station.clock.sleep(0.1)
        wanted = {"servo1_position": 3.3, "servo2_position": 3.5, "servo3_position": 2.7, "load2_force": -20.0}
        wanted |= {"tec1_current": 0.2, "tec2_current": -0.3}
        check(station.look(Look.GLANCE), wanted)
        served.control.fault("servo3.unplug")
        seen = "servo1_position", "servo2_position", "tec1_current"
        check(station.look(Look.PART, seen), {key: wanted[key] for key in seen})
        # Longer than an interlock may be blind: the guardian sees its neighbours all the time.
        station.clock.sleep(3.0 * BLIND)
        check(station.look(Look.PART, seen), {key: wanted[key] for key in seen})
        served.control.plug_in("servo3")
        check(station.look(Look.GLANCE), wanted)
        texts = [each.text for each in station.news() if each.kind == "line"]
        assert [text.partition(":")[0] for text in texts] == ["servo3"]
        served.control.fault("tec2.power-cycle")
        with pytest.raises(DeviceRestartedError, match=r"^tec2: "):
            look_on(station, Look.GLANCE)
        assert set(station.end().values()) == {"safe"}
        state = served.control.state()
        assert all(value == 0.0 for name, value in state.items() if name.startswith(("tec", "servo")))
        counted = [each.text for each in station.news() if each.kind == "requests"]
        assert all("late at most" in text for text in counted)
        assert len(counted) == 11

    def test_an_interlock_acts_in_time_beside_a_neighbour_that_is_silent(self, served, station):
        station.apply({"tec1": 0.2, "tec2": -0.3})
        served.control.fault("load1.unplug")
        # The guardian has found that it is silent.
        station.clock.sleep(0.5)
        served.control.operate("load2", 45.0)
        try:
            took = seconds_until(lambda: served.control.state()["tec1_output"] == 0.0)
            assert took < BLIND + IN_TIME
            with pytest.raises(InterlockError, match="load2_force"):
                look_on(station, Look.PART, ["tec1_current"])
            assert {name: state for name, state in station.end().items() if state != "safe"} == {}
        finally:
            served.control.operate("load2", -20.0)

    def test_a_device_that_stays_away_ends_the_run_by_its_name(self, served, station):
        station.apply({"tec1": 0.2, "tec2": -0.3})
        served.control.fault("load2.unplug")
        with pytest.raises(DeviceError, match=r"^load2: "):
            look_on(station, Look.PART, ["load1_force"])
        assert set(station.end().values()) == {"safe"}
        assert served.control.state()["tec1_output"] == 0.0
