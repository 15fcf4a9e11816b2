import io
import signal
import threading

import pytest
from cases import cases
from heater_laboratory import CLOSED, HeaterLaboratory, HeaterTEC
from heater_protocols import Stairs, settle, stairs

from bench.base import ConfigurationError, DeviceConnectionError, Expectation, PlainConsole
from bench.devices import Signal
from bench.execution import Run, carry_out
from bench.execution.dialogue import Dialogue
from bench.execution.terminal import ProgressDisplay
from bench.operator import AT_A_PROMPT, Question
from bench.protocol import Dwell, Settled, Step, protocol
from bench.record import RIG_FILE_NAME, Event, Record, StepRecord, run_card
from bench.rig import load_rig


@pytest.fixture
def console():
    return PlainConsole(file=io.StringIO(), width=200)


@pytest.fixture
def make(tmp_path, rig_file):
    def run(*replacements, protocol=stairs, settings=None, **keys):
        return Run(
            **{
                "protocol": protocol,
                "settings": settings or {},
                "rig": rig_file(*replacements),
                "folder": tmp_path / "runs" / "deep",
                "clock": "virtual",
                "recording": False,
                **keys,
            }
        )

    CLOSED.clear()
    yield run
    assert HeaterLaboratory.opened == 0


class TestCarryOut:
    def test_refuses_faults_where_the_laboratory_has_none(self, make, console, tmp_path):
        (tmp_path / "faults.toml").write_text("[[fault]]\nat = 1\nfault = 'x'\n")
        with pytest.raises(ConfigurationError, match=r"faults\.toml: the rig has no emulated laboratory with faults"):
            carry_out(make(faults=tmp_path / "faults.toml"), console)
        assert not (tmp_path / "runs").exists()

    def test_leaves_a_folder_with_everything(self, make, console):
        run = make(overrides={"telemetry.period": "1"}, seed=7)
        result = carry_out(run, console)
        assert result.outcome.status == "completed"
        assert result.outcome.is_safe
        assert result.folder.parent == run.folder
        assert result.folder.name.startswith("heater-stairs-")
        assert sorted(path.name for path in result.folder.iterdir()) == ["journal.sqlite", RIG_FILE_NAME]
        assert result.time_ratio == 8.0 / result.wall_seconds
        assert CLOSED == ["probe", "tec"]
        with Record(result.folder) as record:
            meta = record.meta
            assert meta["run"] == result.folder.name
            assert (
                meta["rig_file"]
                == load_rig(run.rig).text
                == (result.folder / RIG_FILE_NAME).read_text(encoding="utf-8")
            )
            assert meta["overrides"] == {"telemetry.period": "1"}
            assert meta["seed"] == 7
            assert meta["epoch"] == "2000-01-01T00:00:00+00:00"
            assert meta["parameters"] == stairs.parameters().model_dump()
            assert meta["plan"]["steps"] == len(record.steps()) == 4
            assert meta["plan"]["seconds"] == meta["finished"] == 8.0
            assert set(meta["devices"]) == {"tec", "probe"}
            assert meta["calibration"]["tec"]["temperature_limits"] == [10.0, 95.0]
            assert meta["packages"]["numpy"]
            card = run_card(meta)
            assert "# a heated plate" in card
            assert "| seed | 7 |" in card
            assert "Test Heater, serial number 1" in card

    def test_two_runs_within_one_second_have_two_folders(self, make, console):
        folders = {carry_out(make(), console).folder for _ in range(3)}
        assert len(folders) == 3

    @cases(
        ("keys", "expected"),
        [
            ({"settings": {"count": 100}}, "rig heater allows 10 to 95 °C"),
            ({"clock": "moon"}, "clock 'moon' is unknown"),
            ({"overrides": {"devices.tec.port": "/dev/ttyUSB9"}}, "has real devices, which know only the wall clock"),
            ({"protocol": settle, "settings": {"signal": "absent"}}, "absent"),
        ],
    )
    def test_what_is_wrong_is_found_before_anything_is_made(self, make, console, keys, expected):
        run = make(**keys)
        with pytest.raises(ConfigurationError, match=expected):
            carry_out(run, console)
        assert not run.folder.exists()

    def test_a_folder_that_cannot_be_made(self, make, console, tmp_path):
        (tmp_path / "file").write_text("")
        with pytest.raises(ConfigurationError, match="folder of the run cannot be made"):
            carry_out(make(folder=tmp_path / "file" / "runs"), console)
        assert CLOSED == ["probe", "tec"]

    def test_a_device_that_does_not_answer(self, make, console):
        run = make(
            ('port = "emulated://thermometer"', 'port = "emulated://thermometer"\nconnect_error = "no answer"')
        )
        with pytest.raises(DeviceConnectionError, match="probe: no answer"):
            carry_out(run, console)
        assert not run.folder.exists()

    def test_the_outcome_is_told_although_the_line_is_gone(self, make, console, monkeypatch):
        def gone(self):
            raise OSError(5, "Input/output error")

        monkeypatch.setattr(HeaterTEC, "close", gone)
        monkeypatch.setattr(HeaterTEC, "safe", gone)
        result = carry_out(make(), console)
        assert not result.outcome.is_safe
        assert result.outcome.safe_state == {"tec": "OSError: [Errno 5] Input/output error", "probe": "safe"}

    def test_ctrl_c_waits_for_no_console(self, make, console, capfd):
        # Whatever was interrupted may hold the console's locks, or wait for another that holds them.
        held, release, released = threading.Event(), threading.Event(), threading.Event()

        def hold():
            with console._lock:
                held.set()
                release.wait(60.0)
                released.set()

        def press(parameters):
            for event in (held, release, released):
                event.clear()
            holder = threading.Thread(target=hold)
            holder.start()
            held.wait(60.0)
            signal.raise_signal(signal.SIGINT)
            seen.append(released.is_set())
            release.set()
            holder.join()
            yield Step({"tec": 30.0}, Dwell(1.0))

        seen = []
        press.__annotations__ = {"parameters": Stairs}
        press.__doc__ = "Press."
        definition = protocol(needs=("tec",))(press)
        # The dry runs before press the keys as well.
        former = signal.signal(signal.SIGINT, lambda *_: None)
        try:
            outcome = carry_out(make(protocol=definition), console).outcome
        finally:
            signal.signal(signal.SIGINT, former)
        assert seen == [False] * len(seen)
        assert outcome.status == "aborted"
        assert "pausing" in capfd.readouterr().err

    def test_a_failure_is_told_with_its_reason(self, make, console):
        result = carry_out(make(("high = 90.0", "high = 41.0"), settings={"dwell": 10.0}), console)
        assert result.outcome.status == "failed"
        assert "interlock" in console.file.getvalue()
        with Record(result.folder) as record:
            assert record.status == "failed"


