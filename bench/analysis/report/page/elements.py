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
    """A table: heads, rows of cells, and a note below.

    Attributes
    ----------
    heads : sequence of str
        Empty texts only if it has none.
    rows : sequence of sequence of str
        As many cells each as there are heads.
    title, note : str
        Above and below; empty for none.
    folded : bool
        Whether it is shown only when it is opened.
    numbers_from : int
        First column of numbers, which are aligned right.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    note: str = ""
    folded: bool = False
    numbers_from: int = 99
    kind = "table"


@dataclass(frozen=True)
class PageFigure:
    """A figure.

    Attributes
    ----------
    svg : str
        An `svg` element, as `bench.analysis.report.page.svg.inlined` returns it.
    caption : str
        What it shows.
    is_map : bool
        Whether its colours are values, which a dark page leaves as they are.
    """

    svg: str
    caption: str
    is_map: bool = False
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
    """A whole page.

    Attributes
    ----------
    title, subtitle : str
        Its heads.
    badge, badge_style : str
        State in a word, and its style: `good`, `open`, `bad` or empty.
    lead : sequence of str
        What it says in words, one paragraph each.
    sections : sequence of PageSection
        The rest.
    """

    title: str
    subtitle: str
    badge: str
    badge_style: str
    lead: Sequence[str]
    sections: Sequence[PageSection] = field(default_factory=tuple)
