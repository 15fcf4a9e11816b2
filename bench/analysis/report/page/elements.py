"""What a page consists of. Every text is plain: the templates escape it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias


@dataclass(frozen=True)
class PageText:
    """A paragraph, or lines of a terminal."""

    text: str
    is_command: bool = False
    kind = "text"


@dataclass(frozen=True)
class PageTable:
    """A table: heads, rows of cells, and a note below."""

    heads: Sequence[str]  # empty texts only if it has none
    rows: Sequence[Sequence[str]]  # as many cells each as there are heads
    # Above and below; empty for none.
    title: str = ""
    note: str = ""
    folded: bool = False  # whether it is shown only when it is opened
    numbers_from: int = 99  # first column of numbers, which are aligned right
    kind = "table"


@dataclass(frozen=True)
class PageFigure:
    """A figure."""

    svg: str  # an `svg` element, as `bench.analysis.report.page.svg.inlined` returns it
    caption: str  # what it shows
    is_map: bool = False  # whether its colours are values, which a dark page leaves as they are
    kind = "figure"


PagePart: TypeAlias = PageText | PageTable | PageFigure


@dataclass(frozen=True)
class PageSection:
    """A part of a page under a head."""

    title: str
    parts: Sequence[PagePart]

    @property
    def anchor(self) -> str:
        """Name of the section within the page."""
        return "-".join(self.title.lower().replace(",", "").split())


@dataclass(frozen=True)
class Page:
    """A whole page."""

    # Its heads.
    title: str
    subtitle: str
    # State in a word, and its style: `good`, `open`, `bad` or empty.
    badge: str
    badge_style: str
    lead: Sequence[str]  # what it says in words, one paragraph each
    sections: Sequence[PageSection] = field(default_factory=tuple)
