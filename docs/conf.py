"""How Sphinx builds these pages: `make docs`, without any network; the pages need none to be read either."""

import re
import sys
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import generated_pages
from pygments.lexers import TextLexer
from sphinx.application import Sphinx

project = "actuator-bench"
author = "the contributors"
release = version = version_of("actuator-bench")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "numpydoc",
    "sphinx-mathjax-offline",
]
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath", "deflist"]
# Headings of three levels can be linked to, as on the pages of a repository's host.
myst_heading_anchors = 3

default_role = "code"
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
numpydoc_show_class_members = False
# The name of a parameter in a docstring is text, not a reference.
numpydoc_xref_param_type = False

html_theme = "pydata_sphinx_theme"
html_title = "actuator-bench"
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {"show_nav_level": 1, "navigation_depth": 2, "secondary_sidebar_items": ["page-toc"]}


_BAR = re.compile(r"(?<!\\)\|")
_LITERAL = re.compile(r"(`[^`]*`)")


def _keep_absolute_values(
    _app: Sphinx, _what: str, _name: str, _obj: object, _options: object, lines: list[str]
) -> None:
    """Keep |x| in a docstring what it is: an absolute value, not a substitution of reStructuredText."""
    for number, line in enumerate(lines):
        # Every second part is a literal.
        parts = _LITERAL.split(line)
        lines[number] = "".join(
            _BAR.sub(r"\\|", part) if index % 2 == 0 else part for index, part in enumerate(parts)
        )


def setup(app: Sphinx) -> None:
    """Write the pages that follow from the code before Sphinx reads any."""
    app.connect("builder-inited", lambda app: generated_pages.write(Path(app.srcdir) / "reference" / "generated"))
    app.connect("autodoc-process-docstring", _keep_absolute_values)
    # Tables in the text are shown as they are.
    app.add_lexer("csv", TextLexer)