SIGNALS = (Signal("tec_temperature", "°C", "t", 2), Signal("force", "N", "f"))
EXPECTED = Expectation(((1, 4.0), (2, 8.0)), 8.0, at_most=90.0)


class TestDisplay:
    def show(self, **keys):
        console = PlainConsole(file=io.StringIO(), width=160, **keys)
        with ProgressDisplay(console, "x[/red].py", SIGNALS, ("tec_temperature",), EXPECTED) as display:
            display.event(Event(0.0, "INFO", "phase", "climb [/red]"))
            display.event(Event(3661.0, "INFO", "note", "there [bold]now"))
            display.event(Event(5.0, "WARN", "pause", "paused"))
            display.event(Event(6.0, "ERROR", "interlock", "too hot"))
            display.event(Event(7.0, "INFO", "safe-state", "tec: safe"))
            display.telemetry(1.0, 0, (20.123, float("nan")))
            for step in range(2):
                display.step(StepRecord(step, 0.0, 8.0, "", "", Settled.DWELL, {}, (20.123, 1.0)))
        return console.file.getvalue()

    def test_without_a_terminal_only_events(self):
        shown = self.show()
        assert "1:01:01  note: there [bold]now" in shown
        assert "pause: paused" in shown
        assert "interlock: too hot" in shown
        assert "tec: safe" not in shown
        assert "2/2" not in shown

    def test_leaving_a_terminal_that_is_gone(self):
        class Gone(io.StringIO):
            lost = False

            def write(self, text):
                if self.lost and threading.current_thread() is threading.main_thread():
                    raise OSError(5, "Input/output error")
                return super().write(text)

        file = Gone()
        with ProgressDisplay(PlainConsole(file=file, force_terminal=True), "stairs", SIGNALS, (), EXPECTED):
            file.lost = True


