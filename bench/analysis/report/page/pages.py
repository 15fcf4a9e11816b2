"""Pages as HTML files that ask for nothing from anywhere: their elements, figures within them, and the file."""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from bench.base import DataError, needed_for, write_result


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

    svg: str  # an `svg` element
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


_ROOT = re.compile(r"<svg\b[^>]*>.*</svg>", re.DOTALL)

_NEEDLESS = re.compile(r"<!--.*?-->|<metadata>.*?</metadata>|<style\b.*?</style>", re.DOTALL)

_GROUP_NAMES = re.compile(r'(?<=<g) id="[^"]+"')

_NUMBERS = re.compile(r"-?\d+\.\d+")

_PATHS = re.compile(r'(?<= d=")[^"]+')

_MARKS = re.compile(r"(?:\s*<use [^>]*/>){2,}")

_MARK = re.compile(r'<use xlink:href="#(?P<mark>[^"]+)" x="(?P<x>[^"]+)" y="(?P<y>[^"]+)" style="(?P<style>[^"]*)"/>')

_DOTS = re.compile(r'<path id="(?P<mark>[^"]+)" d="M ?0 (?P<radius>[\d.]+) ?\s*C[^"]*"(?: style="[^"]*")?/>')

_FILL = re.compile(r"fill: (#[0-9a-f]{6})(?:; fill-opacity: ([\d.]+))?")

_FEW_MARKS = 20
"""Marks that stay as they are, such as those of an axis."""


def inlined(path: Path, caption: str, *, is_map: bool = False) -> PageFigure:
    """Return an SVG file that matplotlib drew as a figure of a page.

    Coordinates keep a hundredth of a point, and the dots of a curve become one path. The identifiers that stay are
    those of clips and marks, which differ from figure to figure.

    The caption is for readers who do not see the figure as well.

    Raises DataError if it cannot be read or is no such file.
    """
    from markupsafe import escape

    try:
        found = _ROOT.search(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}") from None
    if found is None:
        raise DataError(f"{path} is not an SVG figure")
    text = _GROUP_NAMES.sub("", _NEEDLESS.sub("", found[0]))
    radii = {each["mark"]: float(each["radius"]) for each in _DOTS.finditer(text)}
    text = _MARKS.sub(lambda marks: _one_path(marks[0], radii), _PATHS.sub(_short_path, text))
    text = re.sub(r">\s+<", "><", text)
    text = text.replace("<svg ", f'<svg role="img" aria-label="{escape(caption)}" ', 1)
    return PageFigure(text, caption, is_map)


def _short_path(path: re.Match[str]) -> str:
    return re.sub(r"\s*([A-Za-z])\s*", r"\1", _NUMBERS.sub(lambda number: _short(number[0]), path[0]))


def _short(number: str) -> str:
    return f"{float(number):.2f}".rstrip("0").rstrip(".")


def _one_path(marks: str, radii: dict[str, float]) -> str:
    """Return many dots of one curve as the round ends of lines without length."""
    parts = list(_MARK.finditer(marks))
    kinds = {(each["mark"], each["style"]) for each in parts}
    if len(parts) < _FEW_MARKS or len(kinds) != 1:
        return marks
    mark, style = kinds.pop()
    fill = _FILL.search(style)
    if mark not in radii or fill is None:
        return marks
    dots = "".join(f"M{float(each['x']):.1f} {float(each['y']):.1f}h0" for each in parts)
    opacity = f"; stroke-opacity: {fill[2]}" if fill[2] else ""
    width = _short(f"{2.0 * radii[mark]}")
    drawn = f"fill: none; stroke: {fill[1]}; stroke-width: {width}; stroke-linecap: round{opacity}"
    return f'<path d="{dots}" style="{drawn}"/>'


_HERE = Path(__file__).parent


def render(page: Page) -> str:
    """Return a page as HTML: every text is escaped, and scripts and requests are forbidden by its own policy.

    Raises MissingExtraError if jinja2 is not installed.
    """
    with needed_for("an HTML report", "report"):
        from jinja2 import Environment
        from markupsafe import Markup

    environment = Environment(autoescape=True, trim_blocks=False)
    template = environment.from_string((_HERE / "page.html").read_text(encoding="utf-8"))
    style = Markup((_HERE / "style.css").read_text(encoding="utf-8"))  # noqa: S704 - our own file
    return template.render(
        page=page, style=style, footer=f"actuator-bench {importlib.metadata.version('actuator-bench')}"
    )


def write_page(path: Path, page: Page) -> None:
    """Write a page, UTF-8.

    Raises DataError if it cannot be written.
    """
    write_result(path, render(page))
