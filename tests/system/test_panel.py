"""The panel in this process, by Textual's pilot."""

import asyncio
import math
import threading
from functools import partial

import pytest
from cases import cases
from heater_protocols import stairs
from rich.console import Console

from bench.base import ConfigurationError, DataError, Display, Interrupts
from bench.devices import Limits, Signal
from bench.execution import Run, carry_out
from bench.operator import Desk, HoldAll, Leave, Remark, Rest, SetPoint, Shown, Tare, parse_command
from bench.panel import HandsOnRig, RunInProgress, carry_out_by_hand
from bench.panel.margins import margin_of, sparkline
from bench.record import Record
from bench.rig import Interlock

pytest.importorskip("textual")

from bench.panel import Panel

SHOWN = Shown(
    "heater",
    (Signal("tec_setpoint", "°C", "set-point", 2), Signal("tec_temperature", "°C", "plate", 2)),
    {"tec": Limits(10.0, 95.0, "°C")},
    (Interlock(signal="tec_temperature", low=5.0, high=100.0), Interlock(signal="tec_temperature", high=70.0)),
)


async def enter(pilot, line):
    """Type a line, faster than key by key."""
    pilot.app.query_one("#command").value = line
    await pilot.press("enter")


class TestCommands:
    @cases(
        ("line", "command"),
        [
            ("set tec 40", SetPoint("tec", 40.0)),
            ("SET tec 40,5", SetPoint("tec", 40.5)),
            ("ramp tec 60 0.5", SetPoint("tec", 60.0, 0.5)),
            ("hold", HoldAll()),
            ("tare load_cell", Tare("load_cell")),
            ("off", Rest()),
            ("note the lamp  is on", Remark("the lamp is on")),
            ("quit", Leave()),
        ],
    )
    def test_are_understood(self, line, command):
        assert parse_command(line) == command

    @cases(
        ("line", "message"),
        [
            ("set tec", "expected set DEVICE VALUE"),
            ("set tec 40 3", "expected set DEVICE VALUE"),
            ("ramp tec 40 -1", "expected ramp DEVICE VALUE RATE"),
            ("hold tec", "expected hold"),
            ("heat", "expected set DEVICE VALUE; ramp"),
            (" \t", "expected set DEVICE VALUE; ramp"),
            ("set tec nan", "expected set DEVICE VALUE"),
            ("set tec 1_0", "expected set DEVICE VALUE"),
            ("set tec ４０", "expected set DEVICE VALUE"),
            ("ramp tec 40 1e999", "expected ramp DEVICE VALUE RATE"),
        ],
    )
    def test_are_refused_with_what_is_expected(self, line, message):
        with pytest.raises(ConfigurationError, match=message):
            parse_command(line)


class TestMargins:
    @cases(
        ("signal", "value", "distance", "limit", "by", "warned"),
        [
            ("tec_setpoint", 90.0, 5.0, 95.0, "device", False),
            ("tec_setpoint", 12.0, 2.0, 10.0, "device", False),
            ("tec_temperature", 20.0, 15.0, 5.0, "interlock", False),
            ("tec_temperature", 69.0, 1.0, 70.0, "interlock", True),
        ],
    )
    def test_the_nearest(self, signal, value, distance, limit, by, warned):
        margin = margin_of(signal, {signal: value}, SHOWN)
        assert (margin.distance, margin.limit, margin.by, margin.is_warned) == (distance, limit, by, warned)

    def test_none(self):
        assert margin_of("curvature", {"curvature": 1.0}, SHOWN).text(Display.of("1/m", 2)) == ""

    def test_a_course(self):
        assert sparkline([0.0, 7.0, math.nan, 3.0], 10) == "▁█ ▄"
        assert sparkline([1.0, 1.0], 10) == "▄▄"
        assert sparkline([math.nan], 10) == ""


class Hands:
    """A heater under a panel, 20 times as fast as the wall clock."""

    def __init__(self, rig, folder):
        self.desk, self.interrupts = Desk(), Interrupts()
        work = partial(
            carry_out_by_hand, self.desk, rig=rig, overrides={}, seed=1, clock="x20", attach=None, folder=folder,
            interrupts=self.interrupts,
        )  # fmt: skip
        self.source = HandsOnRig("heater", self.desk, work)
        assert self.source.is_connected()
        self.app = Panel(self.source)

    def drive(self, *actions):
        """Type lines one after another, and wait for each until something is so; then leave."""

        async def play():
            async with self.app.run_test(size=(140, 40)) as pilot:
                for line, condition in actions:
                    await enter(pilot, line)
                    for _ in range(600):
                        if condition():
                            break
                        await pilot.pause(0.05)
                    else:
                        raise AssertionError(f"after {line!r}: {[*self.desk.lines]}")
                if self.app.is_running:
                    await pilot.press("ctrl+c")
                    for _ in range(600):
                        if not self.app.is_running:
                            break
                        await pilot.pause(0.05)

        asyncio.run(play())
        self.source.leave()
        self.source.wait()
        assert self.source.error is None
        return self.source.result

    @property
    def now(self):
        return self.desk.ticks[-1][1] if self.desk.ticks else {}

    def near(self, signal, value):
        return lambda: abs(self.now.get(signal, math.nan) - value) < 0.5

    def said(self, text):
        return lambda: any(text in line for line in self.desk.lines)