class Screen:
    """A terminal whose display was entered, with a dialogue on it."""

    def __init__(self, **keys):
        self.console = PlainConsole(file=io.StringIO(), width=160, **keys)
        self.display = ProgressDisplay(self.console, "stairs", SIGNALS, ("tec_temperature",), EXPECTED)
        self.dialogue = Dialogue(self.console, self.display, None, at_terminal=True)

    @property
    def shown(self):
        return self.console.file.getvalue()


class TestQuestion:
    @cases(
        ("typed", "answer"),
        [
            ("r\n", "resume"),
            ("Resume\n", "resume"),
            ("a\n", "abort"),
            ("end\n", "abort"),
            ("", "abort"),
            ("s\n", "step"),
            ("n  door opened \n", "note door opened"),
            ("set dwell=3\n", "set dwell=3"),
            ("off\n", "off"),
        ],
    )
    def test_answers(self, monkeypatch, typed, answer):
        monkeypatch.setattr("sys.stdin", io.StringIO(typed))
        assert Screen().dialogue.ask(Question("paused by the operator")) == answer

    def test_asks_until_it_understands(self, monkeypatch):
        monkeypatch.setattr("sys.stdin", io.StringIO("what\n\nn\n r \n"))
        screen = Screen()
        assert screen.dialogue.ask(Question("paused by the operator")) == "resume"
        assert screen.shown.count("please answer r (resume), s (step), n (note), set, o (off), a (abort)") == 2
        assert screen.shown.count("note TEXT: write a note into the record") == 1

    def test_at_a_prompt_there_is_less_to_say(self, monkeypatch):
        monkeypatch.setattr("sys.stdin", io.StringIO("s\nr\n"))
        screen = Screen()
        assert screen.dialogue.ask(Question("Hang 2 N on", AT_A_PROMPT, "BY HAND")) == "resume"
        assert "BY HAND for 0:00:00" in screen.shown
        assert "please answer r (resume), a (abort)" in screen.shown

    def test_the_bar_stands_still_until_the_run_goes_on(self, monkeypatch):
        monkeypatch.setattr("sys.stdin", io.StringIO("note here\nresume\n"))
        screen = Screen(force_terminal=True)
        question = Question("paused by the operator", parameters={"dwell": "8 s"})
        with screen.display as display:
            display.telemetry(1.0, 0, (20.123, 1.0))
            assert screen.dialogue.ask(question) == "note here"
            before = screen.shown
            display.step(StepRecord(1, 0.0, 8.0, "", "", Settled.DWELL, {}, (20.456, 1.0)))
            assert screen.shown == before
            display.event(Event(5.0, "WARN", "warning", "near a limit"))
            assert "near a limit" in screen.shown
            assert screen.dialogue.ask(question) == "resume"
            display.step(StepRecord(1, 0.0, 8.0, "", "", Settled.DWELL, {}, (20.789, 1.0)))
        assert "\a" in screen.shown
        assert "PAUSED for 0:00:00  tec_temperature" in screen.shown
        assert "set dwell=…  now 8 s" in screen.shown
        # The new bar is below the question.
        assert screen.shown.rindex("2/2") > screen.shown.rindex("PAUSED for")

    def test_a_display_that_has_ended_ends_the_question(self, monkeypatch):
        monkeypatch.setattr("sys.stdin", io.StringIO("r\n"))
        screen = Screen()
        screen.display.is_over = True
        assert screen.dialogue.ask(Question("paused")) == "abort"
