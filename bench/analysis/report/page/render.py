"""A page as one HTML file, which asks for nothing from anywhere."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

from bench.analysis.report.page.elements import Page
from bench.base import needed_for, write_result

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
