"""The terminal while tasks are carried out: a line for each that runs, and one for all with the time left."""

from __future__ import annotations

import threading

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from bench.base.printing import print_plain


class TasksDisplay:
    """Progress of tasks; nothing is drawn if the console is no terminal.

    Parameters
    ----------
    console : Console
        Where to draw.
    title : str
        Name of the line of all.
    """

    def __init__(self, console: Console, title: str) -> None:
        self._console = console
        self._progress = Progress(
            # Names are the protocols': no markup.
            TextColumn("{task.description}", style="bold", markup=False),
            TextColumn("{task.fields[text]}", style="cyan", markup=False),
            BarColumn(bar_width=None),
            TextColumn("{task.fields[count]}", markup=False),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=600.0,
        )
        self._lock = threading.RLock()
        self._whole = self._progress.add_task(title, total=None, text="", count="")
        self._tasks = self._finished = 0
        self._said: set[str] = set()

    def start(self) -> None:
        """Begin to draw."""
        self._progress.start()

    def stop(self) -> None:
        """Take it off the terminal."""
        self._progress.stop()

    def add(self) -> None:
        """Count one more task."""
        with self._lock:
            self._tasks += 1
            self._draw_whole()

    def begin(self, name: str) -> TaskID:
        """Show a task that is begun; return its line."""
        return self._progress.add_task(f"  {name}", total=None, text="", count="")

    def advance(self, line: TaskID, completed: int, total: int | None, text: str) -> None:
        """Show how far a task is."""
        count = f"{completed}/{total}" if total else str(completed)
        self._progress.update(line, completed=completed, total=total or None, text=text, count=count)
        self._draw_whole()

    def end(self, line: TaskID | None = None) -> None:
        """Count a task as finished, and take its line away if it has one."""
        if line is not None:
            self._progress.remove_task(line)
        with self._lock:
            self._finished += 1
            self._draw_whole()

    def say(self, text: str) -> None:
        """Print above the lines what no task has said before."""
        with self._lock:
            if text in self._said:
                return
            self._said.add(text)
        print_plain(self._console, text)

    def _draw_whole(self) -> None:
        running = [task.percentage for task in self._progress.tasks if task.id != self._whole]
        self._progress.update(
            self._whole,
            completed=self._finished + sum(running) / 100.0,
            total=self._tasks,
            count=f"{self._finished}/{self._tasks}",
        )
