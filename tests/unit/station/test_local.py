"""A station whose devices are in this process, on the virtual clock."""

import pytest

from bench.base import (
    AbortError,
    ConfigurationError,
    DeviceConnectionError,
    DeviceError,
    DeviceRestartedError,
    GuardianError,
    InterlockError,
    LimitError,
    VirtualClock,
)
from bench.execution.station.local import LocalStation
from bench.rig import Look, Rig, lines_of, load_rig, longest_away


class Later(VirtualClock):
    """A virtual clock on which things happen at their instants."""

    def __init__(self):
        super().__init__()
        self.events = []

    def sleep(self, seconds):
        super().sleep(seconds)
        self._happen()

    def sleep_until(self, instant):
        super().sleep_until(instant)
        self._happen()

    def _happen(self):
        due = [each for each in self.events if each[0] <= self.now()]
        self.events = [each for each in self.events if each not in due]
        for _, event in due:
            event()

    def after(self, seconds, event):
        self.events.append((self.now() + seconds, event))


@pytest.fixture
def vo2():
    """A station on the VO2 rig and its emulated TEC; what its rig file says may be changed."""
    rigs = []

    def make(**overrides):
        values = {key.replace("__", "."): value for key, value in overrides.items()}
        rigs.append(Rig(load_rig("vo2", values), Later(), 0))
        return LocalStation(rigs[-1]), rigs[-1].laboratory.tec, rigs[-1]

    yield make
    for rig in rigs:
        rig.close()


def output(rig):
    return bool(rig.laboratory.truth()["tec_output"].value)


class TestReconnection:
    def test_a_line_that_comes_back_is_only_news(self, vo2):
        station, tec, _ = vo2()
        station.apply({"tec": 40.0})
        tec.unplug()
        station.clock.after(2.0, tec.plug_in)
        values = station.look(Look.MEASURE)
        assert 20.0 < values["tec_temperature"] < 45.0
        assert station.setpoint("tec") == 40.0
        (news,) = station.news()
        assert (news.level, news.kind) == ("WARN", "line")
        assert "tec: line lost for " in news.text
        assert station.news() == []

    def test_a_setpoint_of_a_fast_loop_waits_for_its_line(self, vo2):
        station, tec, _ = vo2()
        move = station.mover(["tec"])
        move([40.0])
        tec.unplug()
        station.clock.after(2.0, tec.plug_in)
        move([41.0])
        assert station.setpoint("tec") == 41.0
        assert [news.kind for news in station.news()] == ["line"]

    def test_a_line_that_is_lost_at_every_reading_has_the_devices_read_three_times(self, vo2, monkeypatch):
        station, tec, rig = vo2()
        psd, read = rig.devices["psd"], []
        measure = psd.measure

        def lose_the_other_line():
            read.append(measure())
            tec.unplug()
            station.clock.after(1.0, tec.plug_in)
            return read[-1]

        monkeypatch.setattr(psd, "measure", lose_the_other_line)
        tec.unplug()
        station.clock.after(1.0, tec.plug_in)
        values = station.look(Look.MEASURE)
        assert len(read) == 3
        assert values["psd_position"] == read[-1]["psd_position"]

    def test_a_line_that_stays_away_ends_the_run_in_time(self, vo2):
        station, tec, _ = vo2(safety__reconnect="2.0")
        tec.unplug()
        since = station.clock.now()
        with pytest.raises(DeviceConnectionError, match="tec: no answer"):
            station.look(Look.GLANCE)
        # The last attempt takes its time as well.
        assert 2.0 <= station.clock.now() - since <= 3.0

    def test_an_instrument_with_a_watchdog_may_be_away_for_less_than_its_time(self, vo2):
        station, tec, rig = vo2(safety__reconnect="60")
        tec.unplug()
        since = station.clock.now()
        with pytest.raises(DeviceConnectionError, match="it was not back within 3 s"):
            station.look(Look.GLANCE)
        assert station.clock.now() - since < rig.devices["tec"].watchdog

    def test_the_watchdog_of_an_actuator_counts_for_a_sensor_on_its_line(self):
        rig = Rig(load_rig("hybrid", {"safety.reconnect": "60"}), VirtualClock(), 0)
        try:
            watchdog = rig.devices["piezo"].watchdog
            lines = lines_of(rig.file)
            assert lines["displacement"] == lines["piezo"] != lines["tec"]
            assert rig.devices["displacement"].watchdog is None
            longest = longest_away(rig.file, rig.devices)
            for name in ("displacement", "piezo"):
                assert longest[name].seconds == 0.6 * watchdog
                assert "watchdog of piezo" in longest[name].reason
        finally:
            rig.close()

    def test_an_error_of_another_device_ends_the_run_while_a_line_is_away(self, vo2):
        station, _, rig = vo2()
        station.apply({"tec": 30.0})
        rig.laboratory.inject("psd.unplug")
        station.clock.after(0.5, lambda: rig.laboratory.inject("tec-over-temperature"))
        since = station.clock.now()
        with pytest.raises(DeviceError, match=r"^tec: "):
            station.look(Look.GLANCE)
        # Not after the ten seconds of `reconnect`.
        assert station.clock.now() - since < 5.0

    def test_an_operator_who_ends_the_run_does_not_wait_for_the_line(self, vo2):
        station, tec, _ = vo2()
        tec.unplug()
        station.clock.interrupted = lambda: True
        since = station.clock.now()
        with pytest.raises(DeviceConnectionError):
            station.look(Look.GLANCE)
        assert station.clock.now() - since < 2.0

    def test_an_instrument_that_restarted_meanwhile_ends_the_run(self, vo2):
        station, tec, rig = vo2()
        station.apply({"tec": 40.0})
        tec.unplug()
        station.clock.after(1.0, tec.power_cycle)
        station.clock.after(1.5, tec.plug_in)
        with pytest.raises(DeviceRestartedError):
            station.look(Look.GLANCE)
        assert not output(rig)
        assert station.end()["tec"] == "safe"
        assert not output(rig)

    def test_an_arrival_is_awaited_on(self, vo2):
        station, tec, _ = vo2()
        station.apply({"tec": 40.0})
        tec.unplug()
        station.clock.after(2.0, tec.plug_in)
        arrivals = station.arrivals()
        assert arrivals.error is None
        assert arrivals.waiting == ("tec",)
        station.clock.sleep(60.0)
        assert station.arrivals().waiting == ()

    def test_a_device_whose_driver_cannot_open_its_line_ends_the_run(self, heater):
        station, rig = heater()
        rig.devices["probe"].glance_error = DeviceConnectionError("probe", "does not answer")
        since = station.clock.now()
        with pytest.raises(DeviceConnectionError, match="does not answer"):
            station.look(Look.GLANCE)
        assert station.clock.now() == since

    def test_requests_that_were_repeated_are_counted_at_the_end(self, vo2):
        station, _, rig = vo2()
        rig.laboratory.inject("tec.drop")
        station.look(Look.GLANCE)
        assert rig.devices["tec"].repeats == 1
        assert station.news() == []
        station.end()
        (news,) = station.news()
        assert news.text.startswith("tec: 1 request")


