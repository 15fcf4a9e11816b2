"""What notebooks show: pages, and lists of runs."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from pathlib import Path
from typing import Any

from bench.analysis.run_folder import ListedRun, RunFolder
from bench.base import format_duration, html_table

_HEIGHT = 700
"""Height of a page within a notebook, CSS pixels."""


class Report(dict[str, Any]):
    """What `bench.report` returns: for programs a mapping, in a notebook the page with its figures."""

    def _repr_html_(self) -> str:
        page = Path(self["page"]).read_text(encoding="utf-8")
        return f'<iframe srcdoc="{escape(page)}" style="width:100%;height:{_HEIGHT}px;border:0"></iframe>'


class RunTable(list[RunFolder]):
    """Runs, the oldest first; in a notebook a table.

    Parameters
    ----------
    listed : iterable of ListedRun
        What is known of them.
    """

    def __init__(self, listed: Iterable[ListedRun]) -> None:
        self._listed = tuple(listed)
        super().__init__(RunFolder(each.folder) for each in self._listed)

    def _rows(self) -> list[tuple[str, ...]]:
        return [
            (
                each.folder.name,
                each.status,
                str(each.steps),
                "" if each.seconds is None else format_duration(each.seconds),
                each.result,
            )
            for each in self._listed
        ]

    def __repr__(self) -> str:
        """Return a line a run."""
        return "\n".join("  ".join(row).rstrip() for row in self._rows()) or "no runs"

    def _repr_html_(self) -> str:
        return html_table(("run", "status", "steps", "laboratory time", "result"), self._rows())