@pytest.fixture
def hands(tmp_path, rig_file):
    made = []

    def make(*replacements, append=""):
        made.append(Hands(rig_file(*replacements, append=append), tmp_path / "runs"))
        return made[-1]

    yield make
    for each in made:
        each.source.leave()
        each.source.wait()


class TestHands:
    def test_set_ramp_hold_and_leave_are_in_the_record(self, hands):
        h = hands()
        result = h.drive(
            ("set tec 40", h.near("tec_temperature", 40.0)),
            ("ramp tec 44 1", h.near("tec_setpoint", 44.0)),
            ("ramp tec 90 0.01", h.said("ramp of tec from 44 to 90")),
            ("hold", h.said("ramp of tec stopped: hold")),
            ("note by the way", h.said("by the way")),
        )
        assert result.outcome.status == "completed"
        assert result.outcome.is_safe
        with Record(result.folder) as record:
            steps = [(step.label, dict(step.setpoints)) for step in record.step_records()]
            assert steps == [("set", {"tec": 40.0}), ("ramp", {"tec": 44.0}), ("end", {})]
            assert record.meta["protocol"] == "by-hand"
            assert len(record.telemetry()) > 10

    def test_what_is_refused_is_said_and_changes_nothing(self, hands):
        h = hands()
        result = h.drive(
            ("set tec 40", h.near("tec_setpoint", 40.0)),
            ("set tec 400", h.said("refused: tec: set-point 400 °C is outside of")),
            ("set nothing 1", h.said("refused: nothing is not a device that takes a set-point")),
            ("tare tec", h.said("refused: tec is not a load cell; there are: none")),
            ("safe", h.said("outputs off")),
            ("set tec 30", h.near("tec_setpoint", 30.0)),
        )
        with Record(result.folder) as record:
            assert [dict(each.setpoints) for each in record.step_records()] == [{"tec": 40.0}, {"tec": 30.0}, {}]

    def test_an_interlock_ends_it_in_the_safe_state(self, hands):
        h = hands(append='[[interlocks]]\nsignal = "tec_temperature"\nhigh = 60.0\n')
        result = h.drive(("set tec 80", lambda: h.source.view().over))
        assert (result.outcome.status, result.outcome.is_safe) == ("failed", True)
        assert "tec_temperature" in result.outcome.reason
        state = h.source.view().state
        assert "over: failed: interlock: tec_temperature" in state
        assert "all outputs are safe" in state

    def test_the_screen(self, hands):
        h = hands()

        async def play():
            async with h.app.run_test(size=(140, 40)) as pilot:
                while not h.desk.ticks:
                    await pilot.pause(0.05)
                await enter(pilot, "zero tec_temperature")
                h.app.look()
                table = h.app.query_one("#signals")
                rows = [table.get_row_at(i) for i in range(table.row_count)]
                assert [row[0] for row in rows][:2] == ["tec_setpoint", "Δ tec_temperature"]
                assert abs(float(rows[1][1])) < 1.0
                assert rows[1][2] == "°C"
                await pilot.press("ctrl+c")

        asyncio.run(play())


class TestRunInProgress:
    def test_it_is_paused_answered_and_shown_to_its_end(self, tmp_path, rig_file):
        run = Run(
            protocol=stairs, settings={"dwell": 2.5, "count": 40, "increment": 1}, rig=rig_file(),
            folder=tmp_path / "runs", clock="x2", recording=False, rehearse=False,
        )  # fmt: skip
        results = []
        interrupts = Interrupts()
        running = threading.Thread(target=lambda: results.append(carry_out(run, Console(quiet=True), interrupts)))
        running.start()

        async def play():
            while not [*tmp_path.glob("runs/*/operator")]:
                await asyncio.sleep(0.05)
            (folder,) = (tmp_path / "runs").iterdir()
            source = RunInProgress(folder)
            app = Panel(source)
            async with app.run_test(size=(140, 40)) as pilot:

                async def until(text):
                    for _ in range(600):
                        view = source.view()
                        if text in f"{view.title} {view.state} {view.help} {view.lines}":
                            return
                        await pilot.pause(0.05)
                    raise AssertionError((text, source.view()))

                await until("running")
                await enter(pilot, "what")
                await pilot.press("f4")
                await until("PAUSED: paused by the operator")
                assert "set dwell=… now 2.5 s" in source.view().help
                await enter(pilot, "set dwell=0.05")
                await until("dwell = 0.05 (was 2.5)")
                await until("now 0.05 s")
                await enter(pilot, "r")
                await until("completed")
                await pilot.press("ctrl+c")

        try:
            asyncio.run(play())
        finally:
            interrupts.abort_reason = interrupts.abort_reason or "the test"
            running.join(60)
        (result,) = results
        assert result.outcome.status == "completed"
        assert not (result.folder / "operator").exists()

    def test_a_run_that_is_none(self, tmp_path):
        with pytest.raises(DataError, match="is not a run"):
            RunInProgress(tmp_path)