class TestInterlocks:
    def test_they_are_looked_at_between_two_ticks(self, heater):
        station, _ = heater(interlock_rate=5.0)
        station.apply({"tec": 95.0})
        # 22 °C to 95 °C with 1 s: 90 °C is crossed after 2.68 s.
        with pytest.raises(InterlockError, match="probe_temperature = 90"):
            station.sleep_until(600.0)
        assert 2.68 <= station.clock.now() <= 2.68 + 0.2 + 0.01

    def test_without_a_rate_they_are_looked_at_with_readings(self, heater):
        station, _ = heater()
        station.apply({"tec": 95.0})
        station.sleep_until(600.0)
        assert station.clock.now() == 600.0
        values = station.look(Look.GLANCE)
        with pytest.raises(InterlockError):
            station.judge(station.clock.now(), values)

    def test_the_instant_of_an_interlock_is_waited_for_without_a_rate(self, heater):
        station, _ = heater('[[interlocks]]\nsignal = "tec_temperature"\nhigh = 60.0\nseconds = 3.0\n')
        station.apply({"tec": 80.0})
        station.sleep_until(10.0)
        station.judge(10.0, station.look(Look.GLANCE))
        with pytest.raises(InterlockError, match="tec_temperature"):
            station.sleep_until(600.0)
        assert station.clock.now() == pytest.approx(13.0, abs=0.01)

    def test_looks_go_on_in_step(self, heater):
        station, _ = heater(interlock_rate=5.0)
        seen = []
        look = station.look

        def counted(*arguments):
            seen.append(station.clock.now())
            return look(*arguments)

        station.look = counted
        station.sleep_until(10.05)
        assert seen == pytest.approx([0.2 * (k + 1) for k in range(50)])
        assert station.clock.now() == 10.05

    def test_a_hold_lasts_until_the_signal_is_back(self, heater):
        held = '[[interlocks]]\nsignal = "tec_temperature"\nhigh = 60.0\nresume_high = 50.0\nlevel = "hold"\n'
        station, _ = heater(held, interlock_rate=5.0)
        station.apply({"tec": 80.0})
        station.sleep_until(5.0)
        assert station.is_holding
        station.apply({"tec": 30.0})
        station.sleep_until(20.0)
        assert not station.is_holding
        expected = [("WARN", "warning"), ("WARN", "interlock"), ("INFO", "warning"), ("INFO", "interlock")]
        assert [(each.level, each.kind) for each in station.news()] == expected

    def test_a_pause_is_asked_for_once(self, heater):
        station, _ = heater('[[interlocks]]\nsignal = "tec_temperature"\nhigh = 60.0\nlevel = "pause"\n')
        station.judge(1.0, {"tec_temperature": 61.0})
        assert "tec_temperature = 61" in station.take_pause()
        assert station.take_pause() == ""
        station.judge(2.0, {"tec_temperature": 62.0})
        assert station.take_pause() == ""


