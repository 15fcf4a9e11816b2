"""Problems of the figures that are saved."""

from contextlib import contextmanager

import pytest
from figure_checks import problems_of
from matplotlib.figure import Figure


@contextmanager
def looking_at_figures():
    """Look at every figure that is saved within the context; give what is wrong with each, by its file."""
    found = {}
    save = Figure.savefig

    def look(figure, path, **options):
        found[path.name] = problems_of(figure)
        save(figure, path, **options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", look)
        yield found
