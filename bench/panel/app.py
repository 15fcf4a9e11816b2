"""The panel at the terminal (Textual)."""

from __future__ import annotations

from typing import ClassVar

from textual.app import App, ComposeResult
from textual.binding import Binding
from textual.widgets import DataTable, Footer, Input, RichLog, Static

from bench.panel.margins import margin_of, sparkline
from bench.panel.sources import Source

_INTERVAL = 0.5
"""Wall-clock time between two looks at the source, s."""

_WIDTH = 30
"""Characters of a sparkline."""

_COLUMNS = ("signal", "reading", "unit", "course", "margin")


class Panel(App[None]):
    """A table of all signals, what happened, and a line for commands.

    Parameters
    ----------
    source : Source
        What is shown.
    """

    TITLE = "bench panel"
    CSS = """
    #state { height: 1; background: $primary; color: $text; }
    #signals { height: auto; max-height: 60%; }
    #log { height: 1fr; min-height: 3; border-top: solid $primary; }
    #help { height: auto; color: $text-muted; }
    #command { height: 3; }
    """
    BINDINGS: ClassVar = [
        Binding("f2", "submit('hold')", "hold"),
        Binding("f3", "submit('safe')", "outputs off"),
        Binding("f4", "submit('pause')", "pause the run"),
        Binding("ctrl+c", "leave", "leave", priority=True),
        Binding("ctrl+q", "leave", "leave", priority=True),
    ]

    def __init__(self, source: Source) -> None:
        super().__init__()
        self._source = source
        self._lines = 0
        self._zeros: dict[str, float] = {}
        self._latest: dict[str, float] = {}
        self._leaving = False

    def compose(self) -> ComposeResult:
        """Yield the widgets from top to bottom."""
        yield Static("", id="state", markup=False)
        yield DataTable(id="signals", cursor_type="none", show_cursor=False)
        yield RichLog(id="log", wrap=True, max_lines=500)
        yield Static("", id="help", markup=False)
        yield Input(placeholder="command", id="command")
        yield Footer()

    def on_mount(self) -> None:
        """Begin to look."""
        self.query_one("#signals", DataTable).add_columns(*_COLUMNS)
        self.query_one("#command", Input).focus()
        self.set_interval(_INTERVAL, self.look)
        self.look()

    def look(self) -> None:
        """Show what there is now."""
        if not self.query("#state"):
            return  # it is being closed
        view = self._source.view()
        self.query_one("#state", Static).update(f"{view.title}   {view.state}")
        self.query_one("#help", Static).update(view.help)
        log = self.query_one("#log", RichLog)
        # The source keeps the newest lines only; the journal has all.
        for line in view.lines[self._lines :] if self._lines <= len(view.lines) else view.lines:
            log.write(line)
        self._lines = len(view.lines)
        if view.shown is not None and view.ticks:
            self._latest = dict(view.ticks[-1][1])
            table = self.query_one("#signals", DataTable)
            table.clear()
            for signal in view.shown.signals:
                value = self._latest.get(signal.name)
                if value is None:
                    continue
                name, zero = signal.name, self._zeros.get(signal.name)
                margin = margin_of(name, self._latest, view.shown)
                course = sparkline([values[name] for _, values in view.ticks if name in values], _WIDTH)
                table.add_row(
                    f"Δ {name}" if zero is not None else name,
                    signal.display.number(value - (zero or 0.0)),
                    signal.display.unit,
                    course,
                    f"{'! ' if margin.is_warned else ''}{margin.text(signal.display)}",
                )
        if view.closes or (view.over and self._leaving):
            self.exit()

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Return whether a key has a meaning here."""
        return action != "submit" or parameters[0] in self._source.keys

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Carry a line out."""
        line = event.value.strip()
        event.input.clear()
        if line:
            self.action_submit(line)

    def action_submit(self, line: str) -> None:
        """Carry a line out."""
        log = self.query_one("#log", RichLog)
        word, *rest = line.lower().split()
        if word in ("quit", "q"):
            self.action_leave()
        elif word == "zero" and len(rest) == 1 and line.split()[1] in self._latest:
            signal = line.split()[1]
            if self._zeros.pop(signal, None) is None:
                self._zeros[signal] = self._latest[signal]
        else:
            log.write(f"> {line}")
            if problem := self._source.submit(line):
                log.write(f"refused: {problem}")

    def action_leave(self) -> None:
        """Leave; hands on a rig end in the safe state first."""
        self._leaving = True
        if self._source.leave():
            self.exit()