class TestAfterTheEnd:
    @pytest.fixture
    def tripped(self, heater):
        station, rig = heater()
        station.apply({"tec": 40.0})
        with pytest.raises(InterlockError):
            station.judge(1.0, {"probe_temperature": 91.0})
        return station, rig

    def test_what_tripped_it_is_raised_again_and_nothing_is_sent(self, tripped):
        station, rig = tripped
        move = station.mover(["tec"])
        station.end()
        for late in (lambda: station.apply({"tec": 41.0}), lambda: move([41.0])):
            with pytest.raises(InterlockError, match="probe_temperature = 91"):
                late()
        assert rig.devices["tec"].sent == [40.0]
        assert not rig.devices["tec"].output_enabled

    def test_nothing_is_sent_after_an_end_that_was_asked_for(self, heater):
        station, rig = heater()
        station.apply({"tec": 40.0})
        station.end()
        with pytest.raises(GuardianError, match="ended already"):
            station.apply({"tec": 41.0})
        assert not rig.devices["tec"].output_enabled

    def test_the_safe_state_is_reached_once(self, heater):
        station, rig = heater()
        assert station.end() == {"tec": "safe", "probe": "safe"}
        assert station.end() == {"tec": "safe", "probe": "safe"}
        assert {name: device.safe_times for name, device in rig.devices.items()} == {"tec": 1, "probe": 1}

    def test_one_that_fails_keeps_no_other(self, heater):
        station, rig = heater()
        rig.devices["tec"].safe_error = DeviceError("tec", "stays on")
        assert station.end() == {"tec": "DeviceError: tec: stays on", "probe": "safe"}

    def test_the_order_of_the_rig_file_holds(self, heater):
        station, _ = heater('[safety]\norder = ["probe"]\n')
        assert list(station.end()) == ["probe", "tec"]


class TestRequests:
    def test_all_setpoints_are_checked_before_any_is_sent(self, heater):
        station, rig = heater()
        with pytest.raises(LimitError):
            station.apply({"tec": 400.0})
        with pytest.raises(LimitError):
            station.mover(["tec"])([400.0])
        with pytest.raises(LimitError):
            station.check({"tec": [40.0, 400.0]})
        assert rig.devices["tec"].sent == []

    def test_a_setpoint_that_stands_is_not_sent_again(self, heater):
        station, rig = heater()
        move = station.mover(["tec"])
        for value in (40.0, 40.0, 41.0):
            move([value])
        assert rig.devices["tec"].sent == [40.0, 41.0]

    def test_a_device_that_takes_no_setpoint_is_named(self, heater):
        station, _ = heater()
        with pytest.raises(ConfigurationError, match="probe is not a device that takes a set-point; there are: tec"):
            station.apply({"probe": 1.0})

    def test_a_failed_arrival_is_told(self, heater):
        station, rig = heater()
        station.apply({"tec": 40.0})
        rig.devices["tec"].plate.now = lambda: (_ for _ in ()).throw(AbortError("ended"))
        assert isinstance(station.arrivals().error, AbortError)
