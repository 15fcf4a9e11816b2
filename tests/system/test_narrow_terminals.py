"""What is printed on terminals of few columns: no name, number or time is cut."""

import io
import re

from cases import cases
from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.base import Expectation, PlainConsole, print_plain, show_table
from bench.devices import Signal
from bench.execution.terminal import ProgressDisplay

SIGNALS = (Signal("supply_voltage", "V", ""), Signal("load_cell_force", "N", ""))
LONG = Expectation(((5, 10.0), (100, 4000.0)), 4000.0, at_most=4000.0 * 24.0)


def drawn(columns):
    """Return the lines of a run's progress as it stands at the end, without what only moves the cursor."""
    console = Console(file=io.StringIO(), width=columns, force_terminal=True, color_system=None)
    names = [signal.name for signal in SIGNALS]
    with ProgressDisplay(console, "damped-oscillation", SIGNALS, names, LONG, 1.0) as display:
        display._show(100.0, 3, [2.85, -0.123])
    last = console.file.getvalue().rpartition("\x1b[2K")[2]
    return re.sub(r"\x1b\[[?0-9;]*[A-Za-z]", "", last).splitlines()


class TestProgress:
    @cases("columns", [160, 100, 80, 60, 40])
    def test_nothing_is_cut(self, columns):
        lines = drawn(columns)
        assert all(len(line) <= columns for line in lines)
        text = " ".join(line.strip() for line in lines)
        for whole in (
            r"damped-oscillation +3/100", r"t 0:01:40,",
            r"left \d+:\d\d:\d\d laboratory ≈ [\d.]+ (s|min|h),", r"ends (\d+-\d+-\d+ )?\d\d:\d\d",
            r"at the latest (\d+-\d+-\d+ )?\d\d:\d\d", r"supply_voltage 2\.850 V", r"load_cell_force -0\.123 N",
        ):  # fmt: skip
            assert re.search(whole, text), whole
        assert "…" not in text

    def test_readings_give_way_before_times(self):
        lines = drawn(140)
        assert "at the latest" in lines[0]
        assert "supply_voltage" not in lines[0]
        assert lines[1] == "supply_voltage 2.850 V  load_cell_force -0.123 N"


CELLS = [("tec_sink_temperature", "20.992", "5 to 100 (interlock)"), ("psd", "-1.6e-06", "")]


def table(*, box=True):
    made = Table("signal", "lowest", "what it may not leave", title="all", **({} if box else {"box": None}))
    for row in CELLS:
        made.add_row(*row)
    return made


def shown(made, columns):
    console = Console(file=io.StringIO(), width=columns)
    show_table(console, made)
    return console.file.getvalue()


class TestTables:
    @cases("box", [True, False])
    @cases("columns", [*range(20, 80, 3)])
    def test_every_word_is_whole(self, columns, box):
        text = shown(table(box=box), columns)
        for word in " ".join(cell for row in CELLS for cell in row).split():
            assert re.search(rf"(^|\s){re.escape(word)}(\s|$)", text.replace("│", " ")), word
        assert "…" not in text

    def test_a_wide_terminal_has_the_table_as_it_is(self):
        console = Console(file=io.StringIO(), width=100)
        console.print(table())
        assert shown(table(), 100) == console.file.getvalue()

    def test_a_narrow_one_has_a_line_a_cell(self):
        assert shown(table(), 30) == (
            "all\ntec_sink_temperature\n    lowest: 20.992\n    what it may not leave: 5 to 100 (interlock)\n"
            "psd\n    lowest: -1.6e-06\n"
        )


def test_commands_cut_nothing(bench, monkeypatch):
    from bench.cli import console

    monkeypatch.setattr(console, "width", 40)
    code, out, _ = bench("rehearse", "creep", "--rig", "vo2")
    assert code == 0
    for word in ("tec_sink_temperature", "lowest", "(interlock)", "margin"):
        assert word in out
    # A line about the progress, where the machine is slow, ends with a blank and three points.
    assert not [line for line in out.splitlines() if "…" in line.removesuffix(" …")]


class TestTextsOfOthers:
    """Names, notes and answers come from files, instruments and other users: none of them commands the terminal."""

    HOSTILE = "x\x1b[2K\x1b[1Gerror\x07\r\x9b31mz\u202egnp.exe\u2066\u200f"

    @cases("is_terminal", [True, False])
    def test_characters_that_command_a_terminal_are_shown_as_such(self, is_terminal):
        console = PlainConsole(file=io.StringIO(), width=200, force_terminal=is_terminal, color_system=None)
        print_plain(console, self.HOSTILE)
        console.print("first\nsecond\tthird", soft_wrap=True)
        show_table(console, table_of(self.HOSTILE))
        lines = console.file.getvalue().splitlines()
        assert lines[1:3] == ["first", "second  third"]
        text = re.sub(r"\x1b\[\d*m", "", "\n".join(lines))
        assert not set("\x1b\x07\r\x9b\u202e\u2066\u200f") & set(text)
        assert text.count("error") == 2

    def test_brackets_and_colons_are_no_markup(self):
        console = PlainConsole(file=io.StringIO(), width=200, force_terminal=True)
        table = Table("[name]", title="[all]")
        table.add_row("[red]cell")
        texts = "[bold]a[/] :smile:", "[red]cell", "[name]", "[all]"
        console.print(texts[0])
        show_table(console, table)
        for text in texts:
            assert text in console.file.getvalue()

    def test_a_bar_still_moves_the_cursor(self):
        console = PlainConsole(file=io.StringIO(), width=80, force_terminal=True, color_system=None)
        with ProgressDisplay(console, "creep\x1b[1G", SIGNALS, [], LONG, 1.0) as display:
            display._show(100.0, 3, [2.85, -0.123])
        text = console.file.getvalue()
        assert "\x1b[2K" in text
        assert "creep�[1G" in text


def table_of(cell):
    made = Table("name", title="all")
    made.add_row(Text(cell))
    return made
